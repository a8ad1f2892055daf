"""What the service does first: bring records and files together again after whatever ended the last run."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

from slrig.errors import StorageError
from slrig.scan.faults import fault_of, interruption
from slrig.scan.folder import DataFolder, missing_files
from slrig.scan.records import ScanState, report_summary
from slrig.scan.store import ScanStore


@dataclass(frozen=True, slots=True)
class Swept:
    """What a sweep found: scans that were cut off, scans that had finished unrecorded, and strays on either side."""

    interrupted: tuple[UUID, ...]
    recovered: tuple[UUID, ...]
    lost: tuple[UUID, ...]
    put_aside: tuple[str, ...]


def sweep(store: ScanStore, folder: DataFolder) -> Swept:
    """Settle every scan that the last run left open. Only for the process that holds the folder, before it scans.

    - A running scan whose mesh and report are in place had only its record missing: succeeded.
    - Any other running scan is interrupted; its bundle is kept if the capture was complete.
    - A finished scan whose folder is back in staging was being deleted: the deletion is completed.
    - A succeeded scan without mesh or report is recorded as failed.
    - Files without a record are put aside in `.orphans`, not deleted.
    """
    store.release_keys()
    interrupted, recovered, lost = [], [], []
    for record in store.unfinished():
        placed = folder.scan(record.id)
        if not missing_files(placed):
            report = json.loads((placed / "report.json").read_bytes())
            store.finish(record.id, ScanState.SUCCEEDED, summary=report_summary(report))
            recovered.append(record.id)
            continue
        # Reconstruction starts only after the bundle was made durable, so this bundle is whole.
        if record.state is ScanState.RECONSTRUCTING and (folder.staging(record.id) / "bundle").is_dir():
            folder.keep_bundle(record.id)
        store.finish(record.id, ScanState.INTERRUPTED, fault=fault_of(interruption()))
        interrupted.append(record.id)
    for scan_id, state in store.states().items():
        if state is ScanState.SUCCEEDED and (missing := missing_files(folder.scan(scan_id))):
            if folder.staging(scan_id).is_dir():
                store.delete(scan_id)
                continue
            message = f"{' and '.join(missing)} of this scan is gone from {folder.scan(scan_id)}. Scan again."
            store.lose_files(scan_id, fault_of(StorageError(message)))
            lost.append(scan_id)
    for leftover in folder.incoming.iterdir():
        shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
    return Swept(tuple(interrupted), tuple(recovered), tuple(lost), _put_aside(store, folder))


def _put_aside(store: ScanStore, folder: DataFolder) -> tuple[str, ...]:
    known = {str(scan_id) for scan_id in store.states()}
    strays: list[Path] = [path for path in folder.scans.iterdir() if path.name not in known]
    for stray in strays:
        folder.orphans.mkdir(exist_ok=True)
        stray.rename(folder.orphans / stray.name)
    return tuple(sorted(stray.name for stray in strays))
