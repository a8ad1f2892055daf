"""Hundreds of scans with retention on: memory, descriptors and disk stay flat, and nothing that is kept goes.

`pytest tests/bench/test_many_scans.py -s`; SLRIG_SCANS says how many, 500 unless it does.
"""

from __future__ import annotations

import os
import statistics
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.e2e.conftest import ServiceProcess, Start, ended, write_rig

SCANS = int(os.environ.get("SLRIG_SCANS") or 500)
KEPT = 10
WARM = 50
"""Scans before the first figure: caches fill."""


@dataclass(frozen=True)
class Held:
    """What the service and its worker hold: resident memory, open files, threads; and what its data folder takes."""

    service_mb: float
    worker_mb: float
    descriptors: int
    threads: int
    disk_mb: float

    @classmethod
    def of(cls, service: ServiceProcess) -> Held:
        """As the kernel and the disk tell it now."""
        serving, working = Path(f"/proc/{service.process.pid}"), Path(f"/proc/{service.worker_id()}")
        # The next scan is not begun yet; what retention removes meanwhile may be gone.
        sizes = []
        for path in service.data.rglob("*"):
            with suppress(FileNotFoundError):
                sizes.append(path.stat().st_size)
        return cls(
            _resident_mb(serving),
            _resident_mb(working),
            len(list((serving / "fd").iterdir())) + len(list((working / "fd").iterdir())),
            len(list((serving / "task").iterdir())),
            sum(sizes) / 1e6,
        )


def _resident_mb(process: Path) -> float:
    return int((process / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_hundreds_of_scans_leave_nothing_behind(start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLRIG_KEEP_SCANS", str(KEPT))
    service = start(write_rig(tmp_path / "rig"))
    figures: list[Held] = []
    with service.client() as client:
        pinned = ended(client, client.scans.start(label="pinned"))
        client.scans.pin(pinned["id"])
        read = ended(client, client.scans.start(label="being read"))["links"]["self"]
        for number in range(SCANS):
            scan = ended(client, client.scans.start())
            assert scan["state"] == "succeeded", scan
            # Somebody goes on reading this one.
            client.fetch(f"{read}/report.json", tmp_path / "report.json")
            if number >= WARM and number % 25 == 0:
                figures.append(Held.of(service))
                print(number, figures[-1])  # noqa: T201 - figures of the bench
        kept = {each["links"]["self"] for each in client.get("/scan?limit=200")["scans"]}
        for path in (pinned["links"]["self"], read):
            assert path in kept
            client.fetch(f"{path}/mesh.ply", tmp_path / "mesh.ply")
    assert KEPT <= len(kept) <= KEPT + 2
    third = max(len(figures) // 3, 1)
    for name, most in (
        ("service_mb", 1.1),
        ("worker_mb", 1.1),
        ("descriptors", 1.05),
        ("threads", 1.1),
        ("disk_mb", 1.1),
    ):
        early = statistics.median(getattr(each, name) for each in figures[:third])
        late = statistics.median(getattr(each, name) for each in figures[-third:])
        assert late <= most * early, (name, early, late)
