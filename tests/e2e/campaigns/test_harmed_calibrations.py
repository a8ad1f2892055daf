"""Harmed calibrations sent to the service: each has an answer, and no process ends.

`SLRIG_FUZZ_FILES` is their number, `SLRIG_FUZZ_SEED` the seed of the harm.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import httpx2
import pytest

from tests.e2e.conftest import KEY, Start, write_rig
from tests.strangers import harmed_calibrations
from tests.unit.test_file_storage import REFUSED

pytestmark = pytest.mark.slow
FILES = int(os.environ.get("SLRIG_FUZZ_FILES") or 200)
SEED = int(os.environ.get("SLRIG_FUZZ_SEED") or 16)
KINDS = {".json": "application/json", ".yml": "application/yaml", ".xml": "application/xml"}


def test_the_service_answers_every_harmed_calibration(start: Start, tmp_path: Path) -> None:
    service = start(write_rig(tmp_path / "rig"))
    known = [(".xml" if text.startswith("<") else ".yml", text.encode()) for text, _ in REFUSED.values()]
    answers: Counter[int] = Counter()
    before = None
    with httpx2.Client(base_url=service.url, headers={"Authorization": f"Bearer {KEY}"}, timeout=60) as http:
        for number, (ending, text) in enumerate([*known, *harmed_calibrations(FILES, SEED)]):
            answer = http.post("/calibration/import", content=text, headers={"Content-Type": KINDS[ending]})
            answers[answer.status_code] += 1
            if before is None:
                before = (service.process.pid, service.worker_id())
            if answer.status_code == 201:
                links = answer.json()["links"]
                answered = [http.get(links["self"]), http.get(f"{links['self']}/calibration.json"),
                          http.post(links["activate"]), http.get("/rig"), http.get("/rig/health")]  # fmt: skip
                assert max(each.status_code for each in answered) < 500, (number, text[:2000])
                continue
            assert answer.status_code in {413, 422}, (number, answer.text, text[:2000])
            assert answer.headers["content-type"] == "application/problem+json", number
            detail = answer.json()["detail"]
            assert 40 < len(detail) < 4000, (number, detail)
            assert " " in detail, (number, detail)
            assert str(tmp_path) not in detail, (number, detail)
        assert http.get("/readyz").status_code == 200
    assert answers[201] > 0
    assert (service.process.pid, service.worker_id()) == before
    assert service.process.poll() is None
