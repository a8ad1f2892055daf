"""Frames: what is in one, when it was exposed, and that it shows the pattern it was asked for."""

from __future__ import annotations

import numpy as np

from slrig.conformance.bench import Need, NotApplicableError, View, expect, near, view_check
from slrig.devices import AppliedSettings, CameraInfo
from slrig.model import Frame

_ALTERNATIONS = 12
_IDLE_BEFORE = (4, 9)
"""Once before white, once before black."""

_ON_CLOCK = "convert the device's clock to CLOCK_MONOTONIC (time.monotonic_ns), and state the error in t_err_ns"


@view_check()
def frames_are_as_declared(view: View) -> None:
    """Frames have the name, extent, type and range that the camera declares."""
    for index in range(len(view.bench.opening)):
        expect_declared(view.expose(index), view.camera.info)


@view_check()
def frames_tell_their_exposure(view: View) -> None:
    """Frames tell the exposure and gain that were set, and lasted as long."""
    for index in range(len(view.bench.opening)):
        expect_exposed(view.expose(index), view.applied)


@view_check()
def frame_numbers_and_times_rise(view: View) -> None:
    """Frame numbers and times only rise."""
    last = view.expose(0)
    for index in range(6):
        frame = view.expose(index % len(view.bench.sequence))
        expect(
            frame.sequence_number > last.sequence_number,
            asked=f"a frame number is above {last.sequence_number}, that of the frame before",
            found=frame.sequence_number,
            do="count every frame that the sensor made, unroll the device's counter, and return none twice",
        )
        expect(
            frame.t_start_ns + frame.t_err_ns >= last.t_end_ns - last.t_err_ns,
            asked=f"a frame begins after the end of the one before, {last.t_end_ns} ± {last.t_err_ns} ns",
            found=f"{frame.t_start_ns} ± {frame.t_err_ns} ns",
            do="take time stamps from the device, and return each frame once",
        )
        expect(
            frame.dropped_count >= last.dropped_count >= 0,
            asked=f"dropped_count goes on from {last.dropped_count} while the camera is armed",
            found=frame.dropped_count,
            do="count lost and corrupt frames since arm",
        )
        last = frame


@view_check()
def frame_times_lie_on_the_projectors_clock(view: View) -> None:
    """Times of frames lie on the projector's clock."""
    before = view.show(0)
    for index in (1, 0, 1):
        view.start()
        frame = view.read(view.stable_ns(before))
        expect(frame.t_err_ns >= 0, asked="t_err_ns is 0 or more", found=frame.t_err_ns, do=_ON_CLOCK)
        after = view.show(index % len(view.bench.sequence))
        expect(
            frame.t_start_ns >= view.stable_ns(before),
            asked=f"a frame read after {view.stable_ns(before)} ns begins after that",
            found=f"{frame.t_start_ns} ns",
            do=_ON_CLOCK,
        )
        expect(
            frame.t_end_ns - frame.t_err_ns <= view.stable_ns(after),
            asked=f"a frame that was in hand before a pattern lit at {after.t_visible_ns} ns ended before that",
            found=f"{frame.t_end_ns} ± {frame.t_err_ns} ns",
            do=_ON_CLOCK,
        )
        before = after


@view_check(Need.WHITE_AND_BLACK, every=True)
def a_frame_lies_wholly_in_its_pattern(view: View) -> None:
    """Every frame shows its pattern and no other's light, at once and after a pause."""
    view.learn()
    for turn in range(_ALTERNATIONS):
        index = turn % 2
        if turn in _IDLE_BEFORE:
            view.show(1 - index)
            view.let_frames_pile_up()
        view.expect_level(
            view.expose(index),
            index,
            asked="a frame that was read after a pattern became visible shows that pattern alone",
            do="read returns frames whose whole exposure, all rows, lies after after_ns; what show returns "
            "says from when on its light is on the scene",
        )


@view_check(Need.WHITE_AND_BLACK)
def a_frame_keeps_its_pixels(view: View) -> None:
    """A frame keeps its pixels when the next ones come."""
    frame = view.expose(0)
    kept = frame.image.copy()
    for _ in range(8):
        view.expose(1)
    changed = int(np.count_nonzero(frame.image != kept))
    expect(
        changed == 0,
        asked="a frame's image is its own after eight more frames",
        found=f"{changed} of {kept.size} pixels changed",
        do="copy the image out of the driver's buffer before the buffer is used again",
    )


