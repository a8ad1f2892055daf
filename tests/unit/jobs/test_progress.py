"""How far a job is, as often as a person cares to know."""

from __future__ import annotations

from pathlib import Path

from slrig.jobs.database import Database
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.records import JobKind
from slrig.jobs.store import JobStore


def test_progress_is_recorded_by_stage_by_hundredths_and_while_a_stage_goes_on(tmp_path: Path) -> None:
    store = JobStore(Database(tmp_path / "slrig.sqlite"), JobKind.SCAN)
    scan = store.create({}, rig="bench", label=None)
    now_s = [0.0]
    record = ProgressRecorder(store, scan.id, hidden="secret/", now_s=lambda: now_s[0])
    for at_s, stage, fraction, detail in (
        (0.0, "preparing kernels", 0.0, "0 of 56"),
        (0.5, "preparing kernels", 0.0, "1 of 56"),  # too soon to be told
        (2.5, "preparing kernels", 0.0, "9 of 56"),
        (9.0, "preparing kernels", 0.0, "9 of 56"),  # nothing new
        (9.1, "decode", 0.001, "secret/a"),
        (9.15, "decode", 0.2, "too soon after the last"),
        (9.3, "decode", 0.5, ""),
        (9.31, "decode", 1.0, "the end"),
    ):
        now_s[0] = at_s
        record(stage, fraction, detail)
    events = [event.data for event in store.events(scan.id, after=0) if event.kind == "progress"]
    assert [(each["stage"], each["detail"]) for each in events] == [
        ("preparing kernels", "0 of 56"),
        ("preparing kernels", "9 of 56"),
        ("decode", "a"),
        ("decode", ""),
        ("decode", "the end"),
    ]
    store.database.close()
