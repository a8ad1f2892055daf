"""Kills at random instants of the service, its worker, or both, while jobs of every kind run.

`SLRIG_FUZZ_KILLS` is their number, `SLRIG_FUZZ_SEED` the seed of the instants. After each kill and the next start every
job that was accepted has one end, nothing half written is left, each scan whose frames are whole has its mesh, and the
rig scans.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sqlite3
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx2
import pytest

from tests.e2e.conftest import KEY, ServiceProcess, Start
from tests.e2e.faulty_rig.service import half_written
from tests.e2e.test_calibration_walk import BOARD, RIG, SCENE

# A kill cuts connections that wait for an answer.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")]
KILLS = int(os.environ.get("SLRIG_FUZZ_KILLS") or 4)
SEED = int(os.environ.get("SLRIG_FUZZ_SEED") or 45)
SPAN_S = 9.0
"""All jobs of a round take about so long on two cores."""
END_LIMIT_S = 120.0

SAME = [[float(row == column) for column in range(4)] for row in range(4)]
"""The pose of both scans of a model, 4 x 4."""

FINAL = {"succeeded", "failed", "cancelled", "interrupted"}


class Rounds:
    """Jobs that one data folder was asked for over many services. asked : ids that were answered with 202."""

    def __init__(self, start: Start, rig: Path) -> None:
        self.start, self.rig = start, rig
        self.asked: list[str] = []
        self.ends: Counter[str] = Counter()
        self.service: ServiceProcess = start(rig)
        self.http = self._client()
        self.session: str = self._post("/calibration", {"board": BOARD})["id"]
        self.test: str | None = None
        self.scans = [self._ended(self._begin("/scan", {"if_busy": "queue"})) for _ in range(2)]
        for position in range(2, 6):
            self._ended(self._begin(f"/calibration/{self.session}/pose", {"if_busy": "queue", "position": position}))

    def _client(self) -> httpx2.Client:
        headers = {"Authorization": f"Bearer {KEY}"}
        return httpx2.Client(base_url=self.service.url, headers=headers, timeout=60)

    def _post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        answer = self.http.post(path, json=body)
        assert answer.status_code < 300, (path, answer.text)
        found: dict[str, Any] = answer.json()
        return found

    def _begin(self, path: str, body: dict[str, Any]) -> str:
        return _name(self._post(path, body))

    def _states(self) -> dict[str, tuple[str, str]]:
        """Kind and state of every job, by id; of a pose by "pose" and its number."""
        with sqlite3.connect(self.service.data / "slrig.sqlite") as database:
            rows = database.execute("select id, kind, state, plan from job").fetchall()
        database.close()
        return {
            f"pose {json.loads(plan)['number']}" if kind == "pose" else each: (kind, state)
            for each, kind, state, plan in rows
        }

    def _ended(self, job_id: str) -> str:
        self._until(lambda: self._states().get(job_id, ("", ""))[1] in FINAL, f"the end of {job_id}")
        assert self._states()[job_id][1] == "succeeded", (job_id, self._faults())
        return job_id

    def _faults(self) -> list[Any]:
        with sqlite3.connect(self.service.data / "slrig.sqlite") as database:
            found = database.execute(
                "select kind, failure_code, failure_message from job where failure_code is not null"
            ).fetchall()
        database.close()
        return found

    def _until(self, reached: Callable[[], bool], what: str) -> None:
        never = threading.Event()
        for _ in range(int(END_LIMIT_S / 0.05)):
            if reached():
                return
            never.wait(0.05)
        raise AssertionError(f"{what} did not come: {self._states()}\n{self.service.log.read_text()[-3000:]}")

    def all_kinds(self) -> None:
        """Ask for a job of every kind, as far as the service still answers."""
        turn = {"if_busy": "queue"}
        requests = [
            ("/scan", turn),
            (f"/calibration/{self.session}/pose", {**turn, "position": 3}),
            ("/rig/verification", {**turn, "board": BOARD, "position": 4}),
            ("/rig/doctor", turn),
            ("/rig/latency", {**turn, "flashes": 8}),
            ("/model", {"scans": self.scans, "poses": [SAME, SAME]}),
            (f"/calibration/{self.session}/solve", {}),
            ("/scan", {**turn, "exposure_s": 0.01}),
        ]
        # A client of its own: the other one is closed meanwhile.
        with self._client() as http, suppress(httpx2.HTTPError):
            for path, body in requests:
                answer = http.post(path, json=body)
                # A solve is refused while a pose is read; a full line refuses, too.
                assert answer.status_code in {202, 409, 422, 429, 503}, (path, answer.text)
                if answer.status_code == 202 and not path.endswith("/solve"):
                    self.asked.append(_name(answer.json()))

    def backlog(self) -> None:
        """Ask for eight scans, as far as the service still answers."""
        with self._client() as http, suppress(httpx2.HTTPError):
            for _ in range(8):
                answer = http.post("/scan", json={"if_busy": "queue"})
                assert answer.status_code in {202, 429, 503}, answer.text
                if answer.status_code == 202:
                    self.asked.append(_name(answer.json()))

    def kill(self, what: str) -> None:
        if what in {"worker", "both"}:
            with suppress(AssertionError, ProcessLookupError, FileNotFoundError):
                os.kill(self.service.worker_id(), signal.SIGKILL)
        if what == "worker":
            # It goes on: a job that was computed fails, or is computed by the next process.
            return
        self.http.close()
        self.service.kill()
        self.service = self.start(self.rig)
        self.http = self._client()

    def settle(self, number: int, what: str) -> None:
        """Hold the promises: one end for each job, nothing half written, a rig that scans."""
        self._until(
            lambda: all(state in FINAL for _, state in self._states().values()), f"every end ({number}, {what})"
        )
        known = self._states()
        lost = [each for each in self.asked if each not in known]
        assert lost == [], (number, what)
        poses = [each for each, (kind, _) in known.items() if kind == "pose"]
        folder = self.service.data / "calibrations" / self.session / "poses"
        halves = [path.name for path in folder.iterdir() if not (path / "record.json").is_file()] if poses else []
        assert halves == [], (number, what)
        self._until(
            lambda: half_written(self.service.data) == [], f"{half_written(self.service.data)} ({number}, {what})"
        )
        scans = self.service.data / "scans"
        without_mesh = [each for each, found in known.items() if found[0] == "scan" and found[1] != "succeeded"]
        assert [each for each in without_mesh if (scans / each / "bundle").is_dir()] == [], (
            number,
            what,
            self._faults(),
        )
        scan = self._ended(self._begin("/scan", {"if_busy": "queue"}))
        assert self._states()[scan][1] == "succeeded", (number, what, self.http.get(f"/scan/{scan}").text)
        for each in [scan, *self.asked]:
            kind, state = known.get(each, ("scan", ""))
            self.ends[f"{kind} {state}"] += bool(state)
        self.asked.clear()


def _name(begun: dict[str, Any]) -> str:
    return str(begun["id"]) if "id" in begun else f"pose {begun['number']}"


@pytest.mark.parametrize(
    ("jobs", "wanted"),
    [("all_kinds", ["service", "worker", "both"]), ("backlog", ["service", "service", "worker"])],
)
def test_no_job_is_lost_at_any_instant(
    start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str], jobs: str, wanted: list[str]
) -> None:
    folder = tmp_path / "rig"
    folder.mkdir()
    (folder / "scene.toml").write_text(SCENE)
    rig = folder / "rig.toml"
    rig.write_text(RIG.format(carries="true", head=""))
    rounds, instants = Rounds(start, rig), random.Random(SEED)
    for number in range(KILLS):
        asking = threading.Thread(target=getattr(rounds, jobs))
        asking.start()
        threading.Event().wait(instants.uniform(0.0, SPAN_S))
        what = wanted[number % len(wanted)]
        rounds.kill(what)
        asking.join()
        rounds.settle(number, what)
        with capsys.disabled():
            print("." if number + 1 < KILLS else f" {KILLS} kills: {dict(rounds.ends)}", end="", flush=True)  # noqa: T201
    rounds.http.close()
    assert sum(rounds.ends.values()) > KILLS