@view_check(Need.WHITE_AND_BLACK)
def frames_come_in_colour_where_it_is_declared(view: View) -> None:
    """A camera that declares colour gives the same picture in blue, green and red, and another gives none."""
    lit = view.learn().lit
    info, frames = view.camera.info, [view.expose(index) for index in (0, 1)]
    expect(
        all((frame.colour is not None) == info.colour for frame in frames),
        asked=f"CameraInfo.colour is {info.colour}, and frames have a function that makes their colour, or none",
        found=[frame.colour for frame in frames],
        do="declare what frames have",
    )
    if not info.colour:
        raise NotApplicableError("has no colour")
    for _ in range(8):
        view.expose(1)
    white, black = (frame.colour() for frame in frames if frame.colour is not None)
    wanted = ((*frames[0].image.shape, 3), frames[0].image.dtype)
    expect(
        (white.shape, white.dtype) == wanted and white.max() <= info.format.full_scale,
        asked=f"colour is {wanted[0]} {wanted[1]}, up to {info.format.full_scale}",
        found=f"{white.shape} {white.dtype}, up to {white.max()}",
        do="return blue, green and red along the last axis, in the units of the image",
    )
    brighter = white[lit].mean(axis=0) - black[lit].mean(axis=0)
    expect(
        brighter.max() > 0 and brighter.min() >= -0.1 * brighter.max(),
        asked="eight frames later, white is still brighter than black in colour, too",
        found=f"by {', '.join(f'{each:.1f}' for each in brighter)} DN of blue, green and red",
        do="make colour of a copy of what the camera sent, not of the driver's buffer",
    )


def expect_declared(frame: Frame, info: CameraInfo) -> None:
    """Expect that a frame is what its camera declares. Raises ExpectationError."""
    declared = info.format
    kind = np.dtype(np.uint8 if declared.bit_depth <= 8 else np.uint16)
    expect(
        frame.camera == info.name,
        asked=f"a frame names its camera '{info.name}'",
        found=f"'{frame.camera}'",
        do="use the name that the factory is given",
    )
    expect(
        frame.image.shape == declared.size.shape,
        asked=f"a frame of a camera of {declared.size} has {declared.size.shape} rows and columns",
        found=frame.image.shape,
        do="declare the extent that the device delivers, as Size(width_px, height_px)",
    )
    expect(
        frame.image.dtype == kind,
        asked=f"{declared.bit_depth} bits come as {kind}",
        found=frame.image.dtype,
        do="unpack the samples, or declare their bit depth",
    )
    expect(
        frame.image.max() <= declared.full_scale,
        asked=f"no sample is above {declared.full_scale}, the full scale of {declared.bit_depth} bits",
        found=int(frame.image.max()),
        do="align samples to the right, or declare their bit depth",
    )


def expect_exposed(frame: Frame, applied: AppliedSettings) -> None:
    """Expect that a frame was exposed as the camera was set. Raises ExpectationError."""
    for what, got, wanted in (
        ("exposure_s", frame.exposure_s, applied.exposure_s),
        ("gain", frame.gain, applied.gain),
    ):
        expect(
            near(got, wanted),
            asked=f"a frame's {what} is {wanted:.6g}, which configure returned",
            found=f"{got:.6g}",
            do="switch automatic control off, read settings back, and pass over frames from before",
        )
    lasted_s = (frame.t_end_ns - frame.t_start_ns + 2 * frame.t_err_ns) / 1e9
    spanned_s = frame.exposure_s + frame.shutter_skew_s
    expect(
        np.isnan(spanned_s) or lasted_s >= 0.99 * spanned_s,
        asked=f"t_start_ns to t_end_ns spans exposure and shutter skew, {spanned_s:.6g} s",
        found=f"{lasted_s:.6g} s, with what t_err_ns allows",
        do="t_start_ns is when the first row begins, t_end_ns when the last row ends",
    )
