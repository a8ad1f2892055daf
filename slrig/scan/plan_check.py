"""What a plan means on the rig that is there: its patterns, and whether the devices can do it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from slrig.bundle import MAX_CAPTURE_BYTES
from slrig.devices import CameraInfo, ProjectorInfo, Rig
from slrig.errors import UnsupportedByDeviceError, setting
from slrig.model import Axis, Black, Calibration, Pattern, PatternSequence, Sine, Size, White
from slrig.patterns import encode, phase_patterns, scan_patterns, with_cross_lines
from slrig.rig.session import RigFacts
from slrig.scan.light_axis import played_axes
from slrig.scan.plan import PatternPlan, ScanPlan


def pattern_sequence(
    plan: PatternPlan,
    size: Size,
    calibration: Calibration | None = None,
    cameras: Iterable[str] = (),
    *,
    axis: Axis | None = None,
    recorded: tuple[Pattern, ...] = (),
    coloured_light: bool = False,
) -> PatternSequence:
    """The patterns that a plan means on a projector of this size, with these cameras. Raises PatternError.

    axis : the one to triangulate by, if that was asked for. recorded : of `ProjectorInfo`; they are played unless the
    plan asks for patterns of its own. coloured_light : of `ScanPlan`.
    """
    if recorded and plan == PatternPlan():
        return encode(recorded, size)
    axes = played_axes(plan.rows, calibration, cameras, axis=axis)
    named = plan.named
    rows, columns = (plan.codes and axis in axes for axis in (Axis.ROW, Axis.COLUMN))
    if named.sines:
        patterns = phase_patterns(
            size, period_px=named.period_px, steps=named.steps, rows=rows, columns=columns,
            coloured_light=coloured_light,
        )  # fmt: skip
    else:
        patterns = scan_patterns(
            size,
            line_shift=plan.line_shift,
            period_px=named.period_px,
            steps=named.steps,
            inverses=named.inverses,
            closing=named.closing,
            line_width_px=named.line_width_px,
            gray_cell_px=plan.gray_cell_px,
            gray_offset_px=plan.gray_offset_px,
            rows=rows,
            columns=columns,
            coloured_light=coloured_light,
        )
    if plan.cross_lines and rows != columns:
        patterns = with_cross_lines(patterns, Axis.COLUMN if rows else Axis.ROW)
    return encode(patterns, size)


def rig_sequence(plan: ScanPlan, rig: Rig) -> PatternSequence:
    """The patterns of a scan on an open rig. Raises PatternError."""
    projector = rig.projector.info
    return pattern_sequence(
        plan.patterns, projector.size, rig.calibration, rig.cameras, axis=plan.reconstruction.axis,
        recorded=projector.recorded, coloured_light=plan.coloured_light,
    )  # fmt: skip


def in_colour(plan: ScanPlan, cameras: Mapping[str, CameraInfo], projector: ProjectorInfo) -> frozenset[str]:
    """The cameras whose white and black frames a plan keeps in colour.
    Raises UnsupportedByDeviceError: it asks for colour, and a camera has none; or for coloured light, and the projector
    has none, or no camera needs it.
    """
    mono = [name for name, camera in cameras.items() if not camera.colour]
    if plan.colour and mono:
        message = (
            f"{setting('colour')}: asked for, and camera '{mono[0]}' has none in the format that it is read in. Leave "
            "it out, and the cameras that have colour give it."
        )
        raise UnsupportedByDeviceError(message)
    kept = frozenset(cameras if plan.colour is not False else ()).difference(mono)
    if plan.coloured_light and not projector.lights:
        message = (
            f"{setting('coloured_light')}: asked for, and the projector '{projector.model}' has no lights of its own "
            "for red, green and blue that its driver could switch. Leave it out; a camera that has colour gives it."
        )
        raise UnsupportedByDeviceError(message)
    if plan.coloured_light and len(kept) == len(cameras):
        message = f"{setting('coloured_light')}: asked for, and every camera has colour already. Leave it out."
        raise UnsupportedByDeviceError(message)
    return kept


def no_turntable(turn_deg: float) -> UnsupportedByDeviceError:
    """The error that a rig cannot turn what stands before it."""
    message = (
        f"{setting('turn_deg')}: the object is to stand at {turn_deg:g}°, and this rig has no turntable. Turn it by "
        f"hand, and say so with {setting('turned_by')}; or name a turntable in the rig file"
    )
    return UnsupportedByDeviceError(message)


def check_plan(plan: ScanPlan, facts: RigFacts, calibration: Calibration | None = None) -> int:
    """Return the bytes that the frames of a scan take on this rig, uncompressed. calibration : that it is to use.

    Raises
    ------
    PatternError
        The patterns do not fit the projector, or by the calibration they tell no depth.
    ConfigError
        The region names a camera that is not there, or a mask of another extent.
    UnsupportedByDeviceError
        A camera cannot expose that long, or that briefly, or has no colour, or the frames are more than a bundle holds.
        Or there is no turntable to turn, or the projector shows no shades of grey.
    """
    if plan.turn_deg is not None and plan.turned_by == "table" and not facts.turntable:
        raise no_turntable(plan.turn_deg)
    exposures_s = plan.rising_exposures_s
    if plan.reconstruction.region is not None:
        plan.reconstruction.region.require_fits({name: each.format.size for name, each in facts.cameras.items()})
    axis = plan.reconstruction.axis
    projector = facts.projector
    sequence = pattern_sequence(
        plan.patterns, projector.size, calibration, facts.cameras, axis=axis, recorded=projector.recorded,
        coloured_light=plan.coloured_light,
    )  # fmt: skip
    if not projector.shades and any(isinstance(each, Sine) for each in sequence.patterns):
        message = (
            f"{setting('sequence')}: {plan.patterns.sequence} plays sinusoids, and the projector '{projector.model}' "
            "shows black and white alone. Ask for standard or fast, or connect its video input and drive it as a "
            "display (driver screen or kms in the rig file), which shows shades of grey"
        )
        raise UnsupportedByDeviceError(message)
    count, coloured = len(sequence) * plan.exposure_count, in_colour(plan, facts.cameras, projector)
    ends = sum(isinstance(each, White | Black) for each in sequence.patterns) * plan.exposure_count
    key = "exposure_s" if plan.exposures_s is None else "exposures_s"
    total = 0
    for name, camera in facts.cameras.items():
        least_s, most_s = camera.exposure_range_s
        for asked_s in exposures_s:
            if not least_s <= asked_s <= most_s:
                message = (
                    f"{key}: {asked_s:g} s was asked for, camera '{name}' can do {least_s:g} s to {most_s:g} s. "
                    "Ask for a value in that range."
                )
                raise UnsupportedByDeviceError(message)
        size = camera.format.size
        images = count + (3 * ends if name in coloured else 0)
        total += images * size.width_px * size.height_px * (1 if camera.format.bit_depth <= 8 else 2)
    if total > MAX_CAPTURE_BYTES:
        message = (
            f"The frames of this scan would take {total / 1e9:.1f} GB, a bundle holds {MAX_CAPTURE_BYTES / 1e9:.1f} "
            "GB at most. Ask for fewer exposures or fewer patterns."
        )
        raise UnsupportedByDeviceError(message)
    return total
