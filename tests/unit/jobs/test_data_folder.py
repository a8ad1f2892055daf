"""The data folder: one owner, one rename, a sweep that loses nothing, and its backups."""

from __future__ import annotations

import errno
import json
import os
import stat
import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import UUID, uuid4

import numpy as np
import pytest
from structlog.testing import capture_logs

from slrig.api.server import ADDRESS_FILE, KINDS
from slrig.devices import Rig
from slrig.doctor import keep, last_examination
from slrig.doctor.doctor import Diagnosis
from slrig.doctor.light import fault, ok
from slrig.errors import DataFolderGoneError, DeviceGoneError, StorageError
from slrig.failure import disk_errors
from slrig.jobs import backup
from slrig.jobs.backup import back_up, read_manifest, restore
from slrig.jobs.data_folder import FILES, DataFolder, FileEntry, damaged_files, write_entries
from slrig.jobs.database import Database
from slrig.jobs.manager import JobManager
from slrig.jobs.records import JobKind, JobRecord, JobState, utc_now, write_record
from slrig.jobs.resume import resume
from slrig.jobs.store import JobStore
from slrig.rig.session import RigSession
from slrig.scan.job import plan_from_json, plan_json
from slrig.scan.plan import ScanPlan
from tests.core import parametrize_core
from tests.unit.command import refused, slrig
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.scan.bench import PIPELINE, failure_code


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[DataFolder]:
    folder = DataFolder(tmp_path / "data")
    yield folder
    folder.release()


@pytest.fixture
def store(folder: DataFolder) -> Iterator[JobStore]:
    store = JobStore(Database(folder.database))
    yield store
    store.database.close()


def running(store: JobStore, state: JobState) -> UUID:
    scan = waiting(store)
    store.advance(scan, state)
    return scan


def waiting(store: JobStore) -> UUID:
    return store.create(plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench").id


def settled(store: JobStore, folder: DataFolder) -> dict[str, set[str]]:
    """What the start of a service finds: the jobs, or the files, by what it says of them."""

    def no_rig() -> Rig:
        raise DeviceGoneError("not plugged in")

    manager = JobManager(store, folder, RigSession("bench", no_rig), TameCompute(PIPELINE), *KINDS)
    with capture_logs() as logs:
        resume(manager)
    found: dict[str, set[str]] = defaultdict(set)
    for each in logs:
        if each["event"] == "left by the last run":
            found[each["found"]].add(each.get("job") or each["files"])
    return found


def staged_bundle(folder: DataFolder, scan_id: UUID) -> Path:
    bundle = folder.stage(scan_id) / "bundle"
    bundle.mkdir()
    (bundle / "bundle.json").write_text("{}")
    return bundle


def test_second_owner_is_refused_and_leaves_the_first_its_lock(folder: DataFolder) -> None:
    for _ in range(2):
        with pytest.raises(StorageError, match=f"process id {os.getpid()}"):
            DataFolder(folder.root)
    (folder.root / "holder").unlink()
    with pytest.raises(StorageError, match="process id unknown"):
        DataFolder(folder.root)


@pytest.mark.slow
def test_folder_of_a_process_that_was_killed_may_be_taken(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from slrig.jobs.data_folder import DataFolder\n"
        "held = DataFolder(Path(sys.argv[1])); print('held', flush=True); time.sleep(600)"
    )
    holder = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)  # noqa: S603
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"held\n"
    with pytest.raises(StorageError, match=f"process id {holder.pid}"):
        DataFolder(tmp_path)
    holder.kill()
    holder.wait()
    holder.stdout.close()
    DataFolder(tmp_path).release()


def test_released_folder_may_be_taken_again(folder: DataFolder) -> None:
    # By whichever thread ends the service.
    other = threading.Thread(target=folder.release)
    other.start()
    other.join()
    folder.release()
    DataFolder(folder.root).release()


SUMMARY = {"truth": {"rms_mm": 0.01}}


def finished(folder: DataFolder, record: JobRecord) -> None:
    """The files of a scan that has come to its end."""
    place = folder.scan(record.id)
    place.mkdir()
    (place / "mesh.ply").write_bytes(b"ply")
    (place / "report.json").write_text("{}")
    write_record(place, replace(record, state=JobState.SUCCEEDED, summary=SUMMARY, has_files_json=True))
    write_entries(place)


