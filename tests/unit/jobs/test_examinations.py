"""What an examination found, kept in the data folder: whole, for the rig that it is of, and never in the way."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

from slrig.doctor.doctor import Diagnosis
from slrig.doctor.findings import fault, ok
from slrig.jobs.examinations import keep, last_examination
from slrig.jobs.records import utc_now

FINDINGS = (
    fault("light.dark", "camera 'left'", "the light is too dim", "open the iris"),
    ok("device", "rig", "all is there"),
)


def test_examination_is_kept_for_its_rig_and_replaced_by_the_next(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    assert last_examination(tmp_path, "doctor", "bench") is None
    for rig in ("other", "bench"):
        found = Diagnosis(rig, FINDINGS, {}, None, None, None, ()).document()
        assert keep(tmp_path, "doctor", found)
    kept = last_examination(tmp_path, "doctor", "bench")
    assert kept is not None
    assert kept.found == found
    assert utc_now() - kept.at < timedelta(minutes=1)
    assert [last_examination(tmp_path, "doctor", "other"), last_examination(tmp_path, "conform", "bench")] == [None] * 2


def test_nothing_is_kept_where_no_service_keeps_its_data(tmp_path: Path) -> None:
    assert not keep(tmp_path, "doctor", {"rig": "bench"})
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_none_of_ours_is_as_if_it_were_not_there(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    for text in ("{}", "[" * 9999, "\x00", '{"rig": "bench"}'):
        (tmp_path / "doctor.json").write_text(text)
        assert last_examination(tmp_path, "doctor", "bench") is None
