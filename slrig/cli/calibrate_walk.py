"""`slrig calibrate run`: one person, one board, a running service: shoot, be told, move, until the solve.

The service keeps every pose, so that the walk can be left at any step and taken up again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from slrig.calibration import Board
from slrig.cli.calibration_screen import coverage_picture, outcome, refused, tell_next, tell_result
from slrig.cli.demo import still_missing
from slrig.cli.display import answered, progress_shown
from slrig.client import Client
from slrig.errors import CalibrationStateError, PoseRefusedError, ServiceError, SolveRefusedError

FINAL = frozenset({"succeeded", "failed", "cancelled", "interrupted"})
_POLL_S = 0.2
_STATES = {"queued": "waiting for the rig", "capturing": "shooting", "computing": "reading the board"}
_KEYS = "[bold]Enter[/bold] shoot   [bold]s[/bold] solve   [bold]d[/bold] drop the last   [bold]q[/bold] leave"


def opened(client: Client, board: Board, *, label: str | None, projector: bool = True) -> dict[str, Any]:
    """A new session for a board; without the projector, of the cameras alone. Raises ServiceError."""
    asked: dict[str, Any] = {
        "kind": str(board.kind),
        "corners": [board.columns, board.rows],
        "square_mm": board.square_mm,
        "marker_mm": board.marker_mm,
        "dictionary": board.dictionary,
        "square_sigma": board.square_sigma,
        "aspect": board.aspect,
    }
    return client.post("/calibration", {"board": asked, "label": label, "projector": projector})


def walk(
    client: Client,
    session: Mapping[str, Any],
    *,
    scripted: bool,
    positions: Sequence[str],
    activate: bool,
    exposure_s: float | None,
    board_shape: str = "auto",
) -> None:
    """Walk through a session, by a person's hand or by the positioner. Ctrl-C leaves it to be taken up again.

    Raises
    ------
    CalibrationStateError
        The session was imported and has no board.
    ServiceError, SolveRefusedError
        As `Walk` has it.
    """
    console = Console()
    if session["board"] is None:
        message = f"Calibration {session['id']} was imported and has no board. Open a new one: slrig calibrate run"
        raise CalibrationStateError(message)
    console.print(Text.assemble(("calibration ", "bold"), session["id"], f" · {session['board']['title']}"))
    walked = Walk(client, session, console, exposure_s=exposure_s, board_shape=board_shape)
    try:
        walked.await_rig()
        if scripted:
            walked.by_script(positions=positions, activate=activate)
        else:
            walked.manual()
    except KeyboardInterrupt:
        walked.leave()
        raise


class Walk:
    """One calibration session, walked through. `ask` prints a prompt and returns what the person typed."""

    def __init__(
        self,
        client: Client,
        session: Mapping[str, Any],
        console: Console,
        *,
        exposure_s: float | None = None,
        board_shape: str = "auto",
        ask: Callable[[str], str] | None = None,
    ) -> None:
        self._client = client
        self._path: str = session["links"]["self"]
        self._id: str = session["id"]
        self._console = console
        self._exposure = {} if exposure_s is None else {"exposure_s": exposure_s}
        self._board_shape = board_shape
        self._ask = console.input if ask is None else ask

    def await_rig(self) -> None:
        """Wait until the rig is open. Raises ServiceError where it cannot be opened."""
        if still_missing(self._client) is None:
            return
        with progress_shown() as display:
            while (missing := still_missing(self._client)) is not None:
                display("opening the rig", 0.0, missing)
                time.sleep(_POLL_S)
                # Refuses when the service is gone, which `still_missing` takes for one that is still starting.
                self._client.get("/rig")

    def manual(self) -> None:
        """Shoot when the person says so, until they solve and leave.

        Raises
        ------
        ServiceError
            The service refused, or is gone. The session is kept.
        """
        self._stand()
        while True:
            self._console.print()
            answer = answered(self._ask, f"{_KEYS} > ")
            if answer == "q":
                break
            try:
                if answer == "":
                    pose = self._shot(self._client.post(f"{self._path}/pose", {**self._exposure, "if_busy": "queue"}))
                    # A pose that was not taken in changes nothing: what to do next is enough.
                    self._stand(picture=pose["accepted"] is True)
                elif answer == "s":
                    self._solve()
                    if self._offer_activation():
                        return
                elif answer == "d":
                    self._drop_last()
                    self._stand()
                else:
                    self._console.print(f"There is nothing on '{answer}'.", markup=False)
            except (ServiceError, PoseRefusedError, SolveRefusedError) as error:
                self._console.print(Text(str(error), style="red"))
        self.tell_how_to_go_on()

    def by_script(self, *, positions: Sequence[str], activate: bool) -> None:
        """Have the positioner take its poses, tell each, solve, and if asked have scans use the result.

        Raises
        ------
        ServiceError
            The service refused, is gone, or the rig failed.
        SolveRefusedError
            The poses determine no calibration.
        """
        request = {"positions": list(positions), **self._exposure, "if_busy": "queue"}
        pose: Mapping[str, Any] | None = self._client.post(f"{self._path}/script", request)
        while pose is not None:
            told = self._shot(pose)
            if told["state"] in {"failed", "interrupted"} and told["accepted"] is None:
                message = f"{told['name']}: {told['error']['detail']}"
                raise ServiceError(message)
            if told["state"] == "cancelled":
                break
            pose = self._following(told)
        self._stand()
        self._solve()
        if activate:
            self._activate()

    def tell_how_to_go_on(self) -> None:
        """Say how the walk is taken up again."""
        self._console.print(
            f"The session is kept. Take it up again with: slrig calibrate run --id {self._id[:8]}", markup=False
        )

    def leave(self) -> None:
        """Have what is under way end early: the service darkens the projector. Nothing is raised."""
        with suppress(ServiceError):
            for pose in self._session()["shot"]:
                if pose["state"] not in FINAL:
                    self._client.post(pose["links"]["cancel"], None)
        self.tell_how_to_go_on()

    def _session(self) -> dict[str, Any]:
        return self._client.get(self._path)

    def _shot(self, pose: Mapping[str, Any]) -> Mapping[str, Any]:
        """Follow a pose to its end, and tell what was found of it."""
        with progress_shown() as display:
            while pose["state"] not in FINAL:
                progress = self._session().get("progress") or {}
                fraction, detail = progress.get("fraction", 0.0), progress.get("detail", "")
                display(f"{pose['name']}: {_STATES[pose['state']]}", fraction, detail)
                time.sleep(_POLL_S)
                pose = self._client.get(pose["links"]["self"])
            display(f"{pose['name']}: {outcome(pose)}", 1.0, "")
        tell_pose(pose, self._console)
        return pose

    def _following(self, pose: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """The script's next pose, or None when it has come to its end."""
        while True:
            session = self._session()
            later: list[dict[str, Any]] = [each for each in session["shot"] if each["number"] > pose["number"]]
            if later:
                return later[0]
            if not session["script"]:
                return None
            time.sleep(_POLL_S)

    def _stand(self, *, picture: bool = True) -> None:
        """Show what is covered, and what to do next."""
        session = self._session()
        if session["coverage"] is None:
            light = " and the projector's light falls on it" if session["patterns"]["codes"] else ""
            self._console.print(f"Hold the board where every camera sees it{light}, and keep it still.", markup=False)
            return
        self._console.print()
        if picture:
            self._console.print(coverage_picture(session["coverage"], session["next_move"], self._sizes_px()))
            self._console.print()
        tell_next(session["next_move"], self._console)

    def _sizes_px(self) -> dict[str, Sequence[int]]:
        return {camera["name"]: camera["size_px"] for camera in self._client.get("/rig")["cameras"]}

    def _drop_last(self) -> None:
        shot = [pose for pose in self._session()["shot"] if pose["accepted"]]
        if not shot:
            self._console.print("There is no accepted pose to drop.")
            return
        self._client.delete(shot[-1]["links"]["self"])
        self._console.print(f"{shot[-1]['name']} is dropped.", markup=False)

    def _solve(self) -> None:
        """Solve and tell the result. Raises SolveRefusedError where the poses do not allow it."""
        session = self._client.post(f"{self._path}/solve", {"board_shape": self._board_shape})
        with progress_shown() as display:
            while session["state"] == "solving":
                progress = session.get("progress") or {"stage": "solving", "fraction": 0.0, "detail": ""}
                display(progress["stage"], progress["fraction"], progress["detail"])
                time.sleep(_POLL_S)
                session = self._session()
            display(session["state"], 1.0, "")
        if session["state"] != "solved":
            raise SolveRefusedError(session["error"]["detail"])
        self._console.print()
        tell_result({**session["result"], "refused": refused(session)}, self._console)
        self._console.print()
        self._console.print(f"report: slrig calibrate export {self._id[:8]} report.html", markup=False, style="dim")

    def _offer_activation(self) -> bool:
        """Ask what to do with a solved calibration; True when the walk is over."""
        keys = "[bold]a[/bold] have scans use it   [bold]Enter[/bold] shoot more   [bold]q[/bold] leave > "
        answer = answered(self._ask, keys)
        if answer == "a":
            self._activate()
        elif answer == "q":
            self.tell_how_to_go_on()
        return answer in {"a", "q"}

    def _activate(self) -> None:
        self._client.post(f"{self._path}/activate", None)
        self._console.print("Scans use this calibration from now on.", style="green")