def test_space_is_asked_for_before_a_scan(tmp_path: Path) -> None:
    folder = DataFolder(tmp_path, free=lambda _: 1_000_000)
    folder.require_space(1_000_000)
    with pytest.raises(StorageError, match=r"2 MB .* 1 MB are free"):
        folder.require_space(2_000_000)
    folder.release()


def test_each_file_of_a_scan_is_brought_to_disk_once(folder: DataFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[Path] = []
    monkeypatch.setattr("slrig.bundle.storage._sync", lambda path, _flags: synced.append(path))
    scan_id = uuid4()
    staged, recording = folder.stage(scan_id), folder.recording(scan_id)
    recording.mkdir()
    (recording / "000.png").write_bytes(b"frame")
    folder.keep_recording(scan_id)
    result = folder.result(scan_id)
    result.mkdir()
    (result / "mesh.ply").write_bytes(b"mesh")
    folder.put(scan_id, folder.scan(scan_id))
    files = (recording / "000.png", staged / "mesh.ply")
    assert [synced.count(path) for path in (*files, recording, folder.scans)] == [1, 1, 1, 1]
    # The bundle's name, that of the list of files, and then those of the results.
    assert synced.count(staged) == 3
    assert not [path for path in synced if path.is_relative_to(staged / "bundle")]


def test_committed_scan_has_its_results_beside_its_bundle(folder: DataFolder) -> None:
    scan_id = uuid4()
    staged_bundle(folder, scan_id)
    result = folder.staging(scan_id) / "result"
    result.mkdir()
    (result / "mesh.ply").write_bytes(b"ply")
    folder.put(scan_id, folder.scan(scan_id))
    assert {path.name for path in folder.scan(scan_id).iterdir()} == {"bundle", FILES, "mesh.ply"}
    assert list(folder.incoming.iterdir()) == []


def test_refusal_of_the_disk_names_the_place_and_the_remedy_and_other_errors_pass_through(tmp_path: Path) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "mesh.ply")
    for raised, kind, words in (
        (full, StorageError, r"mesh\.ply.*No space left on device.*free some space"),
        (FileNotFoundError("absent"), FileNotFoundError, "absent"),
    ):
        with pytest.raises(kind, match=words), disk_errors(tmp_path):
            raise raised


@pytest.mark.parametrize("state", [JobState.CAPTURING, JobState.COMPUTING])
def test_start_records_a_cut_off_capture_as_interrupted_and_clears_its_files(
    store: JobStore, folder: DataFolder, state: JobState
) -> None:
    scan_id = running(store, state)
    if state is JobState.CAPTURING:
        staged_bundle(folder, scan_id)
    else:
        # Killed between the light and the end of the recording: its frames are not all on the disk.
        folder.stage(scan_id)
        folder.recording(scan_id).mkdir()
    assert settled(store, folder) == {"interrupted": {str(scan_id)}}
    record = store.get(scan_id)
    assert (record.state, failure_code(record)) == (JobState.INTERRUPTED, "scan-interrupted")
    assert not folder.scan(scan_id).exists()
    assert list(folder.incoming.iterdir()) == []


def test_what_waits_or_computes_goes_on(store: JobStore, folder: DataFolder) -> None:
    cut_off = running(store, JobState.COMPUTING)
    staged_bundle(folder, cut_off)
    queued = waiting(store)
    assert settled(store, folder) == {"taken up again": {str(cut_off), str(queued)}}
    assert [record.id for record in store.unfinished()] == [cut_off, queued]
    assert (folder.staging(cut_off) / "bundle").is_dir()


def test_start_keeps_the_whole_bundle_of_a_reconstruction_that_was_cut_off_three_times(
    store: JobStore, folder: DataFolder
) -> None:
    scan_id = running(store, JobState.COMPUTING)
    for _ in range(3):
        store.begin_attempt(scan_id)
    staged_bundle(folder, scan_id)
    (folder.staging(scan_id) / "result.part").mkdir()
    settled(store, folder)
    assert store.get(scan_id).state is JobState.INTERRUPTED
    assert {path.name for path in folder.scan(scan_id).iterdir()} == {"bundle", FILES}


