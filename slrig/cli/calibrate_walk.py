"""`slrig calibrate run`: one person, one board, a running service: shoot, read what to move, move, until the solve.

The service keeps every pose, so that the session can be left at any step and continued.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import cv2
import numpy as np
from rich.console import Console, Group
from rich.table import Column, Table
from rich.text import Text

from slrig.calibrate.report import rounded
from slrig.calibration import CELLS, MIN_HALVED_POSES, Board
from slrig.cli.display import answered, counted, plain_table, progress_shown
from slrig.cli.scan import still_missing
from slrig.client import Client
from slrig.errors import CalibrationStateError, ConfigError, PoseRefusedError, ServiceError, SolveRefusedError
from slrig.printable import printable

_COLOURS = {"good": "green", "usable": "yellow"}
_NAMES = {
    "fx": "focal x, px",
    "fy": "focal y, px",
    "cx": "principal x, px",
    "cy": "principal y, px",
}
_DIFFERENCES = {
    "focal_percent": "focal length, %",
    "principal_px": "principal point, px",
    "rotation_deg": "turned, °",
    "baseline_mm": "baseline, mm",
}
_MOST_REASONS, _MOST_REMARKS = 4, 3
_MOST_POSES = 6

_SHADES = ("", "bold #10301c on #8fd19e", "bold #10301c on #5cb57c", "bold white on #338857", "bold white on #1f6b41")
"""By how many poses cover a cell, the last for all above."""

_TARGET = "bold black on #f2c14e"
_EMPTY, _BEYOND = "·", " "


def outcome(pose: Mapping[str, Any]) -> str:
    """Outcome of a pose, in a word, by the service's description."""
    names: dict[bool | None, str] = {True: "accepted", False: "refused", None: pose["state"]}
    return names[pose["accepted"]]


def refused(session: Mapping[str, Any]) -> dict[str, str]:
    """By name, why the poses of a session were refused that were."""
    return {pose["name"]: pose["error"]["detail"] for pose in session["shot"] if pose["accepted"] is False}


def print_session(session: Mapping[str, Any]) -> None:
    """Print a calibration of a service: its result, or its coverage and the next step."""
    console = Console()
    board = "imported" if session["board"] is None else session["board"]["title"]
    heading = [session["id"], session["label"], f"rig '{session['rig']}'", board, session["state"]]
    console.print(Text(printable(" · ".join(each for each in heading if each)), style="bold"))
    if session["active"]:
        console.print("Scans use it.", style="green")
    if session["result"] is not None:
        console.print()
        print_result({**session["result"], "refused": refused(session)}, console)
    if session["error"] is not None:
        console.print(Text(session["error"]["detail"], style="red"))
    if session["coverage"] is not None and session["state"] != "solved":
        console.print()
        console.print(coverage_picture(session["coverage"], session["next_move"], {}))
        print_next_move(session["next_move"], console)


def print_comparison(found: Mapping[str, Any]) -> None:
    """Print the differences of the second of two calibrations from the first."""
    console = Console()
    for difference in found["words"]:
        console.print(_listed("·", difference))
    table = plain_table("second − first", *(Column(Text(name), justify="right") for name in found["devices"]))
    for key, label in _DIFFERENCES.items():
        table.add_row(label, *(_difference(device[key]) for device in found["devices"].values()))
    console.print()
    console.print(table)


def checked(document: Mapping[str, Any]) -> dict[str, Any]:
    """The check by odd and even poses of `pose_judging.summary`, with the figures to compare.

    Raises ConfigError where there is none: too few poses, or solved before solves were checked.
    """
    if document.get("odd_even") is None:
        message = (
            f"odd and even poses were not solved apart: expected {MIN_HALVED_POSES} poses or more, each half of which "
            f"determines a calibration, found {len(document['poses'])} that could be used. Add poses, and solve again; "
            "what was solved before solves were checked so is checked by that, too"
        )
        raise ConfigError(message)
    return {key: document[key] for key in ("odd_even", "expected", "poses", "outliers")}


