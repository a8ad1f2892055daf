"""Capture of a pattern sequence: each frame is exposed entirely within its pattern's light, and the rig ends dark."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, suppress

from slrig.bundle import RefusedFrame
from slrig.capture.retries import FrameChecks, RetryPolicy
from slrig.capture.streaming import FrameReader, capture_streaming, earliest_change_s
from slrig.capture.triggering import CaptureSession, capture_by_software, capture_by_wire, differs_from_request
from slrig.capture.verifier import Evidence
from slrig.devices import AppliedSettings, Camera, CameraSettings, Rig, Trigger
from slrig.errors import UnsupportedByDeviceError, of_camera
from slrig.model import PatternSequence, Shot


def capture(
    rig: Rig,
    sequence: PatternSequence,
    *,
    cancelled: Callable[[], bool] = lambda: False,
    timeout_s: float = 2.0,
    evidence: FrameChecks | None = None,
    refused: Callable[[RefusedFrame], None] = lambda _: None,
    since_ns: int | None = None,
    colour: Collection[str] = (),
) -> Iterator[Shot]:
    """Show every pattern, expose every camera to it, and yield the verified frames as they come.

    A frame that is stale, swapped, damaged or missing is captured again. If a later frame reveals that an earlier one,
    already yielded, is wrong, that one is rejected, and its pattern and camera are yielded again; the last frame
    counts.

    This is a generator: nothing starts before the first frame is requested, and the next frame is exposed while the
    consumer processes one. At the end, including errors, cancellation and an early stop of the consumer, the projector
    is dark and the cameras are disarmed. See `choose_triggers` for the triggers; if all cameras run freely and the
    latency was measured, they are read in parallel, see `slrig.capture.streaming`.

    rig : open devices; cameras without settings keep theirs. cancelled : called before each pattern and frame.
    timeout_s : time that a frame may take beyond its exposure. evidence : verifies the frames; pass one to read its
    summary afterwards. refused : called for each rejected exposure before it is repeated. since_ns : zero of
    `Shot.time_s` in the rig's clock, for several sequences in a row; None is the start of the first frame. colour :
    cameras whose white and black frames are also yielded in colour.

    Raises UnsupportedByDeviceError: a device does not support the settings, the size or a common trigger;
    FrameTimeoutError: a frame did not come three times; ScanEvidenceError: the frame of a pattern failed three times,
    with all causes; ScanCancelledError: `cancelled` returned True; DeviceError: a device failed or is gone.
    """
    if evidence is None:
        formats = {name: camera.info.format for name, camera in rig.cameras.items()}
        evidence = Evidence(sequence.patterns, formats, projector=sequence.projector)
    triggers = choose_triggers(rig)
    with ExitStack() as leaving:
        for camera in rig.cameras.values():
            leaving.callback(_suppress_errors, camera.disarm)
        reader = FrameReader(rig.cameras, rig.clock)
        leaving.callback(reader.stop)
        with ExitStack() as lit:
            # Switch the light off first.
            lit.callback(_suppress_errors, rig.projector.blank)
            applied = {name: _configure_camera(rig.cameras[name], name, each) for name, each in rig.settings.items()}
            session = CaptureSession(rig, sequence, applied, triggers, timeout_s, cancelled)
            retries = RetryPolicy(sequence, evidence, refused, since_ns=since_ns, colour=colour)
            if Trigger.HARDWARE in triggers.values():
                lit.callback(_suppress_errors, rig.projector.stop)
                yield from capture_by_wire(session, retries)
            elif (earliest_s := earliest_change_s(rig, triggers)) is not None:
                yield from capture_streaming(session, retries, reader, earliest_s)
            else:
                yield from capture_by_software(session, retries)
            lit.pop_all()
        # Outside the suppression, so that a projector that stays lit raises its error.
        rig.projector.blank()


def choose_triggers(rig: Rig) -> dict[str, Trigger]:
    """Choose the trigger of each camera: hardware for all of them, or else the best one of each.
    Raises UnsupportedByDeviceError: the rig has no camera, or a camera supports hardware triggers only and the other
    cameras or the projector do not.
    """
    if not rig.cameras:
        raise UnsupportedByDeviceError(f"rig '{rig.name}' has no camera; add a [[camera]] table to its rig file")
    declared = {name: camera.info.triggers for name, camera in rig.cameras.items()}
    if rig.projector.info.plays and all(Trigger.HARDWARE in triggers for triggers in declared.values()):
        return dict.fromkeys(declared, Trigger.HARDWARE)
    chosen: dict[str, Trigger] = {}
    for name, triggers in declared.items():
        if Trigger.SOFTWARE in triggers:
            chosen[name] = Trigger.SOFTWARE
        elif Trigger.FREE in triggers:
            chosen[name] = Trigger.FREE
        else:
            offered = ", ".join(sorted(triggers)) or "none"
            raise UnsupportedByDeviceError(
                f"camera '{name}' can be triggered by: {offered}; projector '{rig.projector.info.name}' "
                f"{'plays' if rig.projector.info.plays else 'does not play'} sequences by wire, and every camera "
                "must use the same trigger: use a camera with software trigger, or a projector and cameras with wire "
                "trigger"
            )
    return chosen


def _configure_camera(camera: Camera, name: str, settings: CameraSettings) -> AppliedSettings:
    """Configure a camera, and compare the values read back."""
    with of_camera(name):
        applied = camera.configure(settings)
    for setting, requested, actual, unit in (
        ("exposure", settings.exposure_s, applied.exposure_s, " s"),
        ("gain", settings.gain, applied.gain, ""),
    ):
        if differs_from_request(actual, requested):
            raise UnsupportedByDeviceError(
                f"camera '{name}': asked for {setting} {requested:.6g}{unit}, it uses {actual:.6g}{unit}; write a "
                f"value that the camera can use into the rig file ({actual:.6g}, for example)"
            )
    return applied


def _suppress_errors(action: Callable[[], None]) -> None:
    """Run an action and ignore its errors, so that the original error is raised and all devices are released."""
    with suppress(Exception):
        action()
