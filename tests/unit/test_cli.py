"""The command line as a whole: help, exit codes, `slrig scan`, `demo` and `accept`, and what a terminal shows."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import httpx2
import numpy as np
import pytest
import typer
from rich.console import Console

from slrig.accept.evaluation import AcceptanceResult
from slrig.accept.job import scripted_config
from slrig.accept.plan import AcceptancePlan, Limits
from slrig.api.schemas import ScanRequest
from slrig.bundle.options import read_region
from slrig.calibration.artefacts import Decision
from slrig.cli import accept as accepting
from slrig.cli.accept import Person, measure_positions, moving, plan_for
from slrig.cli.commands import INTERRUPTED, app
from slrig.cli.display import ProgressDisplay, print_json, print_table, quality_lines
from slrig.cli.options import AcceptanceOptions, ServiceOptions
from slrig.cli.scan import (
    print_result,
    remove_earlier,
    require_sound,
    scan_with,
    series_with,
    still_missing,
)
from slrig.client import Client, ScanJob
from slrig.config import read_rig
from slrig.devices import Rig
from slrig.discovery import open_rig
from slrig.errors import InvalidInputError, ScanCancelledError, ServiceError, SlrigError, UnsupportedByDeviceError
from slrig.examples import EXAMPLES
from slrig.jobs.listener import SILENT, Listener
from slrig.jobs.manager import JobManager
from slrig.model import Region
from slrig.scan.artefacts import report_summary
from slrig.scan.formats import MEDIA_TYPES
from slrig.scan.report import sigma_words
from tests.unit.capture.fake_rig import fake_rig
from tests.unit.client.service import SCAN, Walk, client_of, failing
from tests.unit.command import done, refused, slrig

COLUMNS = 80
MOST_OPTIONS = 12
DEMO = EXAMPLES / "rigs" / "demo.toml"
SUMMARY = {
    "identity": "28/28 patterns verified, 2 frames shot again",
    "mesh": {"figures": {"vertices": 1200, "triangles": 2301}, "sigma_mm": {"p50": 0.0079}},
    "truth": {"rms_mm": 0.0123, "gross_fraction": 0.026, "complete_0.3mm": 0.97},
}
SERIES = "/scan/series/9"


def printed(code: str) -> str:
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    return found.stdout.strip().splitlines()[-1]


def commands() -> list[tuple[str, ...]]:
    found: list[tuple[str, ...]] = [()]

    def walk(group: object, words: tuple[str, ...]) -> None:
        for name, command in getattr(group, "commands", {}).items():
            found.append((*words, name))
            walk(command, (*words, name))

    walk(typer.main.get_command(app), ())
    return found


def test_help_of_each_command_fits_a_terminal_of_80_columns() -> None:
    for words in commands():
        lines = done(*words, "--help", COLUMNS=str(COLUMNS)).splitlines()
        assert max(map(len, lines)) <= COLUMNS, words
        # Nothing is cut, neither an option's name nor the sentence beside a command's.
        assert [line for line in lines if ("..." in line or "…" in line) and not line.startswith("Usage:")] == [], words
        # And no text stands in a strip of a few words.
        indents = [len(line) - len(line.lstrip()) for line in lines if line.startswith("   ")]
        assert max(indents, default=0) <= COLUMNS // 2, words
        # Many options stand under headings of their subjects.
        options = re.findall(r"^  --|^\w.*:$", "\n".join(lines), re.MULTILINE)
        lists = "".join("-" if each == "  --" else "/" for each in options).split("/")
        assert max(map(len, lists), default=0) <= MOST_OPTIONS, words


def test_help_and_version_load_nothing_heavy() -> None:
    assert done("--version") == f"slrig {version('slrig')}\n"
    heavy = {"numba", "numpy", "cv2", "fastapi", "sqlalchemy", "scipy", "trimesh", "pydantic", "httpx2", "rich"}
    code = (
        "import sys, slrig.cli, slrig.cli.calibrate\nsys.argv = ['slrig', '--version']\n"
        f"try: slrig.cli.main()\nexcept SystemExit: print(sorted({heavy} & set(sys.modules)))"
    )
    assert printed(code) == "[]"


def test_the_reconstruction_loads_neither_a_database_nor_what_few_scans_need() -> None:
    heavy = {"sqlalchemy", "alembic", "fastapi", "httpx2", "trimesh", "tifffile"}
    heavy |= {f"scipy.{each}" for each in ("ndimage", "optimize", "sparse", "spatial", "special")}
    of_rigs = {
        "slrig.devices",
        "slrig.rig",
        "slrig.jobs.worker",
        "slrig.jobs.data_folder",
        "filelock",
        "multiprocessing",
    }
    code = (
        "import sys, slrig.cli.reconstruct, slrig.scan.reconstruct\n"
        f"found = {heavy | of_rigs} & set(sys.modules)\n"
        f"import slrig.jobs.worker\nprint(sorted(found | {heavy} & set(sys.modules)))"
    )
    assert printed(code) == "[]"


def test_shell_completes_commands() -> None:
    words = {"_SLRIG_COMPLETE": "complete_bash", "COMP_WORDS": "slrig sc", "COMP_CWORD": "1"}
    found = subprocess.run(
        [sys.executable, "-m", "slrig.cli"], capture_output=True, text=True, check=False, env={**os.environ, **words}
    )
    assert found.stdout.split() == ["scan", "schedule", "scans"]


BESIDE_OPENCV = """
import sys, threading, cv2, numpy, slrig.cli.commands as commands