def print_check(found: Mapping[str, Any]) -> None:
    """Print the result of `checked`."""
    console, halves = Console(), found["odd_even"]
    console.print(_listed("·" if halves["fits"] else "!", halves["words"]))
    console.print()
    table = plain_table(Column(style="bold", no_wrap=True), Column(), show_header=False)
    table.add_row("poses", f"{halves['poses'][0]} odd, {halves['poses'][1]} even")
    table.add_row("difference", f"{_mm(halves['difference_mm'])}, rms over the volume")
    table.add_row(
        "stated", f"{_mm(halves['stated_mm'])} (1 σ) for it; {_mm(found['expected']['point_mm'])} for all poses"
    )
    table.add_row("taken out", f"{rounded(halves['turn_deg'])}° and {_mm(halves['shift_mm'])}, which change no shape")
    console.print(table)


def print_result(document: Mapping[str, Any], console: Console) -> None:
    """Print the `pose_judging.summary` of a session, and which poses were `refused` or have `remarks`."""
    verdict = document["verdict"]
    grade = verdict["grade"].replace("_", " ")
    mark = (f" {grade.upper()} ", f"bold reverse {_COLOURS.get(verdict['grade'], 'red')}")
    # The summary without the grade, which is printed before it already.
    console.print(Text.assemble(mark, f"  {verdict['summary'].removeprefix(grade).lstrip(':; ')}"))
    for reason in verdict["reasons"][:_MOST_REASONS]:
        console.print(_listed("·", reason))
    more = len(verdict["reasons"]) - _MOST_REASONS
    if more > 0:
        console.print(f"   and {more} more, in the report and in --json", style="dim", highlight=False)
    for remark in verdict.get("remarks", ())[:_MOST_REMARKS]:
        console.print(_listed("·", remark), style="dim")
    console.print()
    console.print(_devices(document["devices"]))
    console.print()
    console.print(_figures(document))
    _print_named(console, "left out", document["outliers"])
    _print_named(console, "refused", document.get("refused", {}))
    remarks = {name: "; ".join(each) for name, each in document.get("remarks", {}).items() if each}
    _print_named(console, "remarks", remarks)


def figure_text(value: float | None, sigma: float | None) -> str:
    """A number with its standard deviation to two digits, and so many decimals itself.

    >>> figure_text(1810.4, 0.213), figure_text(0.0, 0.0), figure_text(None, None)
    ('1810.40 ± 0.21', '0 (held)', '–')
    """
    if value is None:
        return "–"
    if not sigma:
        return f"{value:g} (held)"
    digits = min(max(1 - math.floor(math.log10(sigma)), 0), 9)
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _devices(devices: Mapping[str, Mapping[str, Any]]) -> Table:
    # Three devices with all their lens terms just fit on 80 columns.
    heads = (Column("", no_wrap=True), *(Column(Text(name), justify="right") for name in devices))
    table = plain_table(*heads, padding=(0, 0, 0, 1))
    found = list(devices.values())
    table.add_row("rms, px", *(_px(device["rms_px"]) for device in found), style="bold")
    table.add_row("held out, px", *(_held_out(device) for device in found))
    table.add_row("noise alone, px", *(_px(device["stated_rms_px"]) for device in found))
    for key, name in _NAMES.items():
        table.add_row(name, *(figure_text(*device["values"][key]) for device in found))
    for term in dict.fromkeys(term for device in found for term in device["distortion"]):
        cells = (figure_text(*device["values"].get(term, (None, None))) for device in found)
        table.add_row(f"lens {term}", *cells)
    return table