@pytest.mark.parametrize("whole", [True, False])
def test_start_recognises_a_scan_that_lacked_only_its_last_record(
    store: JobStore, folder: DataFolder, whole: bool
) -> None:
    scan_id = running(store, JobState.COMPUTING)
    finished(folder, store.get(scan_id))
    if not whole:
        (folder.scan(scan_id) / "mesh.ply").unlink()
    assert settled(store, folder) == {"recovered" if whole else "interrupted": {str(scan_id)}}
    assert store.get(scan_id).state is (JobState.SUCCEEDED if whole else JobState.INTERRUPTED)
    assert store.get(scan_id).summary == (SUMMARY if whole else None)


def test_start_completes_a_deletion_that_was_cut_off(store: JobStore, folder: DataFolder) -> None:
    scan_id = running(store, JobState.COMPUTING)
    finished(folder, store.get(scan_id))
    store.finish(scan_id, JobState.SUCCEEDED)
    folder.withdraw(folder.scan(scan_id), scan_id)
    settled(store, folder)
    assert scan_id not in store.states()
    assert list(folder.incoming.iterdir()) == []


@pytest.mark.parametrize("gone", [("mesh.ply",), ("report.json",), ("mesh.ply", "report.json")])
def test_start_says_when_the_files_of_a_scan_are_gone(
    store: JobStore, folder: DataFolder, gone: tuple[str, ...]
) -> None:
    scan_id = running(store, JobState.COMPUTING)
    store.finish(scan_id, JobState.SUCCEEDED)
    finished(folder, store.get(scan_id))
    for name in gone:
        (folder.scan(scan_id) / name).unlink()
    assert settled(store, folder) == {"damaged": {str(scan_id)}}
    record = store.get(scan_id)
    assert record.state is JobState.FAILED
    assert record.fault is not None
    assert record.fault.code == "damaged"
    assert all(f"{name} is gone" in record.fault.message for name in gone)


@parametrize_core("name", ["mesh.ply", "report.json", FILES])
@parametrize_core("damage", ["cut", "emptied", "removed", "a folder"], core=[0, 2])
def test_start_says_which_files_of_a_scan_are_damaged(
    store: JobStore, folder: DataFolder, name: str, damage: str
) -> None:
    scan_id = running(store, JobState.COMPUTING)
    finished(folder, store.get(scan_id))
    assert store.finish(scan_id, JobState.SUCCEEDED, summary=SUMMARY)
    assert settled(store, folder) == {}
    path = folder.scan(scan_id) / name
    content = path.read_bytes()
    path.unlink()
    if damage == "a folder":
        path.mkdir()
    elif damage != "removed":
        path.write_bytes(content[:-1] if damage == "cut" else b"")
    settled(store, folder)
    record = store.get(scan_id)
    assert (record.state, record.fault is None) == (JobState.FAILED, False)
    assert record.fault is not None
    assert name in record.fault.message


def test_what_was_found_whole_is_forgotten_with_its_folder(store: JobStore, folder: DataFolder) -> None:
    places = []
    for _ in range(2):
        scan_id = running(store, JobState.COMPUTING)
        finished(folder, store.get(scan_id))
        places.append(folder.scan(scan_id))
        folder.require_whole(places[-1], "mesh.ply", "report.json")
    folder.remove(places[0])
    assert {path.parent for path in folder._whole} == {places[1]}
    folder.withdraw(places[1], UUID(places[1].name))
    assert folder._whole == {}


