"""Campaign: service and worker killed or stopped at random instants of work of every kind.

Run it by name: `SLRIG_ENDS=100 pytest -s -o faulthandler_timeout=0 tests/bench/test_random_ends.py`.
"""

from __future__ import annotations

import os
import random
import signal
import threading
from collections import Counter
from pathlib import Path

from tests.bench.random_harm import KINDS, Work, alive, calibrated_rig, ends, scanned, session, whole
from tests.e2e.conftest import Start
from tests.e2e.test_calibration_walk import Caller

FIRST = int(os.environ.get("SLRIG_FIRST", "0"))
COUNT = int(os.environ.get("SLRIG_ENDS", "20"))
SEED = int(os.environ.get("SLRIG_SEED", "1"))
HARM = ("service", "worker", "both", "stopped")
SPAN_S = {"scan": 4.0, "pose": 3.0, "solve": 2.5, "verification": 3.0, "schedule": 3.0}
"""How long each takes on two cores, with a margin: an instant may come after the end, too."""


def test_random_ends_lose_nothing(start: Start, tmp_path: Path) -> None:
    chance, pause = random.Random(SEED), threading.Event()
    rig = calibrated_rig(tmp_path / "rig")
    service = start(rig)
    made, schedule = session(service)
    told: Counter[tuple[str, str, str]] = Counter()
    for number in range(FIRST, COUNT):
        kind, harm = KINDS[number % len(KINDS)], HARM[number // len(KINDS) % len(HARM)]
        with Caller(service) as caller:
            caller.ready()
        work = Work(service, kind, made, schedule)
        worker = service.worker_id()
        watched = alive(worker)
        pause.wait(chance.uniform(0, SPAN_S[kind]))
        if harm == "stopped":
            os.kill(worker, signal.SIGSTOP)
        if harm in ("worker", "both"):
            os.kill(worker, signal.SIGKILL)
        if harm in ("service", "both"):
            service.kill()
            assert ends(watched), f"{number}: the worker outlives the service"
            service = start(rig)
        else:
            # One that stands still is ended by the service when it is next asked for something.
            found = work.over(service)
            after = scanned(service)
            if harm == "stopped" and after["state"] != "succeeded":
                assert after["error"]["type"] == "/problems/worker-lost", after
                print(f"{number}: the next scan met the stopped worker")  # noqa: T201
            assert ends(watched), f"{number}: the worker is still there"
        found = work.over(service)
        error = found.get("error") or {}
        cause = error.get("type", found.get("reason") or "")
        told[kind, harm, found["state"]] += 1
        print(f"{number}: {kind}, {harm}: {found['state']} {cause}", flush=True)  # noqa: T201
        assert "unexpected" not in cause, found
        last = scanned(service)
        assert last["state"] == "succeeded", (number, kind, harm, last["error"])
        assert whole(service) == [], (number, kind, harm)
    for key, count in sorted(told.items()):
        print(*key, count)  # noqa: T201
    assert service.stop() == 0