def _figures(document: Mapping[str, Any]) -> Table:
    table = plain_table(Column(style="bold", no_wrap=True), Column(), show_header=False)
    expected = document["expected"]
    low, high = expected["volume_mm"]
    sides = " × ".join(f"{most - least:.0f}" for least, most in zip(low, high, strict=True))
    # Results on record from before one camera could be calibrated alone do not say across.
    way = "across the line of sight " if expected.get("across") else ""
    text = f"a point {_mm(expected['point_mm'])} (1 σ) {way}by the calibration"
    if expected["total_mm"] is not None:
        text += f", {_mm(expected['total_mm'])} with its noise"
    if expected["length_share"] is not None:
        text += f"; a length {rounded(1000 * expected['length_share'])} mm per metre"
    if expected.get("board_mm"):
        text += f"; of the point's error {_mm(expected['board_mm'])} by the size of the board"
    table.add_row("error", text)
    if (halves := document.get("odd_even")) is not None:
        apart = f"odd and even poses differ by {_mm(halves['difference_mm'])}, {halves['ratio']:.2f} × what is stated"
        table.add_row("check", f"{apart} for halves")
    table.add_row("volume", f"{sides} mm, where the board was held")
    for pair in document["baselines"]:
        length = figure_text(pair["length_mm"]["value"], pair["length_mm"]["sigma"])
        names = Text(f"{pair['first']} – {pair['second']}: {length} mm apart, at {pair['angle_deg']['value']:.1f}°")
        table.add_row("baseline", names)
    if document.get("board"):
        table.add_row("board", Text(document["board"]["words"].removeprefix("the board ")))
    left_out, refused = len(document["outliers"]), len(document.get("refused", {}))
    table.add_row("poses", f"{len(document['poses'])} used of {len(document['poses']) + left_out + refused}")
    return table


def _print_named(console: Console, heading: str, reasons: Mapping[str, str]) -> None:
    if not reasons:
        return
    heads = (Column(style="bold", no_wrap=True), Column(no_wrap=True), Column(overflow="fold"))
    table = plain_table(*heads, show_header=False)
    for at, (name, reason) in enumerate(list(reasons.items())[:_MOST_POSES]):
        table.add_row(heading if at == 0 else "", Text(name), Text(reason))
    if len(reasons) > _MOST_POSES:
        table.add_row("", f"and {len(reasons) - _MOST_POSES} more", "")
    console.print(table)


def _listed(mark: str, text: str) -> Table:
    table = Table.grid(padding=(0, 1))
    table.add_row(f" {mark}", Text(text, overflow="fold"))
    return table


