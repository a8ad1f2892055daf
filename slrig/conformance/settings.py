"""Settings: taken as asked or refused, never bent in silence, and true to the light."""

from __future__ import annotations

import math

import numpy as np

from slrig.conformance.bench import (
    FRAMES,
    Need,
    NotApplicableError,
    RigBench,
    View,
    at,
    check,
    expect,
    near,
    refused,
    view_check,
)
from slrig.devices import Camera, CameraSettings
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Pixels

_READ_BACK = "set the device, read it back, and return what it says; declare the range that it really takes"
_REFUSE = "compare with the declared range, and read back: a device that bends a value in silence took another one"
_APART = 1.6  # of two exposures, so that light tells them apart
_BRIGHTER = 1.1  # at least, of exposures so far apart
_SATURATED = 0.98  # of full scale: some sensors saturate a little below it
_LEAST_PIXELS = 16


@check()
def settings_are_read_back(bench: RigBench) -> None:
    """Both ends of the declared ranges can be set, and are read back."""
    # Set, never exposed: the longest exposure may be a minute.
    for name, camera in bench.rig.cameras.items():
        with at(f"camera '{name}'"):
            usual = bench.settings(name)
            wanted = [CameraSettings(exposure_s, usual.gain) for exposure_s in camera.info.exposure_range_s]
            wanted += [CameraSettings(usual.exposure_s, gain) for gain in camera.info.gain_range]
            for asked in (*wanted, usual):
                applied = camera.configure(asked)
                expect(
                    near(applied.exposure_s, asked.exposure_s) and near(applied.gain, asked.gain),
                    asked=f"exposure {asked.exposure_s:.6g} s and gain {asked.gain:.6g} are taken, within 1 %",
                    found=f"{applied.exposure_s:.6g} s and {applied.gain:.6g}",
                    do=_READ_BACK,
                )


@check()
def settings_out_of_range_are_refused(bench: RigBench) -> None:
    """Settings out of range are refused, and change nothing."""
    for name, camera in bench.rig.cameras.items():
        with at(f"camera '{name}'"):
            usual = bench.settings(name)
            camera.configure(usual)
            for asked in _impossible(camera, usual):
                with refused(
                    UnsupportedByDeviceError,
                    asked=f"exposure {asked.exposure_s:.6g} s with gain {asked.gain:.6g}, where "
                    f"{camera.info.exposure_range_s} s and {camera.info.gain_range} are declared",
                    do=_REFUSE,
                ):
                    camera.configure(asked)
    for name, trigger in bench.ways():
        with bench.view(name, trigger) as view:
            view.camera.disarm()
            for asked in _impossible(view.camera, bench.settings(name)):
                with refused(UnsupportedByDeviceError, asked="a setting out of range", do=_REFUSE):
                    view.camera.configure(asked)
            view.camera.arm(FRAMES, trigger)
            frame = view.expose(0)
            expect(
                near(frame.exposure_s, view.applied.exposure_s) and near(frame.gain, view.applied.gain),
                asked=f"after a refusal, frames are exposed as before: {view.applied.exposure_s:.6g} s, gain "
                f"{view.applied.gain:.6g}",
                found=f"{frame.exposure_s:.6g} s, gain {frame.gain:.6g}",
                do="check a value before the device is touched",
            )


@view_check(Need.WHITE_AND_BLACK)
def a_longer_exposure_is_brighter(view: View) -> None:
    """A longer exposure makes a brighter frame."""
    lit = view.learn().lit
    usual = view.bench.settings(view.name)
    other_s = _another_exposure(view.camera, usual.exposure_s)
    if other_s is None:
        raise NotApplicableError("has one exposure, or none that it can set")
    short_s, long_s = sorted((usual.exposure_s, other_s))
    light: dict[float, tuple[Pixels, Pixels]] = {}
    for exposure_s in (short_s, long_s):
        view.camera.disarm()
        try:
            view.camera.configure(CameraSettings(exposure_s, usual.gain))
        except UnsupportedByDeviceError:
            raise NotApplicableError(f"takes certain exposures only, and not {exposure_s:.6g} s") from None
        view.camera.arm(FRAMES, view.trigger)
        light[exposure_s] = (view.expose(0).image, view.expose(1).image)
    unsaturated = lit & (light[long_s][0] < _SATURATED * view.camera.info.format.full_scale)
    if np.count_nonzero(unsaturated) < _LEAST_PIXELS:
        raise NotApplicableError(f"is saturated by white at {long_s:.6g} s")
    short, long = (
        float(np.mean(light[each][0][unsaturated], dtype=np.float64) - np.mean(light[each][1][unsaturated]))
        for each in (short_s, long_s)
    )
    expect(
        long >= _BRIGHTER * short,
        asked=f"white is brighter at {long_s:.6g} s than at {short_s:.6g} s",
        found=f"{long:.1f} and {short:.1f} DN above black",
        do="switch automatic exposure and gain off before setting them, and pass over the frames that were exposed "
        "before the setting took effect",
    )


def _another_exposure(camera: Camera, usual_s: float) -> float | None:
    """An exposure that differs clearly from the usual one, and does not take long."""
    low_s, high_s = camera.info.exposure_range_s
    if low_s * _APART <= usual_s:
        return max(low_s, usual_s / 2)
    if high_s >= usual_s * _APART:
        return min(high_s, usual_s * 2)
    return None


def _impossible(camera: Camera, usual: CameraSettings) -> list[CameraSettings]:
    low_s, high_s = camera.info.exposure_range_s
    exposures_s = [low_s / 2, 0.0, -1.0, *([high_s * 2] if math.isfinite(high_s * 2) else [])]
    gains = [camera.info.gain_range[1] * 2 + 1, -1.0]
    wrong = [CameraSettings(exposure_s, usual.gain) for exposure_s in exposures_s]
    return wrong + [CameraSettings(usual.exposure_s, gain) for gain in gains]