def test_every_changed_bit_is_found_and_no_file_that_came_later(tmp_path: Path) -> None:
    (tmp_path / "bundle").mkdir()
    for name in ("mesh.ply", "bundle/000.png"):
        (tmp_path / name).write_bytes(bytes(range(50)))
    write_entries(tmp_path)
    (tmp_path / "mesh.obj").write_text("made on request")
    assert damaged_files(tmp_path, digests=True) == {}
    rng = np.random.default_rng(7)
    for name in ("mesh.ply", "bundle/000.png"):
        for bit in rng.choice(400, 20, replace=False):
            changed = bytearray(range(50))
            changed[bit // 8] ^= 1 << (bit % 8)
            (tmp_path / name).write_bytes(changed)
            assert damaged_files(tmp_path, digests=True) == {name: "was changed"}
            assert damaged_files(tmp_path, digests=False) == {}
        (tmp_path / name).write_bytes(bytes(range(50)))


def test_check_names_each_damaged_file_of_a_data_folder(store: JobStore, folder: DataFolder) -> None:
    places = []
    for _ in range(2):
        scan_id = running(store, JobState.COMPUTING)
        finished(folder, store.get(scan_id))
        places.append(folder.scan(scan_id))
    staged = folder.stage(uuid4())
    write_entries(staged)
    whole = slrig("check", folder.root)
    assert (whole.exit_code, whole.stdout) == (0, "6 files of finished jobs, none damaged\n")
    (places[0] / "mesh.ply").write_bytes(b"plz")
    (places[1] / "report.json").unlink()
    damaged = slrig("check", folder.root, "--json")
    assert damaged.exit_code == 1
    assert json.loads(damaged.stdout) == {
        "files": 6,
        "damaged": {
            f"scans/{places[0].name}/mesh.ply": "was changed",
            f"scans/{places[1].name}/report.json": "is gone",
        },
    }
    (places[1] / FILES).write_bytes(b"{")
    assert f"scans/{places[1].name}/{FILES} cannot be read" in slrig("check", folder.root).stdout
    assert "not a data folder" in refused(slrig("check", folder.root / "scans"))


def test_a_damaged_file_is_in_no_backup(tmp_path: Path, store: JobStore, folder: DataFolder) -> None:
    scan_id = running(store, JobState.COMPUTING)
    finished(folder, store.get(scan_id))
    store.finish(scan_id, JobState.SUCCEEDED, summary=SUMMARY)
    (folder.scan(scan_id) / "mesh.ply").write_bytes(b"plz")
    made = backup.back_up(folder.root, tmp_path / "backup")
    assert f"scans/{scan_id}/mesh.ply: is damaged" in made.left_out
    assert f"scans/{scan_id}/mesh.ply" not in made.files
    assert f"scans/{scan_id}/report.json" in made.files
    assert not list((tmp_path / "backup").rglob("mesh.ply"))


def test_start_puts_finished_scans_on_record_again_beside_a_database_that_was_lost(
    store: JobStore, folder: DataFolder
) -> None:
    plan, made = ScanPlan(exposure_s=0.02), datetime(2026, 11, 23, 12, 0, tzinfo=UTC)
    for i in range(3):
        store.create(plan_json(plan), kind=JobKind.SCAN, rig="bench", label=f"part {i}")
    records = [
        replace(record, created_at=made - timedelta(hours=i), started_at=made)
        for i, record in enumerate(store.unfinished())
    ]
    for record in records:
        finished(folder, record)
        store.delete(record.id)
    # Renamed since, also to have no name; that is no damage.
    for record, label in ((records[0], "part 0, turned"), (records[2], None)):
        folder.relabel(record.id, folder.scan(record.id), "in between")
        write_entries(folder.scan(record.id))
        folder.relabel(record.id, folder.scan(record.id), label)
        assert damaged_files(folder.scan(record.id), digests=True) == {}
    (folder.scan(records[1].id) / "mesh.ply").unlink()
    assert settled(store, folder) == {
        "recovered": {str(record.id) for record in records}, "damaged": {str(records[1].id)},
    }  # fmt: skip
    newest, damaged, oldest = store.page(before=None, limit=10)
    assert (newest.id, damaged.id, oldest.id) == tuple(record.id for record in records)
    assert damaged.fault is not None
    assert damaged.fault.code == "damaged"
    assert (newest.state, newest.created_at) == (JobState.SUCCEEDED, made)
    assert [record.label for record in (newest, damaged, oldest)] == ["part 0, turned", "part 1", None]
    assert plan_from_json(newest.plan) == plan
    assert newest.summary == SUMMARY
    assert [event.kind for event in store.events(newest.id, after=0)] == ["state"]
    assert settled(store, folder) == {}


def test_start_of_a_sound_folder_changes_nothing_and_puts_files_without_a_record_aside(
    store: JobStore, folder: DataFolder
) -> None:
    scan_id = running(store, JobState.COMPUTING)
    finished(folder, store.get(scan_id))
    store.finish(scan_id, JobState.SUCCEEDED)
    before = store.get(scan_id)
    assert settled(store, folder) == {}
    stray = folder.scans / "somebody"
    stray.mkdir()
    (stray / "mesh.ply").write_bytes(b"work")
    assert settled(store, folder) == {"put aside": {"somebody"}}
    assert (folder.orphans / "somebody" / "mesh.ply").read_bytes() == b"work"
    assert store.get(scan_id) == before


@pytest.mark.skipif(os.name == "nt", reason="Windows keeps who may read a folder elsewhere")
def test_other_users_of_the_machine_cannot_look_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "data"
    root.mkdir(mode=0o755)
    DataFolder(root).release()
    assert root.stat().st_mode & 0o7777 == 0o700
    group = root.group()
    DataFolder(root, group=group).release()
    assert root.stat().st_mode & 0o7777 == 0o2750
    with pytest.raises(StorageError, match="no group 'none-such' on this machine"):
        DataFolder(root, group="none-such")

    def refused(*_: object, **__: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "chmod", refused)
    DataFolder(root).release()
    with pytest.raises(StorageError, match=f"cannot be given to the group '{group}'"):
        DataFolder(root, group=group)


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    other = tmp_path / "elsewhere"
    other.mkdir()
    for name in ("mesh.ply", "report.json"):
        (other / name).write_text("{}")
    return other


def test_links_in_the_data_folder_are_neither_followed_nor_fatal(
    folder: DataFolder, store: JobStore, elsewhere: Path
) -> None:
    (folder.incoming / "to-a-folder").symlink_to(elsewhere)
    (folder.incoming / "to-nothing").symlink_to(elsewhere / "absent")
    cut = running(store, JobState.COMPUTING)
    (staged_bundle(folder, cut) / "frame.png").symlink_to(elsewhere / "absent")
    for _ in range(3):
        store.begin_attempt(cut)
    stray, linked, hollow = uuid4(), running(store, JobState.COMPUTING), running(store, JobState.COMPUTING)
    write_record(elsewhere, replace(store.get(cut), id=stray))
    folder.scan(stray).symlink_to(elsewhere)
    folder.scan(linked).symlink_to(elsewhere)
    store.finish(linked, JobState.SUCCEEDED)
    folder.scan(hollow).mkdir()
    for name in ("mesh.ply", "report.json"):
        (folder.scan(hollow) / name).symlink_to(elsewhere / name)
    before = sorted(elsewhere.iterdir())
    found = settled(store, folder)
    assert list(folder.incoming.iterdir()) == []
    assert sorted(elsewhere.iterdir()) == before
    assert found == {
        "damaged": {str(linked)}, "put aside": {str(stray)}, "interrupted": {str(cut), str(hollow)},
    }  # fmt: skip
    assert (folder.scan(cut) / "bundle" / "bundle.json").is_file()


def test_what_a_link_leads_to_is_not_ours(folder: DataFolder, elsewhere: Path) -> None:
    scan = folder.scan(uuid4())
    scan.mkdir()
    (scan / "mesh.ply").write_text("ply")
    (scan / "report.json").symlink_to(elsewhere / "report.json")
    (scan / "bundle").symlink_to(elsewhere)
    assert folder.owns(scan / "mesh.ply")
    assert folder.read(scan / "mesh.ply") == b"ply"
    for path in (scan / "report.json", scan / "bundle", scan / "bundle" / "mesh.ply", scan / "absent"):
        assert not folder.owns(path), path
    with pytest.raises(StorageError, match="is a link, or below one"):
        folder.read(scan / "report.json")
    # Scans that lie on another disk are the operator's choice.
    moved = elsewhere / "scans"
    folder.scans.rename(moved)
    folder.scans.symlink_to(moved)
    assert folder.owns(scan / "mesh.ply")


def test_folder_that_is_gone_is_told_as_that(folder: DataFolder) -> None:
    folder.require_present()
    folder.root.rename(folder.root.with_name("away"))
    for ask in (folder.require_present, lambda: folder.require_space(0)):
        with pytest.raises(DataFolderGoneError, match="is gone, or empty"):
            ask()
    folder.root.mkdir()
    with pytest.raises(DataFolderGoneError, match="its disk is not mounted"):
        folder.require_present()


# What an examination found is kept here, too


FINDINGS = (
    fault("light.dark", "camera 'left'", "the light is too dim", "open the iris"),
    ok("device", "rig", "all is there"),
)


def test_examination_is_kept_for_its_rig_and_replaced_by_the_next(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    assert last_examination(tmp_path, "doctor", "bench") is None
    for rig in ("other", "bench"):
        found = Diagnosis(rig, FINDINGS, {}, None, None, None, None, ()).document()
        assert keep(tmp_path, "doctor", found)
    kept = last_examination(tmp_path, "doctor", "bench")
    assert kept is not None
    assert kept.found == found
    assert utc_now() - kept.at < timedelta(minutes=1)
    others = last_examination(tmp_path, "doctor", "other"), last_examination(tmp_path, "conformance", "bench")
    assert others == (None, None)


def test_no_examination_is_kept_where_no_service_keeps_its_data_and_no_other_file_is_taken_for_one(
    tmp_path: Path,
) -> None:
    assert not keep(tmp_path, "doctor", {"rig": "bench"})
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "scans").mkdir()
    for text in ("{}", "[" * 9999, "\x00", '{"rig": "bench"}'):
        (tmp_path / "doctor.json").write_text(text)
        assert last_examination(tmp_path, "doctor", "bench") is None


def scanned(store: JobStore, folder: DataFolder, state: JobState = JobState.SUCCEEDED) -> UUID:
    scan = store.create(plan_json(ScanPlan()), kind=JobKind.SCAN, rig="bench", label=None).id
    if state.final:
        store.finish(scan, state)
    elif state is not JobState.QUEUED:
        store.advance(scan, state)
    if state is JobState.SUCCEEDED:
        (folder.scan(scan) / "bundle").mkdir(parents=True)
        for name in ("mesh.ply", "report.json", "bundle/bundle.json"):
            (folder.scan(scan) / name).write_text(f'{{"{name} of": "{scan}"}}')
    return scan


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@contextmanager
def restored(tmp_path: Path) -> Iterator[tuple[DataFolder, JobStore]]:
    """The data folder of a restored backup, and its records, as a service opens them."""
    restore(tmp_path / "backup", tmp_path / "elsewhere")
    folder = DataFolder(tmp_path / "elsewhere")
    records = JobStore(Database(folder.database))
    yield folder, records
    records.database.close()
    folder.release()


def while_copying(monkeypatch: pytest.MonkeyPatch, name: str, happens: Callable[[], object]) -> None:
    """Have something happen once, just before a file of this name is copied."""
    copied = backup._copied
    waiting = [happens]

    def first(source: Path, to: Path) -> FileEntry:
        if source.name == name and waiting:
            waiting.pop()()
        return copied(source, to)

    monkeypatch.setattr(backup, "_copied", first)


def test_what_ended_comes_back_and_what_did_not_is_settled_as_cut_off(
    tmp_path: Path, store: JobStore, folder: DataFolder
) -> None:
    ended = {scanned(store, folder) for _ in range(2)}
    failed = scanned(store, folder, JobState.FAILED)
    open_ = {scanned(store, folder, state) for state in (JobState.QUEUED, JobState.CAPTURING, JobState.COMPUTING)}
    (folder.root / "key.sha256").write_text("0123")
    (folder.calibrations / "active.json").write_text("{}")
    (folder.calibrations / "c1" / "poses").mkdir(parents=True)
    manifest = back_up(folder.root, tmp_path / "backup")
    assert (manifest.scans, manifest.left_out) == (2, ())
    with restored(tmp_path) as (other, records):
        for scan in ended:
            assert contents(other.scan(scan)) == contents(folder.scan(scan))
        assert (other.root / "key.sha256").read_text() == "0123"
        assert (other.calibrations / "c1" / "poses").is_dir()
        # None of them begins by itself on the rig of whoever restores.
        assert settled(records, other) == {"interrupted": set(map(str, open_))}
        assert records.states() == {
            **dict.fromkeys(ended, JobState.SUCCEEDED),
            failed: JobState.FAILED,
            **dict.fromkeys(open_, JobState.INTERRUPTED),
        }


def test_nobody_else_may_read_it_and_nothing_of_the_running_service_is_in_it(
    tmp_path: Path, store: JobStore, folder: DataFolder
) -> None:
    scanned(store, folder)
    for name in (ADDRESS_FILE, ".key.sha256.0123.part"):
        (folder.root / name).write_text("of this run")
    (folder.incoming / "half").mkdir()
    (folder.root / "cache").mkdir()
    (folder.root / "link").symlink_to("/etc")
    manifest = back_up(folder.root, tmp_path / "backup")
    assert manifest.left_out == ("link: is neither a file nor a folder",)
    restore(tmp_path / "backup", tmp_path / "elsewhere")
    for root in (tmp_path / "backup", tmp_path / "elsewhere"):
        for path in (root, *root.rglob("*")):
            assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path
    assert {path.name for path in (tmp_path / "elsewhere").iterdir()} == {"slrig.sqlite", "scans", "calibrations"}


def test_a_scan_that_is_removed_meanwhile_is_left_out_and_said(
    tmp_path: Path, store: JobStore, folder: DataFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone, stays = scanned(store, folder), scanned(store, folder)
    while_copying(monkeypatch, "bundle.json", lambda: folder.withdraw(folder.scan(gone), gone))
    manifest = back_up(folder.root, tmp_path / "backup")
    assert manifest.left_out == (f"scans/{gone}: was removed meanwhile",)
    assert not any(str(gone) in name for name in (*manifest.files, *manifest.folders))
    with restored(tmp_path) as (_, records):
        assert records.states() == {stays: JobState.SUCCEEDED}


def test_calibrations_are_copied_again_where_one_is_removed_meanwhile(
    tmp_path: Path, store: JobStore, folder: DataFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    scanned(store, folder)
    old, new = folder.calibrations / "1-old", folder.calibrations / "2-new"
    for place in (old, new):
        place.mkdir()
        (place / "session.json").write_text(place.name)
    active = folder.calibrations / "active.json"
    active.write_text("1-old")

    def replaced() -> None:
        active.write_text("2-new")
        (old / "session.json").unlink()
        old.rmdir()

    while_copying(monkeypatch, "session.json", replaced)
    manifest = back_up(folder.root, tmp_path / "backup")
    kept = tmp_path / "backup" / "data" / "calibrations"
    assert (kept / "active.json").read_text() == "2-new"
    assert [path.name for path in kept.iterdir() if path.is_dir()] == ["2-new"]
    assert manifest.left_out == ()


def test_records_that_change_meanwhile_are_as_they_were_and_hold_up_nobody(
    tmp_path: Path, store: JobStore, folder: DataFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = scanned(store, folder)
    while_copying(monkeypatch, "mesh.ply", lambda: scanned(store, folder))
    assert back_up(folder.root, tmp_path / "backup").scans == 1
    with restored(tmp_path) as (other, records):
        assert list(records.states()) == [ended]
        assert settled(records, other) == {}


def test_unchanged_files_are_links_to_those_of_an_earlier_backup(
    tmp_path: Path, store: JobStore, folder: DataFolder
) -> None:
    scan = scanned(store, folder)
    (folder.root / "key.sha256").write_text("0123")
    back_up(folder.root, tmp_path / "first")
    (folder.root / "key.sha256").write_text("4567")
    os.utime(folder.root / "key.sha256", ns=(1, 1))
    back_up(folder.root, tmp_path / "backup", previous=tmp_path / "first")
    first, second = tmp_path / "first" / "data", tmp_path / "backup" / "data"
    assert (second / "scans" / str(scan) / "mesh.ply").samefile(first / "scans" / str(scan) / "mesh.ply")
    assert (second / "key.sha256").read_text() == "4567"
    assert read_manifest(tmp_path / "backup").files.keys() == read_manifest(tmp_path / "first").files.keys()
    restore(tmp_path / "backup", tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere" / "key.sha256").samefile(second / "key.sha256")


def test_a_changed_or_missing_file_is_named_and_nothing_is_restored(
    tmp_path: Path, store: JobStore, folder: DataFolder
) -> None:
    scan = scanned(store, folder)
    back_up(folder.root, tmp_path / "backup")
    mesh = tmp_path / "backup" / "data" / "scans" / str(scan) / "mesh.ply"
    data = bytearray(mesh.read_bytes())
    data[3] ^= 1
    mesh.write_bytes(data)
    with pytest.raises(StorageError, match=r"mesh\.ply was changed \(SHA-256 .*Nothing was restored"):
        restore(tmp_path / "backup", tmp_path / "elsewhere")
    mesh.unlink()
    with pytest.raises(StorageError, match=r"mesh\.ply is missing"):
        restore(tmp_path / "backup", tmp_path / "elsewhere")
    mesh.symlink_to(folder.scan(scan) / "mesh.ply")
    with pytest.raises(StorageError, match=r"mesh\.ply is missing"):
        restore(tmp_path / "backup", tmp_path / "elsewhere")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["backup", "data"]


def test_nothing_that_is_there_is_overwritten(tmp_path: Path, store: JobStore, folder: DataFolder) -> None:
    scanned(store, folder)
    back_up(folder.root, tmp_path / "backup")
    with pytest.raises(StorageError, match="exists already: name a new folder"):
        back_up(folder.root, tmp_path / "backup")
    with pytest.raises(StorageError, match="lies in the data folder itself"):
        back_up(folder.root, folder.root / "backup")
    with pytest.raises(StorageError, match=r"or a service uses it.*stop the service"):
        restore(tmp_path / "backup", folder.root)
    (tmp_path / "empty").mkdir()
    restore(tmp_path / "backup", tmp_path / "empty")
    assert (tmp_path / "empty" / "slrig.sqlite").is_file()


def test_what_is_no_data_folder_and_what_is_no_backup_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="not a data folder of slrig"):
        back_up(tmp_path, tmp_path / "backup")
    with pytest.raises(StorageError, match="not a complete backup"):
        restore(tmp_path, tmp_path / "elsewhere")


@pytest.mark.parametrize("name", ["../../etc/cron.d/x", "/etc/x", "..", "scans/../../x"])
def test_a_manifest_cannot_reach_out_of_the_data_folder(
    tmp_path: Path, store: JobStore, folder: DataFolder, name: str
) -> None:
    scanned(store, folder)
    back_up(folder.root, tmp_path / "backup")
    manifest = tmp_path / "backup" / "backup.json"
    manifest.write_text(manifest.read_text().replace('"slrig.sqlite"', f'"{name}"'))
    with pytest.raises(StorageError, match="outside a data folder"):
        restore(tmp_path / "backup", tmp_path / "elsewhere")


@pytest.mark.parametrize(
    ("refusal", "words"),
    [
        (errno.ENOSPC, r"No space left on device.*free some space"),
        (errno.EACCES, r"mesh\.ply may not be read. Run this as the user"),
    ],
)
def test_a_disk_that_refuses_leaves_no_half_backup(
    tmp_path: Path,
    store: JobStore,
    folder: DataFolder,
    monkeypatch: pytest.MonkeyPatch,
    refusal: int,
    words: str,
) -> None:
    scanned(store, folder)

    def refused() -> None:
        raise OSError(refusal, os.strerror(refusal), str(folder.scans / "mesh.ply"))

    while_copying(monkeypatch, "mesh.ply", refused)
    with pytest.raises(StorageError, match=words):
        back_up(folder.root, tmp_path / "backup")
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


@pytest.mark.skipif(os.name == "nt", reason="of POSIX modes")
def test_a_folder_in_use_is_not_touched_by_who_is_refused(tmp_path: Path) -> None:
    held = DataFolder(tmp_path / "data")
    (tmp_path / "data").chmod(0o700)
    with pytest.raises(StorageError, match="in use by"):
        DataFolder(tmp_path / "data", group="no such group")
    assert (tmp_path / "data").stat().st_mode & 0o7777 == 0o700
    held.release()