def _px(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _mm(value: float | None) -> str:
    return "–" if value is None else f"{rounded(value)} mm"


def _held_out(device: Mapping[str, Any]) -> str:
    held, rms = device["held_out_rms_px"], device["rms_px"]
    if held is None or not rms:
        return "too few poses"
    return f"{held:.3f} (× {held / rms:.2f})"


def _difference(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return "–"
    if found["sigma"] is None:
        return f"{found['value']:+.4f}"
    return f"{found['value']:+.4f} ± {found['sigma']:.4f} ({found['sigmas']:.1f} σ)"


def coverage_picture(
    coverage: Mapping[str, Any], next_move: Mapping[str, Any] | None, sizes_px: Mapping[str, Sequence[int]]
) -> Group:
    """Cells of each device side by side, each with the number of poses in it; then what is missing.

    coverage, next_move : of a calibration session over HTTP. sizes_px : (width, height) by camera: with it the cells
    where the board should go next are marked.
    """
    table = Table.grid(padding=(0, 4, 0, 0))
    blocks = []
    for name, device in coverage.get("devices", {}).items():
        aim = _aim(next_move, name, sizes_px)
        blocks.append(Group(Text(name, style="bold"), *_rows(device, aim), *_covered(device)))
    if blocks:
        table.add_row(*blocks)
    wanted = Table.grid(padding=(0, 2))
    for at, each in enumerate(coverage.get("missing", ())):
        wanted.add_row(Text("wanted" if at == 0 else "", style="bold"), Text(each, style="dim"))
    return Group(table, Text(""), wanted) if wanted.row_count else Group(table)


def print_next_move(next_move: Mapping[str, Any] | None, console: Console) -> None:
    """Print what to do with the board next, and why."""
    if next_move is None:
        return
    heading, style = ("enough", "bold green") if next_move["enough"] else ("next", "bold #f2c14e")
    table = Table.grid(padding=(0, 2))
    table.add_row(Text(heading, style=style), Text(next_move["words"]))
    console.print(table)


def _rows(device: Mapping[str, Any], aim: Sequence[Sequence[bool]]) -> list[Text]:
    rows = []
    reachable = device.get("reachable")
    for row, counts in enumerate(device["cells"]):
        line = Text()
        for column, count in enumerate(counts):
            here = reachable is None or reachable[row][column]
            mark = str(min(int(count), 9)) if count else _EMPTY if here else _BEYOND
            aimed = bool(aim) and aim[row][column]
            style = _TARGET if aimed else _SHADES[min(int(count), len(_SHADES) - 1)]
            # Brackets where colours do not show.
            line.append(f"[{mark}]" if aimed else f" {mark} ", style=style or "dim")
        rows.append(line)
    return rows


def _covered(device: Mapping[str, Any]) -> list[Text]:
    about_across, about_down = device["tilted"]
    facts = [
        f"{device['share']:.0%} of the cells",
        f"{counted(device['depths'], 'distance')}, {counted(device['turns'], 'turn')}",
        f"tilted {about_across} × up-down, {about_down} × left-right",
    ]
    near, far = device["distance_mm"]
    if near is not None and far is not None:
        facts.append(f"{near:.0f} mm away" if f"{near:.0f}" == f"{far:.0f}" else f"{near:.0f} to {far:.0f} mm away")
    return [Text(each, style="dim") for each in facts]


def _aim(next_move: Mapping[str, Any] | None, name: str, sizes_px: Mapping[str, Sequence[int]]) -> list[list[bool]]:
    """For each cell whether its middle lies in the outline where the board should go; empty where that is unknown."""
    if next_move is None or next_move.get("camera") != name or name not in sizes_px:
        return []
    outline = next_move.get("outline_px") or []
    if len(outline) < 3:
        return []
    polygon = np.array(outline, np.float32)
    xs, ys = ((np.arange(CELLS) + 0.5) / CELLS * side for side in sizes_px[name])
    return [[cv2.pointPolygonTest(polygon, (x, y), measureDist=False) > 0 for x in xs] for y in ys]


FINAL = frozenset({"succeeded", "failed", "cancelled", "interrupted"})
_POLL_S = 0.2
_STATES = {"queued": "waiting for the rig", "capturing": "shooting", "computing": "reading the board"}
_KEYS = "[bold]Enter[/bold] shoot   [bold]s[/bold] solve   [bold]d[/bold] drop the last   [bold]q[/bold] leave"


def board_request(board: Board) -> dict[str, Any]:
    """A board as requests have it."""
    return {
        "kind": str(board.kind),
        "corners": [board.columns, board.rows],
        "square_mm": board.square_mm,
        "marker_mm": board.marker_mm,
        "dictionary": board.dictionary,
        "square_sigma": board.square_sigma,
        "aspect": board.aspect,
    }


def opened(client: Client, board: Board, *, label: str | None, projector: bool = True) -> dict[str, Any]:
    """A new session for a board; without the projector, of the cameras alone. Raises ServiceError."""
    return client.post("/calibration", {"board": board_request(board), "label": label, "projector": projector})


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
    """Walk through a session, with a person or the positioner. Ctrl-C leaves it to be resumed.

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
    """One calibration session, walked through."""

    def __init__(
        self,
        client: Client,
        session: Mapping[str, Any],
        console: Console,
        *,
        exposure_s: float | None = None,
        board_shape: str = "auto",
    ) -> None:
        self._client = client
        self._path: str = session["links"]["self"]
        self._id: str = session["id"]
        self._console = console
        self._exposure = {} if exposure_s is None else {"exposure_s": exposure_s}
        self._board_shape = board_shape

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
        self._show_coverage()
        while True:
            self._console.print()
            answer = answered(f"{_KEYS} > ", self._console)
            if answer == "q":
                break
            try:
                if answer == "":
                    pose = self._shot(self._client.post(f"{self._path}/pose", {**self._exposure, "if_busy": "queue"}))
                    # A pose that was not taken in changes nothing: what to do next is enough.
                    self._show_coverage(picture=pose["accepted"] is True)
                elif answer == "s":
                    self._solve()
                    if self._offer_activation():
                        return
                elif answer == "d":
                    self._drop_last()
                    self._show_coverage()
                else:
                    self._console.print(f"There is nothing on '{answer}'.", markup=False)
            except (ServiceError, PoseRefusedError, SolveRefusedError) as error:
                self._console.print(Text(str(error), style="red"))
        self.print_how_to_resume()

    def by_script(self, *, positions: Sequence[str], activate: bool) -> None:
        """Shoot the poses of the positioner, print each, solve, and if `activate` use the result for scans.

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
            shown = self._shot(pose)
            if shown["state"] in {"failed", "interrupted"} and shown["accepted"] is None:
                message = f"{shown['name']}: {shown['error']['detail']}"
                raise ServiceError(message)
            if shown["state"] == "cancelled":
                break
            pose = self._following(shown)
        self._show_coverage()
        self._solve()
        if activate:
            self._activate()

    def print_how_to_resume(self) -> None:
        """Print how to resume the walk."""
        self._console.print(
            f"The session is kept. Take it up again with: slrig calibrate run --id {self._id[:8]}", markup=False
        )

    def leave(self) -> None:
        """Cancel the poses under way: the service darkens the projector. Nothing is raised."""
        with suppress(ServiceError):
            for pose in self._session()["shot"]:
                if pose["state"] not in FINAL:
                    self._client.post(pose["links"]["cancel"], None)
        self.print_how_to_resume()

    def _session(self) -> dict[str, Any]:
        return self._client.get(self._path)

    def _shot(self, pose: Mapping[str, Any]) -> Mapping[str, Any]:
        """Follow a pose to its end, and print its findings."""
        with progress_shown() as display:
            while pose["state"] not in FINAL:
                progress = self._session().get("progress") or {}
                fraction, detail = progress.get("fraction", 0.0), progress.get("detail", "")
                display(f"{pose['name']}: {_STATES[pose['state']]}", fraction, detail)
                time.sleep(_POLL_S)
                pose = self._client.get(pose["links"]["self"])
            display(f"{pose['name']}: {outcome(pose)}", 1.0, "")
        print_pose(pose, self._console)
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

    def _show_coverage(self, *, picture: bool = True) -> None:
        """Show the coverage, and the next step."""
        session = self._session()
        if session["coverage"] is None:
            light = " and the projector's light falls on it" if session["patterns"]["codes"] else ""
            self._console.print(f"Hold the board where every camera sees it{light}, and keep it still.", markup=False)
            return
        self._console.print()
        if picture:
            self._console.print(coverage_picture(session["coverage"], session["next_move"], self._sizes_px()))
            self._console.print()
        print_next_move(session["next_move"], self._console)

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
        """Solve and print the result. Raises SolveRefusedError where the poses do not allow it."""
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
        print_result({**session["result"], "refused": refused(session)}, self._console)
        self._console.print()
        self._console.print(f"report: slrig calibrate export {self._id[:8]} report.html", markup=False, style="dim")

    def _offer_activation(self) -> bool:
        """Ask what to do with a solved calibration; True when the walk is over."""
        keys = "[bold]a[/bold] use it for scans   [bold]Enter[/bold] shoot more   [bold]q[/bold] leave > "
        answer = answered(keys, self._console)
        if answer == "a":
            self._activate()
        elif answer == "q":
            self.print_how_to_resume()
        return answer in {"a", "q"}

    def _activate(self) -> None:
        self._client.post(f"{self._path}/activate", None)
        self._console.print("Scans use this calibration from now on.", style="green")


def print_pose(pose: Mapping[str, Any], console: Console) -> None:
    """Print the findings of one pose: a line of figures per camera, then warnings, or why it was refused."""
    found = outcome(pose)
    colour = {"accepted": "green", "refused": "red", "failed": "red"}.get(found, "yellow")
    console.print(Text.assemble((pose["name"], "bold"), " ", (found, f"bold {colour}")))
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
    for key, form in (
        ("tilt_deg", "{:.0f}° tilted"),
        ("distance_mm", "{:.0f} mm away"),
        ("sharpness_px", "edges {:.1f} px soft"),
        ("moved_px", "moved {:.2f} px"),
    ):
        value = (answer.get(key) or {}).get(camera)
        if value is not None:
            facts.append(form.format(value))
    saturated = (answer.get("saturated") or {}).get(camera)
    if saturated:
        facts.append(f"{saturated:.1%} saturated")
    return facts
