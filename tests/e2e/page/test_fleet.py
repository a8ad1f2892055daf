"""Fleet: the rigs that share a catalogue."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import update

from slrig.catalogue.store import Catalogue, open_catalogue
from slrig.catalogue.tables import RigRow
from tests.e2e.conftest import Start, write_rig
from tests.e2e.page.conftest import PHONE, Visit, count, violations
from tests.e2e.page.golden import looks_as_kept
from tests.unit.catalogue.test_store import job, row

pytestmark = pytest.mark.slow


def others(catalogue: Catalogue) -> None:
    """Three more rigs: one works, one cannot, one has been silent for two days."""
    now = datetime.now(UTC)

    def scans(rig: str, number: int, hours: float, **other: Any) -> list[dict[str, Any]]:
        at = (now - timedelta(hours=hours)).isoformat()
        return [job(rig, finished_at=at, **other) for _ in range(number)]

    catalogue.see(row("hall-1", words="scan 5f1c", health="good", uncopied=0))
    why = "The camera 'left' does not answer. Plug it in again, then scan."
    catalogue.see(row("hall-2", state="fault", words=why, waiting=0, computing=0, health="stale", uncopied=12,
                      health_words="the projector has turned by 0.06°"))  # fmt: skip
    catalogue.see(row("hall-3"))
    too_dark = {"state": "failed", "fault_message": "The pictures are too dark: open the aperture."}
    catalogue.copy([
        *scans("hall-1", 41, 2, label="housing 17"), *scans("hall-2", 12, 5), *scans("hall-2", 1, 4, **too_dark),
        *scans("hall-3", 1, 49),
    ])  # fmt: skip
    with catalogue._writer.begin() as connection:
        gone = update(RigRow).where(RigRow.name == "hall-3")
        connection.execute(gone.values(seen_at=now - timedelta(days=2)))


def test_a_person_sees_many_rigs_at_once(start: Start, tmp_path: Path, visit: Visit) -> None:
    address = f"sqlite:///{tmp_path}/fleet.sqlite"
    catalogue = open_catalogue(address, None, None)
    catalogue.open()
    others(catalogue)
    service = start(write_rig(tmp_path / "rig"), SLRIG_CATALOGUE=address)
    with service.client() as client:
        client.scan()
    page = visit(service)
    page.get_by_role("link", name="Fleet").click()
    page.get_by_text("4 rigs, 1 not ready, 1 not seen for a minute or longer").wait_for()
    rigs = page.get_by_role("region", name="Rigs").get_by_role("row")
    count(rigs, 5)
    for number, words in enumerate(["busy", "does not answer", "not seen", "this one"]):
        rigs.nth(1 + number).get_by_text(words, exact=number == 2).first.wait_for()
    assert rigs.nth(3).get_by_text("not known").count() == 2
    assert violations(page) == []
    looks_as_kept(page, "fleet")
    phone = visit(service, "fleet", size=PHONE, dark=True)
    count(phone.get_by_role("region", name="Rigs").get_by_role("row"), 5)
    assert violations(phone) == []
    looks_as_kept(phone, "fleet-phone-dark")
    catalogue.close()
