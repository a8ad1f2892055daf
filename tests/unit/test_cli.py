"""The command line: its exit codes, what it says, and how its client bears a bad connection."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from typer.testing import CliRunner

from slrig.api.schemas import ScanRequest
from slrig.cli.commands import INTERRUPTED, app
from slrig.cli.demo import remove_earlier, still_missing
from slrig.cli.display import ProgressDisplay, print_json, print_table
from slrig.cli.options import Service
from slrig.cli.quality import quality_lines
from slrig.cli.scan import scan_with, series_with, tell_result
from slrig.client import Client, ScanJob
from slrig.errors import ScanCancelledError, ServiceError, SlrigError
from slrig.scan.offered import MEDIA_TYPES

SCAN = {
    "id": "5f",
    "state": "succeeded",
    "summary": {
        "mesh": {"figures": {"vertices": 1200, "triangles": 2301}, "sigma_mm": {"p50": 0.0079}},
        "truth": {"rms_mm": 0.0123, "complete_0.3mm": 0.97},
    },
    "error": None,
    "links": {
        "self": "/scan/5f",
        "events": "/scan/5f/events",
        "cancel": "/scan/5f/cancel",
        "files": {"mesh.ply": "/scan/5f/mesh.ply"},
    },
}
Handler = Callable[[httpx2.Request], httpx2.Response]


def client_of(handler: Handler, pauses: list[float] | None = None) -> Client:
    pause = (lambda _s: None) if pauses is None else pauses.append
    return Client("http://127.0.0.1:1", "key", pause=pause, transport=httpx2.MockTransport(handler))


def stream(*events: dict[str, Any]) -> bytes:
    """Server-sent events as they travel."""
    blocks = []
    for event in events:
        data = {name: value for name, value in event.items() if name not in {"id", "kind"}}
        blocks.append(f"id: {event['id']}\nevent: {event['kind']}\ndata: {json.dumps(data)}\n\n")
    return "".join(blocks).encode()


def event_answer(content: bytes | Iterator[bytes]) -> httpx2.Response:
    return httpx2.Response(200, headers={"Content-Type": "text/event-stream"}, content=content)


def ignore(_stage: str, _fraction: float, _detail: str) -> None:
    return


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys, slrig.cli\n"
        "heavy = {'numba', 'numpy', 'cv2', 'fastapi', 'sqlalchemy', 'scipy', 'trimesh', 'pydantic', 'httpx2', 'rich'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert found.stdout.strip() == "[]"


def test_error_of_ours_is_one_screen_and_exit_code_2(tmp_path: Path) -> None:
    for arguments in (
        ["serve", str(tmp_path / "absent.toml")],
        ["reconstruct", str(tmp_path / "absent"), "--output", str(tmp_path / "out")],
        ["scan", "--url", "http://127.0.0.1:9", "--output", str(tmp_path / "out")],
        ["scan", "--url", "http://127.0.0.1:9", "--key-file", str(tmp_path / "absent.key")],
        ["demo", str(tmp_path / "absent.toml"), "--output", str(tmp_path / "out")],
        ["conform", str(tmp_path / "absent.toml")],
    ):
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 2, arguments
        assert result.stderr.count("error: ") == 1, arguments
        assert "Traceback" not in result.stderr, arguments
        assert len(result.stderr.splitlines()) < 20, arguments
        # Nothing is compiled for a mistake.
        assert "preparing" not in result.stderr, arguments
    assert not (tmp_path / "out").exists()


def test_unknown_option_is_exit_code_2() -> None:
    assert CliRunner().invoke(app, ["scan", "--colour", "red"]).exit_code == 2


def test_interruption_is_exit_code_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(**_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("slrig.cli.devices.list_devices", interrupted)
    assert CliRunner().invoke(app, ["devices"]).exit_code == INTERRUPTED


def test_devices_lists_the_rendered_rig_for_people_and_programs() -> None:
    shown = CliRunner().invoke(app, ["devices"])
    assert shown.exit_code == 0
    assert "simulated" in shown.stdout
    document = json.loads(CliRunner().invoke(app, ["devices", "--json"]).stdout)
    assert ("head", "simulated", None) in [
        (driver["kind"], driver["name"], driver["fault"]) for driver in document["drivers"]
    ]


def test_key_comes_from_a_file_or_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def sent(key_file: Path | None) -> str | None:
        with Service(key_file=key_file).client() as client:
            return client.connection.http.headers.get("Authorization")

    monkeypatch.setenv("SLRIG_API_KEY", "from the environment")
    assert sent(None) == "Bearer from the environment"
    (tmp_path / "key").write_text("from a file\n")
    assert sent(tmp_path / "key") == "Bearer from a file"
    monkeypatch.delenv("SLRIG_API_KEY")
    assert sent(None) is None


def ready_answer(status: int, rig: str, *pending: str) -> httpx2.Response:
    checks = {"rig": rig, "reconstruction": "preparing kernels, first time only: 3 of 56"}
    return httpx2.Response(status, json={"detail": "", "checks": checks, "pending": [*pending, "reconstruction"]})


def test_demo_waits_for_the_rig_and_for_nothing_else() -> None:
    with client_of(lambda _request: ready_answer(503, "tracing light, 30 %", "rig")) as client:
        assert still_missing(client) == "tracing light, 30 %; preparing kernels, first time only: 3 of 56"
    with client_of(lambda _request: ready_answer(503, "ok")) as client:
        assert still_missing(client) is None

    def absent(_request: httpx2.Request) -> httpx2.Response:
        message = "refused"
        raise httpx2.ConnectError(message)

    with client_of(absent) as client:
        assert still_missing(client) == "the service is starting"


def test_demo_tells_at_once_why_the_rig_cannot_be_opened() -> None:
    with (
        client_of(lambda _request: ready_answer(503, "scene 'tabel.toml': expected a readable file")) as client,
        pytest.raises(ServiceError, match=r"The rig cannot be opened: scene 'tabel\.toml': expected a readable file"),
    ):
        still_missing(client)


def test_demo_removes_its_own_earlier_scans_and_no_others() -> None:
    pages = {
        "/scan?limit=200": {"scans": [scan_of("new"), scan_of("old")], "next": "/scan?cursor=7&limit=2"},
        "/scan?cursor=7&limit=2": {
            "scans": [scan_of("other-rig", rig="bench"), scan_of("kept", label="cup"), scan_of("older")],
            "next": None,
        },
    }
    deleted: list[str] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        if request.method == "DELETE":
            deleted.append(request.url.path)
            return httpx2.Response(204)
        return httpx2.Response(200, json=pages[request.url.raw_path.decode()])

    with client_of(handler) as client:
        assert remove_earlier(client, scan_of("new")) == 2
    assert deleted == ["/scan/old", "/scan/older"]


def scan_of(name: str, *, rig: str = "sphere", label: str = "demo") -> dict[str, Any]:
    return {"id": name, "rig": rig, "label": label, "links": {"self": f"/scan/{name}"}}


def test_reconstruction_option_out_of_range_is_told_by_the_plan(tmp_path: Path) -> None:
    for option, value, words in (
        ("--depth-edge-ratio", "1", "depth_edge_ratio: expected a finite number above 1, found 1;"),
        ("--max-code-gap", "0", "max_code_gap: expected 1 or more, found 0;"),
        ("--flip-rule", "dyer", "flip_rule: expected constrained or delaunay, found 'dyer';"),
    ):
        result = CliRunner().invoke(
            app, ["reconstruct", str(tmp_path), "--output", str(tmp_path / "out"), option, value]
        )
        assert (result.exit_code, words in result.stderr) == (2, True), result.stderr


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ([], {}),
        (["--keep-holes"], {"keep_holes": True}),
        (["--close-holes", "--raw-boundary"], {"keep_holes": False, "smooth_boundary": False}),
        (["--smooth-boundary", "--flip-rule", "delaunay"], {"smooth_boundary": True, "flip_rule": "delaunay"}),
        (["--depth-edge-ratio", "9", "--max-code-gap", "2"], {"depth_edge_ratio": 9.0, "max_code_gap": 2}),
        (["--axis", "row"], {"axis": "row"}),
    ],
)
def test_a_scan_asks_the_service_for_the_options_that_were_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], wanted: dict[str, Any]
) -> None:
    asked: list[dict[str, Any]] = []

    def scanned(_client: Client, request: dict[str, Any], _output: Path, **_: object) -> dict[str, Any]:
        asked.append(request)
        return SCAN

    monkeypatch.setattr("slrig.cli.scan.scan_with", scanned)
    result = CliRunner().invoke(app, ["scan", "--output", str(tmp_path), *arguments])
    assert result.exit_code == 0, result.output
    assert asked[0]["reconstruction"] == wanted
    # The service understands what it is asked.
    assert ScanRequest.model_validate_json(json.dumps(asked[0])).reconstruction.model_dump(exclude_none=True) == wanted


class Walk:
    """A service that takes one scan to the given end."""

    def __init__(self, state: str, error: dict[str, Any] | None = None) -> None:
        self.scan = {**SCAN, "state": state, "error": error}
        self.cancelled = False

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        path = request.url.path
        if path == "/scan":
            return httpx2.Response(202, json=SCAN)
        if path.endswith("/events"):
            if request.headers["Last-Event-ID"] != "0":
                return httpx2.Response(204)
            return event_answer(
                stream(
                    {"id": 1, "kind": "state", "state": "queued"},
                    {"id": 2, "kind": "progress", "stage": "capture", "fraction": 0.25, "detail": "frame 1 of 4"},
                    {"id": 3, "kind": "state", "state": self.scan["state"]},
                )
            )
        if path.endswith("/cancel"):
            self.cancelled = True
            return httpx2.Response(202, json=self.scan)
        if path.endswith("/mesh.ply"):
            return httpx2.Response(200, content=b"ply")
        return httpx2.Response(200, json=self.scan)


def test_scan_is_followed_and_fetched(tmp_path: Path) -> None:
    told: list[tuple[str, float]] = []
    with client_of(Walk("succeeded")) as client:
        scan = scan_with(
            client,
            {},
            tmp_path / "out",
            files=("mesh.ply",),
            display=lambda stage, fraction, _detail: told.append((stage, fraction)),
        )
    assert (tmp_path / "out" / "mesh.ply").read_bytes() == b"ply"
    assert told == [
        ("waiting for the rig", 0.0),
        ("capture", 0.25),
        ("fetching mesh.ply", 1.0),
        ("done", 1.0),
    ]
    assert quality_lines(scan["summary"]) == [
        "size      1,200 vertices, 2,301 triangles",
        "stated    standard deviation of a point 0.0079 mm (median)",
        "error     rms 0.0123 mm against the known truth, 97.0% of the visible surface within 0.3 mm",
    ]


def test_every_file_that_was_fetched_is_told_with_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = ("mesh.ply", "mesh.obj", "rejected-left.png")
    for name in (*files, "report.json"):
        (tmp_path / name).write_bytes(b"of this scan or of an earlier one")
    tell_result({}, tmp_path, files=files)
    told = capsys.readouterr().out.splitlines()
    assert [line.split() for line in told] == [
        ["mesh", str(tmp_path / "mesh.ply")],
        ["mesh.obj", str(tmp_path / "mesh.obj")],
        ["rejected-left.png", str(tmp_path / "rejected-left.png")],
    ]


def test_failed_scan_tells_the_cause(tmp_path: Path) -> None:
    walk = Walk("failed", {"detail": "No stripe was found."})
    with client_of(walk) as client, pytest.raises(ServiceError, match=r"Scan 5f failed: No stripe was found\."):
        scan_with(client, {}, tmp_path / "out", display=ignore)
    assert not (tmp_path / "out").exists()


def test_scan_cancelled_elsewhere_is_told_as_such(tmp_path: Path) -> None:
    with client_of(Walk("cancelled")) as client, pytest.raises(ScanCancelledError):
        scan_with(client, {}, tmp_path / "out", display=ignore)


def test_a_series_goes_on_after_a_failure_and_tells_of_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ends = {"1": Walk("succeeded"), "2": Walk("failed", {"detail": "No stripe was found."}), "3": Walk("succeeded")}
    asked: list[dict[str, Any]] = []

    def numbered(scan: dict[str, Any], number: str) -> dict[str, Any]:
        here = f"/scan/{number}"
        links = {**scan["links"], "self": here, "events": f"{here}/events", "series": "/scan/series/9"}
        return {**scan, "id": number, "links": {**links, "files": {"mesh.ply": f"{here}/mesh.ply"}}}

    def answer(request: httpx2.Request) -> httpx2.Response:
        path = request.url.path
        if path == "/scan":
            asked.append(json.loads(request.content))
            return httpx2.Response(202, json=numbered(SCAN, "1"))
        if path == "/scan/series/9":
            return httpx2.Response(200, json={"scans": [numbered(SCAN, number) for number in ends]})
        number = path.split("/")[2]
        found = ends[number](request)
        is_scan = found.headers.get("Content-Type") == "application/json"
        return httpx2.Response(200, json=numbered(found.json(), number)) if is_scan else found

    request = {"repeat": 3, "every_s": 2.0}
    assert ScanRequest.model_validate(request).repeat == 3
    with client_of(answer) as client, pytest.raises(ServiceError, match=r"^1 of 3 scans did not succeed: 002\.$"):
        series_with(client, request, tmp_path, files=("mesh.ply",), display=ignore)
    assert asked == [request]
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.ply")) == [
        "001/mesh.ply",
        "003/mesh.ply",
    ]
    rows = [line.split(maxsplit=3) for line in capsys.readouterr().out.splitlines()]
    assert rows[1] == ["001", "2,301", "0.0079"]
    assert rows[2][0] == "002"
    assert "No stripe was found." in " ".join(rows[2])


def test_a_series_that_is_broken_off_is_cancelled_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    posted: list[str] = []

    def answer(request: httpx2.Request) -> httpx2.Response:
        started = {**SCAN, "links": {**SCAN["links"], "series": "/scan/series/9"}}  # type: ignore[dict-item]
        posted.extend([request.url.path] if request.method == "POST" else [])
        return httpx2.Response(202, json={**started, "scans": [started, started]})

    def interrupted(_job: object, _told: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ScanJob, "result", interrupted)
    with client_of(answer) as client, pytest.raises(KeyboardInterrupt):
        series_with(client, {"repeat": 2}, tmp_path, display=ignore)
    assert posted == ["/scan", "/scan/series/9/cancel"]


def test_file_that_this_scan_has_not_is_told_before_anything_is_fetched(tmp_path: Path) -> None:
    with client_of(Walk("succeeded")) as client, pytest.raises(ServiceError, match=r"no mesh\.obj\. It has: mesh\.ply"):
        scan_with(client, {}, tmp_path / "out", files=("mesh.ply", "mesh.obj"), display=ignore)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "cameras", "told"),
    [
        ("mesh.e57", ["left"], "a scan has no mesh.e57. There are: mesh.ply, "),
        (
            "rejected-top.png",
            ["left"],
            "There are: .*, rejected-left.png, causes-left.png, points-left.npz, .*bundle.zip",
        ),
        ("rejected-top.png", [], None),
        ("rejected-left.png", ["left"], None),
        ("causes-left.png", ["left"], None),
        ("causes-top.png", ["left"], "no causes-top.png"),
        ("points-left.npz", ["left"], None),
        ("points-left.e57", ["left"], None),
        ("scan.mcap", ["left"], None),
        ("points-top.npz", ["left"], "no points-top.npz"),
        ("bundle.zip", ["left"], None),
    ],
)
def test_name_that_no_scan_has_is_refused_before_one_is_shot(
    tmp_path: Path, name: str, cameras: list[str], told: str | None
) -> None:
    started: list[httpx2.Request] = []

    def handler(request: httpx2.Request) -> httpx2.Response:
        if request.url.path == "/rig":
            return httpx2.Response(200, json={"cameras": [{"name": each} for each in cameras]})
        started.append(request)
        return httpx2.Response(409, json={"detail": "the rig is held"})

    with client_of(handler) as client, pytest.raises(SlrigError, match=told or "the rig is held"):
        scan_with(client, {}, tmp_path / "out", files=("mesh.ply", name), display=ignore)
    assert (len(started) == 0) == (told is not None)


def test_name_that_no_scan_has_is_exit_code_2_without_a_service(tmp_path: Path) -> None:
    arguments = ["scan", "--url", "http://127.0.0.1:9", "--output", str(tmp_path), "--file", "mesh.e57"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert all(f" {name}," in result.stderr for name in MEDIA_TYPES)


@pytest.mark.parametrize(("busy", "fetched"), [(2, True), (1000, False)])
def test_a_file_that_has_to_wait_is_asked_for_again(tmp_path: Path, busy: int, fetched: bool) -> None:
    asked, pauses = [], list[float]()

    def handler(request: httpx2.Request) -> httpx2.Response:
        asked.append(request.url.path)
        if len(asked) <= busy:
            return httpx2.Response(503, headers={"Retry-After": "5"}, json={"detail": "Another job is computed."})
        return httpx2.Response(200, content=b"npz")

    target = tmp_path / "points-left.npz"
    with client_of(handler, pauses) as client:
        if fetched:
            client.fetch("/scan/1/points-left.npz", target)
        else:
            with pytest.raises(ServiceError, match="Another job is computed"):
                client.fetch("/scan/1/points-left.npz", target)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"npz"] * fetched
    assert pauses == [5.0] * (len(asked) - 1)
    assert 2 < len(asked) < 50


def test_ctrl_c_cancels_the_scan_on_the_service(tmp_path: Path) -> None:
    walk = Walk("succeeded")

    def interrupt(stage: str, _fraction: float, _detail: str) -> None:
        if stage == "capture":
            raise KeyboardInterrupt

    with client_of(walk) as client, pytest.raises(KeyboardInterrupt):
        scan_with(client, {}, tmp_path / "out", display=interrupt)
    assert walk.cancelled


def test_progress_off_a_terminal_is_one_line_per_stage() -> None:
    stream_of_text = io.StringIO()
    display = ProgressDisplay(stream_of_text)
    display.start()
    for stage, fraction in (("capture", 0.0), ("capture", 0.3), ("decode", 0.5), ("done", 1.0)):
        display(stage, fraction, "")
    display.stop()
    lines = stream_of_text.getvalue().splitlines()
    assert [line.split("  ")[-1] for line in lines] == ["capture", "decode", "done"]
    assert [line.split("%")[0].split()[-1] for line in lines] == ["0", "50", "100"]


def test_a_stage_that_goes_on_without_a_word_is_told_again_off_a_terminal() -> None:
    class Lines(io.StringIO):
        third = threading.Event()

        def flush(self) -> None:
            if self.getvalue().count("\n") == 3:
                self.third.set()

    stream = Lines()
    display = ProgressDisplay(stream, every_s=0.01)
    display.start()
    display("preparing kernels", 0.0, "41 of 56")
    assert stream.third.wait(10)
    display.stop()
    lines = stream.getvalue().splitlines()
    assert len(lines) >= 3
    assert all(line.endswith("41 of 56") for line in lines)


@pytest.mark.parametrize("terminal", [False, True])
def test_an_error_beside_the_progress_stays_and_does_nothing_to_the_terminal(terminal: bool) -> None:
    class Stream(io.StringIO):
        def isatty(self) -> bool:
            return terminal

    stream = Stream()
    display = ProgressDisplay(stream)
    display.start()
    display("decode", 0.5, "")
    display.error("scan-[2]: a\x1b]0;title\x07\n  [b]again[/b]\n")
    display("decode", 0.75, "")
    display.stop()
    told = re.sub(r"\x1b\[[0-9;]*m", "", stream.getvalue())
    assert "error: scan-[2]: a\\u001b]0;title\\u0007\n  [b]again[/b]\n" in told
    # Without a bar, a stage that begins anew after the error is told, though it has the same name.
    assert terminal or told.count("decode") == 2


def test_label_of_an_older_record_does_nothing_to_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    label = "a\x1b]0;title\x07\x9b2J\x7f\u202e\nb"
    print_table(("label",), [(label,)])
    print_json({"label": label})
    table, _, document = capsys.readouterr().out.partition("{")
    assert "\\u001b]0;title" in table
    for shown in (table, document):
        assert all(character == "\n" or character.isprintable() for character in shown)
    assert json.loads("{" + document) == {"label": label}


def test_refusal_of_a_service_does_nothing_to_the_terminal() -> None:
    problem = {"detail": "no \x1b[2J", "errors": [{"field": "label", "message": "found \x9b"}]}
    with client_of(lambda _: httpx2.Response(422, json=problem)) as client, pytest.raises(ServiceError) as refused:
        client.get("/scan")
    assert str(refused.value) == "no \\u001b[2J\n  label: found \\u009b"


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in Linux's /proc")
@pytest.mark.parametrize(("asked", "kept"), [(None, "1"), ("2", "2")])
def test_a_command_has_no_threads_that_spin_beside_it(asked: str | None, kept: str) -> None:
    # numpy and scipy bring an OpenBLAS each, with a thread per core beside the first, all started when it is loaded.
    command = (
        "import os, sys; sys.argv = ['slrig', '--version']\n"
        "from slrig.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "import numpy, scipy.linalg\n"
        "print(os.environ['OPENBLAS_NUM_THREADS'], len(os.listdir('/proc/self/task')))"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    if asked is not None:
        environment["OPENBLAS_NUM_THREADS"] = asked
    ran = subprocess.run(  # noqa: S603 - our own
        [sys.executable, "-c", command], capture_output=True, text=True, check=True, env=environment
    )
    setting, threads = ran.stdout.split()[-2:]
    assert setting == kept
    assert threads == "1" or asked is not None
