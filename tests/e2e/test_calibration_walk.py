"""From POST /calibration to a scan with what it gave, through the real service, over HTTP, on the rendered rig."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import httpx2
import pytest

from slrig.bundle import read_calibration
from tests.e2e.conftest import KEY, ServiceProcess, Start, scanned, serving
from tests.unit.command import slrig

SCENE = """
name = "chessboard"
[[object]]
name = "board"
shape = "board"
kind = "chessboard"
columns = 8
rows = 5
square_mm = 20.0
margin_mm = 8.0
[[object]]
name = "wall"
shape = "plane"
size_mm = [900.0, 800.0]
position_mm = [0.0, 0.0, 260.0]
albedo = 0.35
"""

RIG = """
name = "boards"
[head]
driver = "simulated"
scene = "scene.toml"
seed = 6
samples_per_axis = 2
ambient = 0.01
carries_calibration = {carries}
{head}
[[head.pose]]
name = "behind the wall"
position_mm = [0.0, 0.0, 500.0]
[head.poses]
count = 10
tilt_deg = [15.0, 40.0]
depth_mm = [-60.0, 80.0]
edge_px = 3.0
[head.projector]
size_px = [320, 200]
focal_px = [390.0, 390.4]
principal_px = [159.0, 226.1]
distortion = [-0.035, 0.022, 0.0003, -0.0002, 0.0]
position_mm = [120.0, 190.0, -585.0]
target_mm = [10.0, 190.0, 0.0]
blur_px = 0.6
gamma = 1.8
[[head.camera]]
name = "left"
size_px = [320, 256]
focal_px = [475.0, 475.5]
principal_px = [160.6, 126.1]
distortion = [-0.11, 0.15, -0.0003, 0.0005, 0.0]
position_mm = [-110.0, -10.0, -575.0]
target_mm = [0.0, 0.0, 0.0]
saturation_s = 0.02
blur_px = 0.6
"""

BOARD = {"kind": "chessboard", "corners": [8, 5], "square_mm": 20.0}
TRUTH = {"fx": 475.0, "fy": 475.5, "cx": 160.6, "cy": 126.1}
"""Of the camera."""


class Caller:
    """Sends requests to a service, and waits for what they begin."""

    def __init__(self, service: ServiceProcess) -> None:
        headers = {"Authorization": f"Bearer {KEY}"}
        self.http = httpx2.Client(base_url=service.url, headers=headers, timeout=120)

    def __enter__(self) -> Caller:
        return self

    def __exit__(self, *_: object) -> None:
        self.http.close()

    def post(self, path: str, status: int, **body: object) -> dict[str, Any]:
        response = self.http.post(path, json=body)
        assert response.status_code == status, response.text
        found: dict[str, Any] = response.json()
        return found

    def get(self, path: str) -> dict[str, Any]:
        response = self.http.get(path)
        assert response.status_code == 200, response.text
        found: dict[str, Any] = response.json()
        return found

    def ready(self) -> None:
        """Wait until the rig is open: a script asks what its positioner can do."""
        self.http.get("/scan")
        opened = threading.Event()
        while self.get("/rig")["positions"] == []:
            opened.wait(0.02)

    def opened(self) -> dict[str, Any]:
        self.ready()
        return self.post("/calibration", 201, board=BOARD, label="walk")

    def settled(self, calibration: dict[str, Any]) -> dict[str, Any]:
        found = self.get(calibration["links"]["self"])
        busy = {"queued", "capturing", "computing", "solving"}
        while found["script"] or busy & {found["state"], *(each["state"] for each in found["shot"])}:
            self.http.get(calibration["links"]["events"], headers={"Last-Event-ID": str(found["last_event"])})
            found = self.get(calibration["links"]["self"])
        return found


def write_rig(folder: Path, *, head: str = "", carries: str = "false") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.toml").write_text(SCENE)
    rig = folder / "rig.toml"
    rig.write_text(RIG.format(head=head, carries=carries))
    return rig


@pytest.mark.slow
def test_a_rig_is_calibrated_over_http_and_scans_with_it_after_a_kill(start: Start, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig")
    service = start(rig)
    with Caller(service) as caller:
        made = caller.opened()
        caller.post(made["links"]["pose"], 202, position="behind the wall")
        (hidden,) = caller.settled(made)["shot"]
        assert (hidden["accepted"], hidden["error"]["type"]) == (False, "/problems/pose-refused")
        assert "no camera sees the board" in hidden["error"]["detail"]
        picture = caller.http.get(hidden["links"]["pictures"]["left"])
        assert (picture.status_code, picture.content[:4]) == (200, b"\x89PNG")

        caller.post(f"{made['links']['self']}/script", 202, positions=list(range(1, 11)))
        shot = caller.settled(made)
        assert [pose["state"] for pose in shot["shot"]] == ["failed", *["succeeded"] * 10]
        assert {pose["answer"]["corners_found"]["left"] for pose in shot["shot"][1:]} == {40}
        assert shot["next_move"]["words"]
        caller.post(made["links"]["pose"], 202, position=10)
        assert "the same as pose 11" in caller.settled(made)["shot"][-1]["error"]["detail"]

        caller.post(made["links"]["solve"], 202)
        solved = caller.settled(made)
        assert solved["state"] == "solved", solved["error"]
        devices = solved["result"]["devices"]
        assert devices["left"]["rms_px"] < 0.1
        assert devices["projector"]["rms_px"] < 0.15
        within_five_deviations(devices)
        assert "<html" in caller.http.get(solved["links"]["files"]["report.html"]).text
        for path in solved["links"]["coverage"].values():
            assert caller.http.get(path).content[:4] == b"\x89PNG"

        assert caller.get("/rig")["calibration"] is None
        caller.post(solved["links"]["activate"], 200)
    service.kill()
    service = start(rig)
    with Caller(service) as caller:
        caller.ready()
        used = caller.get("/rig")["calibration"]
        assert (used["id"], used["solve"], used["error"]) == (made["id"], made["id"], None)
        assert used["expected_error_mm"] == solved["result"]["expected"]["point_mm"]
        with service.client() as client:
            scan = scanned(client)
        assert scan["state"] == "succeeded", scan["error"]
        assert scan["summary"]["truth"]["gross_fraction"] < 0.001
    assert service.stop() == 0


def within_five_deviations(devices: dict[str, Any]) -> None:
    for name, truth in TRUTH.items():
        value, sigma = devices["left"]["values"][name]
        assert abs(value - truth) < 5 * sigma, name


@pytest.mark.slow
def test_a_camera_is_calibrated_alone_by_command_and_again_from_the_poses_of_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = ["--board", "chessboard", "--corners", "8x5", "--square-mm", "20"]

    def calibrate(*arguments: str | Path, code: int = 0) -> str:
        done = slrig("calibrate", *arguments)
        assert done.exit_code == code, done.output
        return done.stdout if code == 0 else " ".join(done.stderr.split())

    with serving(write_rig(tmp_path / "rig"), tmp_path / "data") as service:
        with Caller(service) as call:
            call.ready()
        monkeypatch.setenv("SLRIG_API_KEY", KEY)
        monkeypatch.setenv("SLRIG_URL", service.url)
        refused = calibrate("run", *board, "--cameras-alone", "--scripted", "--activate", code=2)
        assert "of camera 'left' alone, without a projector: it has no depth, and cannot scan" in refused
        (listed,) = json.loads(calibrate("list", "--json"))["calibrations"]
        assert (listed["state"], listed["active"]) == ("solved", False)
        shown = json.loads(calibrate("show", listed["id"][:8], "--json"))["result"]
    assert set(shown["devices"]) == {"left"}
    within_five_deviations(shown["devices"])
    poses = service.data / "calibrations" / listed["id"] / "poses"
    again = calibrate("solve", poses, *board, "--output", tmp_path / "camera.json", "--json")
    assert json.loads(again)["expected"]["point_mm"] == pytest.approx(shown["expected"]["point_mm"], rel=1e-3)
    found = read_calibration(tmp_path / "camera.json")
    assert (list(found.cameras), found.projector) == (["left"], None)
