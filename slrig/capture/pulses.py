"""The least time from one trigger pulse to the next that all cameras of a rig follow, measured by playing to them."""

from __future__ import annotations

from contextlib import suppress

from slrig.capture.triggering import SLOWER, CaptureSession, play_times_s
from slrig.devices import Rig, Trigger
from slrig.errors import FrameTimeoutError
from slrig.model import PatternSequence

_TIMEOUT_S = 1.0
_HALVINGS = 4


def measure_trigger_period(rig: Rig, sequence: PatternSequence) -> tuple[float, float]:
    """Play a sequence by wire and count frames. Return the period that scans try first, and the least that works, s.

    The two are equal if cameras follow the rate that they state. Else the least is found to a sixteenth of the first.
    Afterwards the projector is dark and the cameras are disarmed.
    Raises FrameTimeoutError: they miss pulses even when these come four times more slowly; DeviceError.
    """
    applied = {name: rig.cameras[name].configure(each) for name, each in rig.settings.items()}
    triggers = dict.fromkeys(rig.cameras, Trigger.HARDWARE)
    session = CaptureSession(rig, sequence, applied, triggers, _TIMEOUT_S, lambda: False)
    lit_s, asked_s = play_times_s(session)
    try:
        rig.projector.load(sequence)
        # Twice, because a single frame may be lost for other causes.
        if any(_is_followed(session, lit_s, asked_s) for _ in range(2)):
            return asked_s, asked_s
        works_s = next((each * asked_s for each in SLOWER if _is_followed(session, lit_s, each * asked_s)), None)
        if works_s is None:
            message = (
                f"cameras miss trigger pulses even when these come every {max(SLOWER) * asked_s:.6g} s; check the "
                "trigger cable, its level and edge, and filters of the cameras' inputs"
            )
            raise FrameTimeoutError(message)
        fails_s = works_s - asked_s
        for _ in range(_HALVINGS):
            middle_s = (fails_s + works_s) / 2
            if _is_followed(session, lit_s, middle_s):
                works_s = middle_s
            else:
                fails_s = middle_s
        return asked_s, works_s
    finally:
        with suppress(Exception):
            rig.projector.blank()


def _is_followed(session: CaptureSession, lit_s: float, period_s: float) -> bool:
    """True if every camera gives one frame per pattern."""
    rig = session.rig
    try:
        for camera in rig.cameras.values():
            camera.arm(len(session.sequence) + 1, Trigger.HARDWARE)
        rig.projector.play(lit_s, period_s)
        for name in rig.cameras:
            after_ns = 0
            for _ in session.sequence.patterns:
                after_ns = session.read(name, after_ns, period_s + session.frame_timeout_s(name)).t_end_ns
    except FrameTimeoutError:
        return False
    finally:
        rig.projector.stop()
        for camera in rig.cameras.values():
            camera.disarm()
    return True
