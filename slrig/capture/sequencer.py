"""Playing a pattern sequence on a rig: every frame lies wholly within its pattern's light, and the rig ends dark."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, suppress

from slrig.bundle import RefusedFrame
from slrig.capture.hardware_trigger import Session, differ, hardware_triggered, software_triggered
from slrig.capture.streaming import FrameReader, earliest_change_s, streamed
from slrig.capture.verifier import Evidence, RetryPolicy
from slrig.devices import AppliedSettings, Camera, CameraSettings, Rig, Trigger
from slrig.errors import UnsupportedByDeviceError
from slrig.model import PatternSequence, Shot


def capture(
    rig: Rig,
    sequence: PatternSequence,
    *,
    cancelled: Callable[[], bool] = lambda: False,
    timeout_s: float = 2.0,
    evidence: Evidence | None = None,
    refused: Callable[[RefusedFrame], None] = lambda _: None,
    since_ns: int | None = None,
    colour: Collection[str] = (),
) -> Iterator[Shot]:
    """Show every pattern, expose every camera to it, and yield the frames that are what they claim, as they come.

    A frame that is stale, swapped or damaged, or does not come, is shot again. Which frame is wrong may show only when
    a later one contradicts it: then a frame that was yielded already is refused, and its pattern and camera are yielded
    once more. The last one counts.

    A generator: nothing moves before the first frame is asked for. However it ends (the last frame, an error, a
    cancel, a consumer that stops or is interrupted) the projector is dark and the cameras are disarmed afterwards.
    Wire triggers are preferred to software triggers, these to free-running cameras, among what all devices declare.
    Free-running cameras before a projector of measured latency are read beside it: see `slrig.capture.streaming`.
    What the consumer does with a frame takes place while the next one is exposed.

    rig : open devices; cameras without settings are left as they are. cancelled : asked before every pattern and every
    frame. timeout_s : how long a frame may take beyond its exposure. evidence : where the frames are judged; give one
    to read its summary afterwards. refused : told of every exposure that does not count, before another one takes its
    place. since_ns : when times count from, by the rig's clock, for one sequence of several; None is the start of the
    first frame's exposure. colour : cameras whose white and black frames are yielded in colour, too.

    Raises UnsupportedByDeviceError: a device cannot do what is asked (settings, size, no trigger in common);
    FrameTimeoutError: a frame did not come, three times (names pattern, camera, times); ScanEvidenceError: the frame of
    a pattern failed three times (it was exposed too early, came twice, or contradicts the others; tells all three
    causes); ScanCancelledError: `cancelled` said so; DeviceError: a device failed or is gone.
    """
    if evidence is None:
        evidence = Evidence(sequence.patterns, {name: camera.info.format for name, camera in rig.cameras.items()})
    triggers = choose_triggers(rig)
    with ExitStack() as leaving:
        for camera in rig.cameras.values():
            leaving.callback(_whatever_happens, camera.disarm)
        reader = FrameReader(rig.cameras)
        leaving.callback(reader.stop)
        with ExitStack() as lit:
            # The light goes off before anything else is tried.
            lit.callback(_whatever_happens, rig.projector.blank)
            session = Session(rig, sequence, _configure(rig), triggers, timeout_s, cancelled)
            retries = RetryPolicy(sequence, evidence, refused, since_ns=since_ns, colour=colour)
            if Trigger.HARDWARE in triggers.values():
                lit.callback(_whatever_happens, rig.projector.stop)
                yield from hardware_triggered(session, retries)
            elif (earliest_s := earliest_change_s(rig, triggers)) is not None:
                yield from streamed(session, retries, reader, earliest_s)
            else:
                yield from software_triggered(session, retries)
            lit.pop_all()
        # Here a projector that will not go dark is an error of its own, not a footnote to another one.
        rig.projector.blank()


def choose_triggers(rig: Rig) -> dict[str, Trigger]:
    """Choose what starts each camera's exposures: hardware for all of them, or else the best that each can do.
    Raises UnsupportedByDeviceError: the rig has no camera, or a camera can be triggered by wire only and the others or
    the projector cannot.
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
                "must take part: use a camera with software trigger, or a projector and cameras with wire trigger"
            )
    return chosen


def _configure(rig: Rig) -> dict[str, AppliedSettings]:
    """Set every camera that has settings, and compare what it reads back."""
    return {name: _apply(rig.cameras[name], name, settings) for name, settings in rig.settings.items()}


def _apply(camera: Camera, name: str, settings: CameraSettings) -> AppliedSettings:
    applied = camera.configure(settings)
    for what, asked, got, unit in (
        ("exposure", settings.exposure_s, applied.exposure_s, " s"),
        ("gain", settings.gain, applied.gain, ""),
    ):
        if differ(got, asked):
            raise UnsupportedByDeviceError(
                f"camera '{name}': asked for {what} {asked:.6g}{unit}, it uses {got:.6g}{unit}; write a value that "
                f"the camera can use into the rig file ({got:.6g}, for example)"
            )
    return applied


def _whatever_happens(action: Callable[[], None]) -> None:
    """Do it as far as the device lets; the error that led here matters more than a device that is gone."""
    # Drivers raise what the operating system gives them, too, and no device may keep the next one from its turn.
    with suppress(Exception):
        action()
