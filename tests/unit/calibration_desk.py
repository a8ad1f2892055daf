"""A service with one calibration session, below the client: for tests of what the command line does with one."""

from __future__ import annotations

import json
from typing import Any

import httpx2

from slrig.api.calibration import CalibrationBody, CalibrationList, PoseBody
from slrig.calibrate.report import summary
from slrig.client import Client
from tests.unit.calibrate.solved import BOARD, solved_result

ID = "3f6c1f6e-9f0e-4c57-8a39-5f8a4f0c2b11"
NOW = "2026-11-22T09:30:00+00:00"
UNKNOWN_OF_A_POSE = ("position", "position_name", "exposure_s", "accepted", "answer", "error", "seconds")


class Desk:
    """A service with one calibration session. Poses are shot at once, one look after they were asked for.

    Every answer is held against what the real service's answers are.
    """

    def __init__(self, *refusals: int) -> None:
        self.refusals = refusals
        self.asked: list[tuple[str, str, Any]] = []
        self.shot: list[dict[str, Any]] = []
        self.state = "open"
        self.solve_error: str | None = None
        self.script = 0
        self.latest = 0
        self.stuck = False

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        path = request.url.path
        body = json.loads(request.content) if request.content else None
        if request.method != "GET":
            self.asked.append((request.method, path, body))
        if path == "/readyz":
            return httpx2.Response(200, json={"checks": {"rig": "ok"}})
        if path == "/rig":
            return httpx2.Response(200, json={"cameras": [{"name": "left", "size_px": [1280, 1024]}]})
        if path == "/calibration" and request.method == "GET":
            listed = {"calibrations": [self.session()], "active": None}
            CalibrationList.model_validate(listed)
            return httpx2.Response(200, json=listed)
        if path.endswith("/script"):
            self.script = 3
            return httpx2.Response(202, json=self._begun())
        if path.endswith("/pose"):
            return httpx2.Response(202, json=self._begun())
        if "/pose/" in path:
            return self._at_pose(request.method, path)
        if path.endswith("/solve"):
            self.state = "solving"
            return httpx2.Response(202, json=self.session())
        if path.endswith("/activate"):
            return httpx2.Response(200, json=self.session())
        answer = self.session()
        if request.method == "GET":
            self._advance()
        return httpx2.Response(201 if request.method == "POST" else 200, json=answer)

    def _at_pose(self, method: str, path: str) -> httpx2.Response:
        number = int(path.split("/pose/")[1].split("/")[0])
        pose = next(each for each in self.shot if each["number"] == number)
        if path.endswith("/cancel"):
            pose["state"] = "cancelled"
            return httpx2.Response(202, json=pose)
        if method == "DELETE":
            self.shot.remove(pose)
            return httpx2.Response(204)
        self._end(pose)
        PoseBody.model_validate(pose)
        return httpx2.Response(200, json=pose)

    def _begun(self) -> dict[str, Any]:
        self.latest += 1
        here = f"/calibration/{ID}/pose/{self.latest}"
        pose = {
            "number": self.latest,
            "name": f"pose {self.latest}",
            "state": "queued",
            "created_at": NOW,
            "links": {"self": here, "events": f"/calibration/{ID}/events", "cancel": f"{here}/cancel", "pictures": {}},
            **dict.fromkeys(UNKNOWN_OF_A_POSE),
        }
        PoseBody.model_validate(pose)
        self.shot.append(pose)
        return dict(pose)

    def _end(self, pose: dict[str, Any]) -> None:
        if self.stuck:
            return
        pose["accepted"] = pose["number"] not in self.refusals
        pose["state"] = "succeeded" if pose["accepted"] else "failed"
        if not pose["accepted"]:
            problem = {"type": "about:blank", "title": "t", "status": 422, "detail": "the board moved: hold it still"}
            pose["error"] = problem
        figures = {"corners_found": 80, "tilt_deg": 31.2, "distance_mm": None, "sharpness_px": 1.1, "moved_px": 0.02}
        pose["answer"] = {
            **{name: {"left": figure} for name, figure in {**figures, "saturated": 0.013}.items()},
            "corners_expected": 88,
            "warnings": ["camera 'left' sees the board small: bring it nearer"],
        }

    def _advance(self) -> None:
        if self.script > 1 and all(pose["accepted"] is not None for pose in self.shot):
            self.script -= 1
            self._begun()
        elif self.script == 1:
            self.script = 0
        if self.state == "solving":
            self.state = "failed" if self.solve_error else "solved"

    def session(self) -> dict[str, Any]:
        here = f"/calibration/{ID}"
        accepted = sum(pose["accepted"] is True for pose in self.shot)
        cells = [[accepted * (row < 2 and column < 3) for column in range(6)] for row in range(6)]
        reachable = [[row != 5 for _ in range(6)] for row in range(6)]
        seen = {"cells": cells, "reachable": reachable, "share": 6 / 36, "depths": 1, "tilted": [1, 0], "turns": 2}
        coverage = {"poses": [], "devices": {"left": {**seen, "distance_mm": [None, None]}}}
        board = {"kind": "chessboard", "corners": [11, 8], "square_mm": 12.0, "marker_mm": None, "dictionary": None}
        links = {what: f"{here}/{what}" for what in ("events", "pose", "solve", "activate")}
        plan = {"line_shift_period_px": 8, "line_width_px": 1, "gray_cell_px": None, "gray_offset_px": 0}
        corner = [[900, 600], [1270, 600], [1270, 1000], [900, 1000]]
        solved = self.state == "solved"
        problem = {"type": "about:blank", "title": "t", "status": 422, "detail": self.solve_error}
        session = {
            "id": ID,
            "state": self.state,
            "label": None,
            "rig": "bench",
            "created_at": NOW,
            "solved_at": NOW if solved else None,
            "imported": False,
            "active": False,
            "poses": accepted,
            "verdict": "good" if solved else None,
            "links": {
                "self": here,
                **links,
                "coverage": {},
                "files": {"calibration.json": f"{here}/calibration.json"} if solved else {},
            },
            "board": {
                **board,
                "square_sigma": 0.001,
                "aspect": 1.0,
                "title": BOARD.title,
                "rulers_mm": BOARD.rulers_mm,
                "measured": False,
            },
            "patterns": {**plan, "line_shift": True, "rows": True, "codes": True},
            "shot": self.shot,
            "script": list(range(max(self.script - 1, 0))),
            "pinned": False,
            "coverage": {**coverage, "missing": ["3 of at least 10 poses"]} if accepted else None,
            "next_move": {
                "words": "move it to the lower right corner",
                "enough": False,
                "camera": "left",
                "outline_px": corner,
                "worst_px": {},
                "expected_px": {},
            },
            "progress": None,
            "error": problem if self.state == "failed" else None,
            "result": summary(solved_result()) if solved else None,
            "last_event": 1,
        }
        CalibrationBody.model_validate(session)
        return json.loads(json.dumps(session))  # type: ignore[no-any-return]


def client_of(desk: Desk) -> Client:
    return Client("http://127.0.0.1:1", "key", transport=httpx2.MockTransport(desk))
