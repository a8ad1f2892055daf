"""What the service does first: bring records and files together again after whatever ended the last run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

from slrig.errors import StorageError
from slrig.failure import interruption_error, job_failure
from slrig.jobs.data_folder import DataFolder, missing_files, remove
from slrig.jobs.records import JobState, acting_as
from slrig.jobs.store import JobStore, unfinished_ids
from slrig.scan.records import plan_json, read_record, report_summary


@dataclass(frozen=True, slots=True)
class Swept:
    """What a sweep found: scans that were cut off, those that go on, those whose record was lost in part or in all, and
    strays on either side.
    """

    interrupted: tuple[UUID, ...]
    resumed: tuple[UUID, ...]
    recovered: tuple[UUID, ...]
    lost: tuple[UUID, ...]
    put_aside: tuple[str, ...]


def sweep(store: JobStore, folder: DataFolder) -> Swept:
    """Settle every scan that the last run left open. Only for the process that holds the folder, before it scans.

    - A running scan whose mesh and report are in place had only its record missing: succeeded.
    - A queued one waits again, and one that was being reconstructed is, once more, from its bundle: the runner takes
      them up. What has ended the service in the middle of the second attempt, too, may lie in its frames.
    - Any other running scan is interrupted; its bundle is kept if the capture was complete.
    - A finished scan whose folder is back in staging was being deleted: the deletion is completed.
    - A succeeded scan without mesh or report is recorded as failed.
    - A finished scan without a record, as beside a database that was lost, is on record again, as it says itself.
    - Other files without a record are put aside in `.orphans`, not deleted.
    """
    interrupted, resumed, recovered, lost = [], [], [], []
    for record in store.unfinished():
        placed = folder.scan(record.id)
        if not missing_files(placed):
            report = json.loads((placed / "report.json").read_bytes())
            store.finish(record.id, JobState.SUCCEEDED, summary=report_summary(report))
            recovered.append(record.id)
            continue
        # Frames become the bundle when they are durable, so this one is whole.
        whole = record.state is JobState.COMPUTING and folder.owns(folder.staging(record.id) / "bundle")
        if record.state is JobState.QUEUED or (whole and store.attempts(record.id) == 1):
            resumed.append(record.id)
            continue
        if whole:
            folder.keep_bundle(record.id)
        store.finish(record.id, JobState.INTERRUPTED, fault=job_failure(interruption_error()))
        interrupted.append(record.id)
    for scan_id, state in store.states().items():
        if state is JobState.SUCCEEDED and (missing := missing_files(folder.scan(scan_id))):
            if folder.owns(folder.staging(scan_id)):
                store.delete(scan_id)
                continue
            message = f"{' and '.join(missing)} of this scan is gone from {folder.scan(scan_id)}. Scan again."
            store.lose_files(scan_id, job_failure(StorageError(message)))
            lost.append(scan_id)
    # Those of other kinds see to their own files.
    going_on = unfinished_ids(store.database)
    for leftover in folder.incoming.iterdir():
        if leftover.name not in going_on:
            remove(leftover)
    recovered += _restored(store, folder)
    return Swept(tuple(interrupted), tuple(resumed), tuple(recovered), tuple(lost), _put_aside(store, folder))


def _restored(store: JobStore, folder: DataFolder) -> list[UUID]:
    """Finished scans that tell what their record was, and have none; put on record in the order of their making."""
    whole = [path for path in _strays(store, folder) if not missing_files(path)]
    kept = [record for path in whole if (record := read_record(path)) is not None and str(record.id) == path.name]
    for record in sorted(kept, key=lambda each: each.created_at):
        report = json.loads((folder.scan(record.id) / "report.json").read_bytes())
        with acting_as(record.requested_by):
            store.restore(
                record.id,
                plan_json(record.plan),
                report_summary(report),
                rig=record.rig,
                label=record.label,
                created_at=record.created_at,
                started_at=record.started_at,
            )
    return [record.id for record in kept]


def _strays(store: JobStore, folder: DataFolder) -> list[Path]:
    known = {str(scan_id) for scan_id in store.states()}
    return [path for path in folder.scans.iterdir() if path.name not in known]


def _put_aside(store: JobStore, folder: DataFolder) -> tuple[str, ...]:
    strays = _strays(store, folder)
    for stray in strays:
        folder.orphans.mkdir(exist_ok=True)
        stray.rename(folder.orphans / stray.name)
    return tuple(sorted(stray.name for stray in strays))
