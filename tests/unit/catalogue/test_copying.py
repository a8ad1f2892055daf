"""What a service tells the catalogue: every job that ended, once, in order, whatever happens meanwhile."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from slrig.catalogue import copying
from slrig.catalogue.copying import Copier
from slrig.catalogue.fleet import BEAT_S
from slrig.catalogue.store import Catalogue, open_catalogue
from slrig.errors import CatalogueError
from slrig.failure import JobFailure
from slrig.jobs.copies import Copies
from slrig.jobs.database import Database
from slrig.jobs.outbox import Outbox
from slrig.jobs.records import JobKind, JobState
from slrig.jobs.store import JobStore
from tests.unit.catalogue.test_store import row, sql


class Rig:
    """The records of a rig, and what copies them."""

    def __init__(self, folder: Path, catalogue: Catalogue, *, name: str = "hall-3", copied: bool = True) -> None:
        self.name = name
        self.now_s = 0.0
        self.database = Database(folder / f"{name}.sqlite")
        self.copies = Copies(self.database)
        outbox = Outbox(self.database, copies=self.copies if copied else None)
        self.jobs = JobStore(self.database, JobKind.SCAN, outbox=outbox)
        self.copier = Copier(catalogue, self.copies, lambda: self.standing, clock=lambda: self.now_s)
        self.standing = {key: value for key, value in row(name).items() if key != "uncopied"}

    def end_job(self, label: str, *, deleted: bool = False) -> None:
        job = self.jobs.create({}, rig=self.name, label=label)
        self.jobs.finish(job.id, JobState.SUCCEEDED, summary={"mesh": {"points": 3, "figures": {"triangles": 1}}})
        if deleted:
            self.jobs.delete(job.id)


@pytest.fixture
def rig(tmp_path: Path, catalogue: Catalogue) -> Iterator[Rig]:
    found = Rig(tmp_path, catalogue)
    yield found
    found.copier.close()
    found.database.close()


def labels(catalogue: Catalogue) -> list[str]:
    return [label for (label,) in sql(catalogue, "SELECT label FROM finished_job ORDER BY number")]


def test_jobs_come_once_and_in_order_whatever_their_record_becomes(
    rig: Rig, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(copying, "BATCH", 5)
    # Retention removes one, and another's files are lost, before the catalogue was ever reached.
    names = [f"part {number}" for number in range(8)]
    for name in names:
        rig.end_job(name, deleted=name == "part 1")
    lost = rig.jobs.page(before=None, limit=1)[0]
    rig.jobs.lose_files(lost.id, JobFailure("storage", "its files are gone"))
    assert rig.copies.waiting()[0] == 9
    assert rig.copier.step() == BEAT_S
    assert labels(catalogue) == names
    (last,) = sql(catalogue, "SELECT state, fault_code, points, triangles FROM finished_job WHERE label = 'part 7'")
    assert last == ("failed", "storage", None, None)
    assert rig.copies.waiting() == (0, 0.0)
    assert [(each.name, each.uncopied) for each in catalogue.fleet().rigs] == [("hall-3", 0)]


def test_a_copy_that_was_not_noted_comes_again_and_is_one_row(
    rig: Rig, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.end_job("one")
    with monkeypatch.context() as killed:
        killed.setattr(rig.copies, "taken", lambda _: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            rig.copier.step()
    rig.end_job("two")
    rig.copier.step()
    assert labels(catalogue) == ["one", "two"]


def test_what_ended_without_a_catalogue_or_what_it_lost_is_brought_up(tmp_path: Path, catalogue: Catalogue) -> None:
    before = Rig(tmp_path, catalogue, copied=False)
    for name in ("one", "two", "three"):
        before.end_job(name)
    before.database.close()
    rig = Rig(tmp_path, catalogue)
    rig.end_job("four")
    rig.copier.step()
    assert labels(catalogue) == ["one", "two", "three", "four"]
    # An older backup of the catalogue was brought back, while the rig could not reach it.
    sql(catalogue, "DELETE FROM finished_job WHERE label IN ('two', 'four')")
    rig.copier._opened = False
    rig.end_job("five")
    rig.copier.step()
    assert labels(catalogue) == ["one", "three", "two", "four", "five"]
    rig.database.close()


def test_state_of_a_rig_is_copied_at_each_beat(rig: Rig, catalogue: Catalogue) -> None:
    rig.copier.step()
    rig.standing["state"] = "fault"
    rig.now_s = BEAT_S - 1
    assert rig.copier.step() == 1
    assert catalogue.fleet().rigs[0].state == "busy"
    rig.now_s = BEAT_S
    assert rig.copier.step() == BEAT_S
    assert catalogue.fleet().rigs[0].state == "fault"


def test_unreachable_catalogue_is_logged_and_holds_nothing_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copying, "FIRST_WAIT_S", 0.01)
    folder = tmp_path / "share"
    catalogue = open_catalogue(f"sqlite:///{folder}/fleet.sqlite", None, None)
    rig = Rig(tmp_path, catalogue)
    with capture_logs() as logs:
        rig.copier.start()
        rig.end_job("one")
        while rig.copier._failures < 3:
            rig.copier._ending.wait(0.01)
        assert (rig.copier.status().waiting, rig.copies.waiting()[0]) == (1, 1)
        with pytest.raises(CatalogueError, match=r"unable to open.*scans on, and tries again by itself"):
            rig.copier.fleet()
        folder.mkdir()
        copied = rig.copies.waiting()
        while copied[0]:
            rig.copier._ending.wait(0.01)
            copied = rig.copies.waiting()
        rig.copier.close()
    assert [each["event"] for each in logs] == [
        "the catalogue is not told of this rig",
        "the catalogue is told of this rig",
    ]
    assert labels(catalogue) == ["one"]
    assert catalogue.fleet().rigs[0].state == "stopped"
    catalogue.close()
    rig.database.close()
