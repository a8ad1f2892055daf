"""Old calibrations removed, because one a night fills the disk: never the one in use, nor one that a scan names.

A scan names the calibration that it was measured by in its report and in its bundle: by the solve's id, or by a digest
of the numbers where the calibration says nothing of its own error.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

import structlog

from slrig.bundle import read_calibration
from slrig.calibrate.calibrating import Calibrations
from slrig.calibrate.records import SessionRecord
from slrig.errors import CalibrationError, CalibrationNotFoundError, CalibrationStateError, StorageError
from slrig.jobs.data_folder import DataFolder

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Retention:
    """Keeps the newest calibrations of a data folder, and those that are needed. Any thread may call.

    keep : so many are kept whatever they are. named : further names of calibrations that are needed.
    """

    calibrations: Calibrations
    folder: DataFolder
    keep: int
    named: Callable[[], set[str]] = set

    def __call__(self) -> tuple[UUID, ...]:
        """Remove what is neither new nor needed, say so in the log, and return which."""
        old = [record for record in self.calibrations.latest()[self.keep :] if not record.under_way]
        if not old:
            return ()
        needed = named_by_scans(self.folder.scans) | {_session_of(name) for name in self.named()}
        removed = []
        for record in reversed(old):
            if self._names(record) & needed:
                continue
            try:
                self.calibrations.delete(record.id)
            except (CalibrationNotFoundError, CalibrationStateError):
                # Gone, in use, or taken up again meanwhile.
                continue
            except StorageError as error:
                _log.warning("an old calibration could not be removed", calibration=str(record.id), cause=str(error))
                continue
            removed.append(record.id)
            _log.info(
                "old calibration removed",
                calibration=str(record.id),
                label=record.label,
                opened=record.created_at.isoformat(timespec="seconds"),
                poses=len(record.poses),
                kept=self.keep,
            )
        return tuple(removed)

    def _names(self, record: SessionRecord) -> set[str]:
        """What a scan may call it by."""
        names = {str(record.id)}
        for number in range(1, record.solve + 1):
            with suppress(CalibrationError):
                names.add(_session_of(self.calibrations.store.calibration(record.id, number).solve_id))
        return names


def named_by_scans(scans: Path) -> set[str]:
    """What the scans of a folder call the calibrations that they were measured by; of a solve's id, the session's part.

    A scan whose files cannot be read names none.
    """
    names = set()
    for scan in (place for place in scans.iterdir() if not place.is_symlink()):
        with suppress(OSError, ValueError, KeyError, TypeError):
            names.add(_session_of(json.loads((scan / "report.json").read_bytes())["calibration"]["id"]))
            continue
        with suppress(OSError, CalibrationError):
            # A scan that got no mesh may be reconstructed yet.
            names.add(_session_of(read_calibration(scan / "bundle" / "calibration.json").solve_id))
    return names


def _session_of(solve: str) -> str:
    """The part of a solve's name that all solves of its session share.

    >>> _session_of("3f2a.2"), _session_of("0123456789ab")
    ('3f2a', '0123456789ab')
    """
    return solve.partition(".")[0]
