"""The first step of a start: make the records and files of the last run agree."""

from __future__ import annotations

from pathlib import Path
from uuid import UUID

import structlog

from slrig.failure import interruption_error, job_failure
from slrig.jobs.data_folder import BUNDLE, damage, damaged_files, missing_files, remove
from slrig.jobs.database import or_none
from slrig.jobs.job import Job, Outcome
from slrig.jobs.manager import MAX_ATTEMPTS, JobManager
from slrig.jobs.records import JobRecord, JobState, acting_as, read_record

MAX_TAKES = 10
"""Most times that a job is lined up to be computed, where something ends the service before the worker begins it."""

_log = structlog.get_logger(__name__)


def resume(manager: JobManager) -> None:
    """End or continue every job that the last run left open. Once, before the manager starts.

    - A job with its files in their place had only its end missing on record.
    - One that waited waits again. One that computed, or waited for that, is computed from the frames that it has, until
      the worker has begun it `MAX_ATTEMPTS` times: those frames may be what ended the service each time.
    - Any other was interrupted; its frames are kept if it keeps them and all had come.
    - A deletion that was cut off is completed.
    - A job that succeeded and lacks files is recorded as failed.
    - Files of a finished job without a record that can be read, as after a lost database, are on record again, as they
      say themselves; other files without a record are put aside in `.orphans`.
    """
    store, data = manager.store, manager.data
    unreadable = {record.id for record in store.unreadable()}
    going_on = set()
    # What may have ended the service is the last in line.
    for record in sorted(store.unfinished(), key=lambda each: store.attempts(each.id)):
        try:
            job = manager.kinds[record.kind].from_record(record)
            # A job that is not ready is continued by its group.
            goes_on = not job.ready or _went_on(manager, record, job)
        except Exception:  # noqa: BLE001 - the others, and the service, go on all the same
            _log.exception("a job could not be gone on with", job=str(record.id))
            store.finish(record.id, JobState.INTERRUPTED, fault=job_failure(interruption_error()))
            continue
        if goes_on:
            going_on.add(str(record.id))
    for record in store.finished():
        if record.state is JobState.SUCCEEDED:
            _require_files(manager, record)
    for leftover in data.incoming.iterdir():
        if leftover.name not in going_on:
            remove(leftover)
    for kind in manager.kinds.values():
        _restore(manager, kind, unreadable)


def _went_on(manager: JobManager, record: JobRecord, job: Job) -> bool:
    """Continue a job, or end it; return whether it continues."""
    store, data = manager.store, manager.data
    place, group = job.place(data, record.id), manager.groups.get(record.kind)
    kept = None if place is None else read_record(place)
    if kept is not None and kept.id == record.id and place is not None and not missing_files(place, job.promises):
        outcome = Outcome(kept.summary, kept.fault)
        if group is not None:
            with acting_as(record.requested_by):
                outcome = group.ended(job, record.id, outcome)
        state = JobState.SUCCEEDED if outcome.fault is None else JobState.FAILED
        store.finish(record.id, state, fault=outcome.fault, summary=outcome.summary)
        _note(record, "recovered")
        return False
    whole = not job.uses_rig or data.owns(data.staging(record.id) / BUNDLE)
    captured = record.state is JobState.COMPUTING and whole
    # A job without the rig has waited, also while its views were captured.
    waited = record.state is JobState.QUEUED or (not job.uses_rig and not captured)
    tried = store.attempts(record.id) >= MAX_ATTEMPTS or store.takes(record.id) >= MAX_TAKES
    if waited or (captured and not tried):
        manager.begin(job, record, captured=captured)
        _note(record, "taken up again")
        return True
    if captured and job.keeps_bundle:
        manager.keep_bundle(job, record.id)
    if group is not None:
        group.ended(job, record.id, None)
    store.finish(record.id, JobState.INTERRUPTED, fault=job_failure(interruption_error()))
    _note(record, "interrupted")
    return False


def _require_files(manager: JobManager, record: JobRecord) -> None:
    """Record a job that succeeded as failed where files of it are gone, or complete its deletion."""
    store, data = manager.store, manager.data
    try:
        job = manager.kinds[record.kind].from_record(record)
    except ValueError:
        _log.warning("left by the last run", kind=str(record.kind), job=str(record.id), found="of another version")
        return
    place = job.place(data, record.id)
    if place is None:
        return
    missing = missing_files(place, job.promises)
    if missing and data.owns(data.staging(record.id)):
        store.delete(record.id)
        return
    found = {**damaged_files(place, digests=False), **dict.fromkeys(missing, "is gone")}
    if found:
        again = job.movable and data.owns(place / BUNDLE)
        remedy = f"POST {record.kind.path}/{record.id}/reconstruct makes them again." if again else job.remedy
        store.lose_files(
            record.id, job_failure(damage(f"Files in {place.relative_to(data.root)} are damaged", found, remedy))
        )
        _note(record, "damaged")


def _restore(manager: JobManager, kind: type[Job], unreadable: set[UUID]) -> None:
    """Put finished jobs on record again, in the order of their making, and other files aside.

    unreadable : jobs with records to replace.
    """
    store, data = manager.store, manager.data
    known, found = set(store.states(kind.kind)), list[tuple[JobRecord, Path]]()
    for place in kind.places(data):
        kept = None if place.is_symlink() else read_record(place)
        job_id = kept.id if kept is not None else or_none(UUID, place.name)
        belongs = kept is not None and _belongs(manager, kept, place)
        if job_id in known and (kept is None or (belongs and job_id not in unreadable)):
            continue
        if kept is not None and belongs:
            if kept.id in unreadable:
                store.delete(kept.id)
            found.append((kept, place))
        else:
            data.put_aside(place)
            _log.warning("left by the last run", files=place.name, found="put aside")
    for kept, _ in sorted(found, key=lambda each: each[0].created_at):
        with acting_as(kept.requested_by):
            store.restore(kept)
        _note(kept, "recovered")
        if kept.state is JobState.SUCCEEDED:
            _require_files(manager, kept)


def _belongs(manager: JobManager, kept: JobRecord, place: Path) -> bool:
    """Whether a record was found in the folder where its files belong."""
    try:
        return manager.kinds[kept.kind].from_record(kept).place(manager.data, kept.id) == place
    except (KeyError, ValueError):
        return False


def _note(record: JobRecord, found: str) -> None:
    _log.warning("left by the last run", kind=str(record.kind), job=str(record.id), found=found)