def tell_pose(pose: Mapping[str, Any], console: Console) -> None:
    """Print what was found of one pose: a line of figures per camera, then warnings, or why it was refused."""
    words = outcome(pose)
    colour = {"accepted": "green", "refused": "red", "failed": "red"}.get(words, "yellow")
    console.print(Text.assemble((pose["name"], "bold"), " ", (words, f"bold {colour}")))
    table = Table.grid(padding=(0, 2))
    answer = pose["answer"] or {}
    for camera, corners in (answer.get("corners_found") or {}).items():
        table.add_row("", Text(camera, style="bold"), Text(", ".join(_facts(answer, camera, corners))))
    for warning in answer.get("warnings", ()):
        table.add_row("", Text("note", style="yellow"), Text(warning))
    if pose["error"] is not None:
        table.add_row("", Text("why", style="red"), Text(pose["error"]["detail"], overflow="fold"))
    if table.row_count:
        console.print(table)


def _facts(answer: Mapping[str, Any], camera: str, corners: int) -> list[str]:
    facts = [f"{corners} of {answer['corners_expected']} corners"]
    for key, words in (
        ("tilt_deg", "{:.0f}° tilted"),
        ("distance_mm", "{:.0f} mm away"),
        ("sharpness_px", "edges {:.1f} px soft"),
        ("moved_px", "moved {:.2f} px"),
    ):
        value = (answer.get(key) or {}).get(camera)
        if value is not None:
            facts.append(words.format(value))
    saturated = (answer.get("saturated") or {}).get(camera)
    if saturated:
        facts.append(f"{saturated:.1%} saturated")
    return facts