def blur():
    while True:
        cv2.GaussianBlur(numpy.zeros((400, 400), numpy.float32), (0, 0), 3)

threading.Thread(target=blur, daemon=True).start()
sys.argv = ["slrig", *sys.argv[1:]]
commands.main()
"""


@pytest.mark.parametrize(("argument", "code"), [("--version", 0), ("--no-such-option", 2)])
def test_command_ends_in_order_beside_a_thread_within_a_library(argument: str, code: int) -> None:
    """Python ends daemon threads where they are, which aborts a process if that is in C++."""
    command = [sys.executable, "-c", BESIDE_OPENCV, argument]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)  # noqa: S603
    assert done.returncode == code, done.stderr
    assert "slrig" in done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in Linux's /proc")
def test_command_has_no_threads_that_spin() -> None:
    # numpy and scipy bring an OpenBLAS each, with a thread per core beside the first, all started when it is loaded.
    code = (
        "import os, sys; sys.argv = ['slrig', '--version']; os.environ.pop('OPENBLAS_NUM_THREADS', None)\n"
        "from slrig.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "import numpy, scipy.linalg\n"
        "print(os.environ['OPENBLAS_NUM_THREADS'], len(os.listdir('/proc/self/task')))"
    )
    assert printed(code) == "1 1"
    # A person's own choice stays.
    code = code.replace("os.environ.pop('OPENBLAS_NUM_THREADS', None)", "os.environ['OPENBLAS_NUM_THREADS'] = '2'")
    assert printed(code.replace("import numpy, scipy.linalg\n", "")) == "2 1"


def test_error_of_ours_is_one_screen_and_exit_code_2(tmp_path: Path) -> None:
    absent, out = tmp_path / "absent.toml", ("--output", tmp_path / "out")
    nowhere = ("scan", "--url", "http://127.0.0.1:9", *out)
    for words in (
        ("serve", absent),
        ("reconstruct", tmp_path / "absent", *out),
        nowhere,
        (*nowhere, "--key-file", tmp_path / "absent.key"),
        ("demo", absent, *out),
        ("conform", absent),
    ):
        # Nothing is compiled for a mistake.
        assert "preparing" not in refused(slrig(*words)), words
    unknown = refused(slrig(*nowhere, "--file", "mesh.e57"))
    assert all(f" {name}," in unknown for name in MEDIA_TYPES)
    assert not (tmp_path / "out").exists()
    assert slrig("scan", "--colour", "red").exit_code == 2
    for option, value, words_ in (
        ("--depth-edge-ratio", "1", "depth_edge_ratio: expected a finite number above 1, found 1;"),
        ("--max-code-gap", "0", "max_code_gap: expected 1 or more, found 0;"),
        ("--flip-rule", "dyer", "flip_rule: expected constrained or delaunay, found 'dyer';"),
    ):
        result = slrig("reconstruct", tmp_path, *out, option, value)
        assert (result.exit_code, words_ in result.stderr) == (2, True), result.stderr


def test_files_of_an_earlier_scan_are_not_overwritten_unless_told(tmp_path: Path) -> None:
    nowhere = ("scan", "--url", "http://127.0.0.1:9", "--output", tmp_path)
    (tmp_path / "mesh.ply").write_text("earlier")
    assert "has mesh.ply of an earlier scan" in refused(slrig(*nowhere))
    assert "earlier scan" not in refused(slrig(*nowhere, "--force"))
    assert "earlier scan" not in refused(slrig(*nowhere, "--file", "mesh.stl"))
    assert (tmp_path / "mesh.ply").read_text() == "earlier"
    (tmp_path / "001").mkdir()
    assert "has 001 of an earlier scan" in refused(slrig(*nowhere, "--file", "mesh.stl", "--repeat", "2"))


def test_interruption_is_exit_code_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(**_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("slrig.cli.rig_file.list_devices", interrupted)
    assert slrig("devices").exit_code == INTERRUPTED


def test_devices_lists_the_rendered_rig_for_people_and_programs() -> None:
    assert "simulated" in done("devices")
    document = json.loads(done("devices", "--json"))
    assert ("head", "simulated", None) in [
        (driver["kind"], driver["name"], driver["fault"]) for driver in document["drivers"]
    ]


def test_patterns_are_not_written_for_a_projector_that_shows_any(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slrig.discovery.open_rig", lambda _: fake_rig().rig)
    words = " ".join(refused(slrig("patterns", DEMO)).split())
    assert "shows any pattern: nothing to flash" in words


def test_key_comes_from_a_file_or_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def sent(key_file: Path | None) -> str | None:
        with ServiceOptions(key_file=key_file).client() as client:
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
    with client_of(failing(httpx2.ConnectError("refused"))) as client:
        assert still_missing(client) == "the service is starting"
    fault = "scene 'tabel.toml': no such file"
    with client_of(lambda _: ready_answer(503, fault)) as client, pytest.raises(ServiceError, match="cannot be opened"):
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


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    sent: list[dict[str, Any]] = []

    def scanned(_client: Client, request: dict[str, Any], *_: object, **__: object) -> dict[str, Any]:
        sent.append(request)
        return SCAN

    monkeypatch.setattr("slrig.cli.scan.scan_with", scanned)
    return sent


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ([], {}),
        (["--keep-holes"], {"reconstruction": {"keep_holes": True}}),
        (
            ["--close-holes", "--raw-boundary"],
            {"reconstruction": {"keep_holes": False, "smooth_boundary": False}},
        ),
        (
            ["--smooth-boundary", "--flip-rule", "delaunay"],
            {"reconstruction": {"smooth_boundary": True, "flip_rule": "delaunay"}},
        ),
        (
            ["--depth-edge-ratio", "9", "--max-code-gap", "2"],
            {"reconstruction": {"depth_edge_ratio": 9.0, "max_code_gap": 2}},
        ),
        (["--axis", "row"], {"reconstruction": {"axis": "row"}}),
        (["--drop-finest-bits", "2"], {"reconstruction": {"drop_finest_bits": 2}}),
        (["--exposure-s", "0.02"], {"exposure_s": 0.02}),
        (["--exposure-s", "0.02", "--exposure-s", "0.08"], {"exposures_s": [0.02, 0.08]}),
    ],
)
def test_scan_asks_the_service_for_the_options_that_were_given(
    tmp_path: Path, requests: list[dict[str, Any]], arguments: list[str], wanted: dict[str, Any]
) -> None:
    done("scan", "--output", tmp_path, *arguments)
    (request,) = requests
    of_interest = {name: request[name] for name in request if name.startswith(("exposure", "recon"))}
    assert of_interest == {"reconstruction": {}, **wanted}
    # The service understands what it is asked.
    understood = ScanRequest.model_validate_json(json.dumps(request)).model_dump(mode="json", exclude_none=True)
    assert understood.items() >= of_interest.items()


def test_region_is_read_from_a_file(tmp_path: Path, requests: list[dict[str, Any]]) -> None:
    path, out = tmp_path / "part.toml", ("--output", tmp_path / "out")
    path.write_text('depth_mm = [100, 200]\n[masks]\nleft = "left.png"\n')
    mask = cv2.imencode(".png", np.full((10, 20), 255, dtype=np.uint8))[1].tobytes()
    (tmp_path / "left.png").write_bytes(mask)
    done("scan", *out, "--region", path)
    masks = {"left": base64.b64encode(mask).decode()}
    assert requests[0]["reconstruction"] == {"region": {"depth_mm": [100, 200], "masks": masks}}
    assert read_region(path).region() == Region(depth_mm=(100, 200), masks=masks)
    (tmp_path / "left.png").unlink()
    words = " ".join(refused(slrig("scan", *out, "--region", path)).split())
    assert "left.png: expected a mask as PNG, found: No such file or directory" in words
    path.write_text("depth = [100, 200]\n")
    assert "did you mean 'depth_mm'?" in refused(slrig("reconstruct", tmp_path, *out, "--region", path))


def test_scan_is_followed_and_fetched_or_says_which_files_it_has(tmp_path: Path) -> None:
    shown: list[tuple[str, float]] = []

    def display(stage: str, fraction: float, _detail: str) -> None:
        shown.append((stage, fraction))

    with client_of(Walk(mesh_ply=b"ply")) as client:
        scan_with(client, {}, tmp_path / "out", Listener(report=display), files=("mesh.ply",))
        with pytest.raises(ServiceError, match=r"no mesh\.obj\. It has: mesh\.ply"):
            scan_with(client, {}, tmp_path / "none", SILENT, files=("mesh.ply", "mesh.obj"))
    assert not (tmp_path / "none").exists()
    assert (tmp_path / "out" / "mesh.ply").read_bytes() == b"ply"
    assert shown == [("waiting for the rig", 0.0), ("capture", 0.25), ("fetching mesh.ply", 1.0), ("done", 1.0)]


def test_result_is_shown_with_its_files_and_its_quality(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = ("mesh.ply", "mesh.obj", "rejected-left.png")
    for name in (*files, "report.json"):
        (tmp_path / name).write_bytes(b"of this scan or of an earlier one")
    print_result({}, tmp_path, files=files)
    assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
        ["mesh", str(tmp_path / "mesh.ply")],
        ["mesh.obj", str(tmp_path / "mesh.obj")],
        ["rejected-left.png", str(tmp_path / "rejected-left.png")],
    ]
    assert quality_lines(report_summary({"method": "Gray-only", **SUMMARY})) == [
        "frames    28/28 patterns verified, 2 frames shot again",
        "size      1,200 vertices, 2,301 triangles",
        "stated    standard deviation of a point 0.0079 mm (median)",
        "error     rms 0.0123 mm against the known truth, of the 97.4% of the area within 1 mm; 2.6% beyond 1 mm, "
        "97.0% of the visible surface within 0.3 mm",
    ]
    holds = sigma_words(has_calibration=False)
    assert quality_lines({"mesh": {"sigma_mm": {"p50": 0.014}, "sigma_holds": holds}}) == [
        "stated    standard deviation of a point 0.0140 mm (median); noise only: this calibration states no error, and "
        "this scan cannot test it"
    ]
    # Summaries of earlier versions.
    assert quality_lines({"method": "Gray-only"}) == []
    earlier = {"truth": {"rms_mm": 0.0123, "complete_0.3mm": 0.97}}
    assert quality_lines(earlier) == [
        "error     rms 0.0123 mm against the known truth, 97.0% of the visible surface within 0.3 mm"
    ]


@pytest.mark.parametrize(
    ("truth", "line", "code"),
    [
        ({"rms_mm": 0.0055, "gross_fraction": 0.0}, "of the 100.0% of the area within 1 mm; 0.0% beyond 1 mm", 0),
        ({"rms_mm": 0.0055, "gross_fraction": 0.026}, "of the 97.4% of the area within 1 mm; 2.6% beyond 1 mm", 1),
        ({"rms_mm": None, "gross_fraction": 1.0}, "nothing within 1 mm of the known truth", 1),
        ({"rms_mm": 0.0055, "gross_fraction": 0.0, "facing_camera_area": 0.4}, "0.0% beyond 1 mm", 1),
        (None, "", 0),
    ],
)
def test_the_error_names_what_is_beyond_its_limit_and_a_demo_ends_accordingly(
    truth: dict[str, Any] | None, line: str, code: int
) -> None:
    assert [each.endswith(line) for each in quality_lines({"truth": truth})] == [True] * (truth is not None)
    ended = nullcontext() if code == 0 else pytest.raises(typer.Exit, check=lambda end: end.exit_code == code)
    with ended:
        require_sound({"summary": {"truth": truth}})


def test_series_goes_on_after_a_failure_and_names_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ends = {"1": Walk(mesh_ply=b"ply"), "2": Walk("failed", {"detail": "No stripe was found."})}
    ends["3"] = ends["1"]
    sent: list[dict[str, Any]] = []

    def numbered(scan: dict[str, Any], number: str) -> dict[str, Any]:
        here = f"/scan/{number}"
        links = {**scan["links"], "self": here, "events": f"{here}/events", "series": SERIES}
        files = {"mesh.ply": f"{here}/mesh.ply"}
        return {**scan, "id": number, "summary": SUMMARY, "links": {**links, "files": files}}

    def answer(request: httpx2.Request) -> httpx2.Response:
        path = request.url.path
        if path == "/scan":
            sent.append(json.loads(request.content))
            return httpx2.Response(202, json=numbered(SCAN, "1"))
        if path == SERIES:
            return httpx2.Response(200, json={"scans": [numbered(SCAN, number) for number in ends]})
        number = path.split("/")[2]
        found = ends[number](request)
        is_scan = found.headers.get("Content-Type") == "application/json"
        return httpx2.Response(200, json=numbered(found.json(), number)) if is_scan else found

    request = {"repeat": 3, "every_s": 2.0}
    assert ScanRequest.model_validate(request).repeat == 3
    with client_of(answer) as client, pytest.raises(ServiceError, match=r"^1 of 3 scans did not succeed: 002\.$"):
        series_with(client, request, tmp_path, SILENT, files=("mesh.ply",))
    assert sent == [request]
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.ply")) == [
        "001/mesh.ply",
        "003/mesh.ply",
    ]
    rows = [line.split(maxsplit=3) for line in capsys.readouterr().out.splitlines()]
    assert rows[1] == ["001", "2,301", "0.0079"]
    assert rows[2][0] == "002"
    assert "No stripe was found." in " ".join(rows[2])


@pytest.mark.parametrize("series", [False, True])
def test_ctrl_c_cancels_the_scan_or_the_whole_series(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, series: bool
) -> None:
    posted: list[str] = []

    def answer(request: httpx2.Request) -> httpx2.Response:
        started = {**SCAN, "links": {**SCAN["links"], "series": SERIES}}
        posted.extend([request.url.path] if request.method == "POST" else [])
        return httpx2.Response(202, json={**started, "scans": [started, started]})

    def interrupted(_job: object, _display: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ScanJob, "result", interrupted)
    scan = series_with if series else scan_with
    with client_of(answer) as client, pytest.raises(KeyboardInterrupt):
        scan(client, {"repeat": 2 if series else 1}, tmp_path, SILENT)
    assert posted == ["/scan", f"{SERIES if series else SCAN['links']['self']}/cancel"]


@pytest.mark.parametrize(
    ("name", "cameras", "told"),
    [
        ("mesh.e57", ["left"], "a scan has no mesh.e57. There are: mesh.ply, "),
        (
            "rejected-top.png",
            ["left"],
            "There are: .*, rejected-left.png, causes-left.png, agreement-left.png, points-left.npz, .*bundle.zip",
        ),
        ("rejected-top.png", [], None),
        ("rejected-left.png", ["left"], None),
        ("points-left.e57", ["left"], None),
        ("scan.mcap", ["left"], None),
        ("points-top.npz", ["left"], "no points-top.npz"),
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
        scan_with(client, {}, tmp_path / "out", SILENT, files=("mesh.ply", name))
    assert (len(started) == 0) == (told is not None)


def test_progress_off_a_terminal_is_one_line_per_stage() -> None:
    stream_of_text = io.StringIO()
    display = ProgressDisplay(stream_of_text)
    display.start()
    for stage, fraction in (("capture", 0.0), ("capture", 0.3), ("decode", 0.5), ("done", 1.0)):
        display(stage, fraction, "")
    display.stop()
    lines = stream_of_text.getvalue().splitlines()
    stages = [re.sub(" +about .*", "", line).split("  ")[-1] for line in lines]
    assert stages == ["capture", "decode", "done"]
    assert ["left" in line for line in lines] == [False, True, False]
    assert [line.split("%")[0].split()[-1] for line in lines] == ["0", "50", "100"]


def test_long_step_is_shown_again_off_a_terminal() -> None:
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
def test_error_during_progress_stays_and_does_nothing_to_the_terminal(terminal: bool) -> None:
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


RIGS = EXAMPLES / "rigs"
BALL_BAR = RIGS / "ball_bar.toml"


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    with open_rig(read_rig(BALL_BAR)) as rig:
        yield rig


@pytest.fixture(scope="module")
def plan(rig: Rig) -> AcceptancePlan:
    return plan_for(AcceptanceOptions(), rig)


@pytest.mark.slow
def test_rendered_rig_needs_no_artefacts_and_states_exact_ones(rig: Rig, plan: AcceptancePlan) -> None:
    assert plan.rendered
    assert plan.artefacts.diameter.uncertainty_mm == 0
    assert plan.limits.spacing_mm == pytest.approx(plan.diagonal_mm / 5000)
    assert len(plan.steps) == 23
    given = plan_for(AcceptanceOptions(volume_mm=(-50, -40, -25, 50, 40, 25)), rig)
    assert given.volume_mm.tolist() == [[-50, -40, -25], [50, 40, 25]]


def test_metal_needs_the_certificates(rig: Rig) -> None:
    metal = replace(rig, head=None)
    with pytest.raises(InvalidInputError, match="needs --sphere DIAMETER U"):
        plan_for(AcceptanceOptions(), metal)
    given = AcceptanceOptions(sphere_mm=(17.5, 0.001), bar_mm=(64.0, 0.002), plane_mm=(95.0, 67.0))
    with pytest.raises(InvalidInputError, match="the sphere's form, the plane's form is not stated"):
        plan_for(given, metal)
    certain = replace(given, sphere_form_mm=0.001, plane_form_mm=0.002, spacing_limit_mm=0.05)
    wanted = plan_for(replace(certain, tolerance_mm=0.03), metal).limits
    assert wanted == Limits(form_mm=0.06, size_mm=0.03, spacing_mm=0.05, flatness_mm=0.06)
    assert not plan_for(certain, metal).rendered


@pytest.mark.slow
def test_a_rig_whose_script_has_the_positions_moves_its_own_artefacts(tmp_path: Path) -> None:
    config = read_rig(RIGS / "rendered-acceptance.toml")
    assert moving(config, AcceptanceOptions(), tmp_path) is config
    other = moving(read_rig(BALL_BAR), AcceptanceOptions(), tmp_path)
    with open_rig(other) as rig:
        assert rig.positioner is not None
        assert len(rig.positioner.poses) == 23


def test_a_rig_that_is_not_rendered_cannot_be_scripted(tmp_path: Path, plan: AcceptancePlan) -> None:
    config = read_rig(BALL_BAR)
    with pytest.raises(UnsupportedByDeviceError, match=r"leave scripted \(--scripted\) out"):
        scripted_config(replace(config, head=None), plan, tmp_path)


def test_person_reads_each_position_and_may_leave(plan: AcceptancePlan, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.StringIO()
    answers = iter(["", "q"])

    def typed() -> str:
        if (answer := next(answers, None)) is None:
            raise EOFError
        return answer

    monkeypatch.setattr("builtins.input", typed)
    person = Person(plan, Console(file=shown, width=120))
    person.place(plan.steps[0])
    assert "1 of 23" in shown.getvalue()
    assert "Put the sphere in the middle of the volume." in shown.getvalue()
    for _ in ("q", "end of input"):
        with pytest.raises(ScanCancelledError, match="left before sphere-2"):
            person.place(plan.steps[1])


@pytest.mark.slow
@pytest.mark.parametrize("as_json", [False, True])
def test_the_command_does_the_test_and_returns_the_decision(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *, as_json: bool
) -> None:
    whole, limits_mm = measure_positions, list[float]()

    def shortened(
        manager: JobManager, plan: AcceptancePlan, folder: Path, listener: Listener = SILENT, **options: Any
    ) -> AcceptanceResult:
        limits_mm.append(plan.limits.spacing_mm)
        steps = tuple(step for step in plan.steps if step.name == "bar-5")
        return whole(manager, replace(plan, steps=steps, repeats=1), folder, listener, **options)

    monkeypatch.setattr(accepting, "measure_positions", shortened)
    output, rig_file = tmp_path / "out", tmp_path / "rig.toml"
    text = BALL_BAR.read_text(encoding="utf-8").replace('"../', f'"{RIGS.parent}/')
    rig_file.write_text(f"{text}\n[accuracy]\ntolerance_mm = 0.04\n", encoding="utf-8")
    # Sphere spacing is right to a few µm: a limit of one tenth of a µm fails, that of the rig file passes.
    more = ["--spacing-limit-mm", "0.0000001", "--json"] if as_json else []
    ran = slrig("accept", rig_file, "--scripted", "--output", output, *more)
    assert limits_mm == [0.0000001 if as_json else 0.04]
    report = json.loads((output / "report.json").read_text())
    assert report["quantities"][0]["quantity"] == "SD"
    if as_json:
        assert json.loads(ran.stdout) == report
        assert report["decision"] == Decision.FAILS
        assert ran.exit_code == 1
    else:
        assert "SD sphere spacing error" in ran.stdout
        assert report["decision"] == Decision.PASSES
        assert ran.exit_code == 0
