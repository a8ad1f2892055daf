"""Software synchronisation: show a pattern, expose to it, and judge its frames while the next one is exposed.

The next pattern is shown only when every camera's exposure has ended: its frame has been read, or did not come in time.
So a pattern takes the wait for its light, the exposure, the read-out of the slowest camera, and hardly anything else.

The wait for light is what `Projector.show` takes, typically `ProjectorInfo.latency_s`. On a screen it is the wait for
the next refresh, half a refresh on average, and the display's own delay, often one to three refreshes more. For a
projector that holds its patterns and is told their numbers over a wire it is the time of one command and its answer,
and of the switch, a few milliseconds. For a measured rig what the latency test found beyond that comes on top.
"""

from __future__ import annotations

from collections.abc import Iterator

from slrig.capture.retry_policy import RetryPolicy
from slrig.capture.session import Session
from slrig.devices import Shown, Trigger
from slrig.errors import FrameTimeoutError
from slrig.model import Frame, Shot

_Taken = tuple[int, str, Frame | str, str | None]
"""Pattern and camera, what it gave or why nothing came in time, and what the frame says against itself."""


def software_triggered(session: Session, retries: RetryPolicy) -> Iterator[Shot]:
    """Show each pattern, and again where frames failed, until every frame counts. Raises as `RetryPolicy` does."""
    rig = session.rig
    rig.projector.load(session.sequence)
    for name, camera in rig.cameras.items():
        camera.arm(retries.most_shots, session.triggers[name])
    ahead = iter(range(len(session.sequence)))
    last: dict[str, Frame] = {}
    waiting: list[_Taken] = []
    while True:
        if retries.again:
            # First what failed, in order.
            index = min(retries.again)
            names = retries.again.pop(index)
        elif (index := next(ahead, -1)) >= 0:
            names = list(rig.cameras)
        elif waiting:
            yield from _judged(retries, waiting)
            waiting = []
            continue
        else:
            return
        session.stop_if_cancelled(index)
        shown = rig.projector.show(index)
        stable_ns = session.settled_ns(shown)
        for name in names:
            retries.begin(name, index)
            if session.triggers[name] is Trigger.SOFTWARE:
                rig.cameras[name].trigger()
        # The sensors are at work now: there is time for the frames before.
        yield from _judged(retries, waiting)
        waiting = [_taken(session, name, shown, stable_ns, last) for name in names]


def _judged(retries: RetryPolicy, taken: list[_Taken]) -> Iterator[Shot]:
    for index, name, frame, fault in taken:
        if isinstance(frame, str):
            retries.missed(name, index, frame)
        elif (shot := retries.took(index, frame, fault)) is not None:
            yield shot


def _taken(session: Session, name: str, shown: Shown, after_ns: int, last: dict[str, Frame]) -> _Taken:
    session.stop_if_cancelled(shown.index)
    timeout_s = session.patience_s(name)
    try:
        frame = session.read(name, after_ns, timeout_s)
    except FrameTimeoutError as error:
        # Frames that are rendered or replayed have no cable.
        computed = session.rig.cameras[name].info.limits.computed
        cause = (
            f"no frame came within {timeout_s:.3f} s of its light, visible since {shown.t_visible_ns} ns "
            f"± {shown.t_err_ns} ns ({error}); "
            + ("is the machine busy?" if computed else "check the camera's cable, bandwidth and trigger")
        )
        return shown.index, name, cause, None
    fault = session.own_fault(frame, after_ns, last.get(name))
    last[name] = frame
    return shown.index, name, frame, fault
