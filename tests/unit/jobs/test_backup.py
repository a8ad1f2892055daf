"""A backup holds what had ended, whole; a restore gives that back or nothing."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path
from uuid import UUID

import pytest

from slrig.api.server import ADDRESS_FILE
from slrig.errors import StorageError
from slrig.jobs import backup
from slrig.jobs.backup import back_up, read_manifest, restore
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.records import JobKind, JobState
from slrig.jobs.store import JobStore
from slrig.scan.plan import ScanPlan
from slrig.scan.records import plan_json
from slrig.scan.sweep import sweep


def scanned(store: JobStore, folder: DataFolder, state: JobState = JobState.SUCCEEDED) -> UUID:
    """A scan in this state, with files in its place if it has succeeded."""
    scan = store.create(plan_json(ScanPlan()), rig="bench", label=None).id
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


def restored(tmp_path: Path, root: Path) -> tuple[DataFolder, JobStore]:
    """The data folder of a restored backup, and its records, as a service opens them."""
    restore(tmp_path / "backup", root)
    folder = DataFolder(root)
    return folder, JobStore(Database(folder.database), JobKind.SCAN)


def while_copying(monkeypatch: pytest.MonkeyPatch, name: str, happens: Callable[[], object]) -> None:
    """Have something happen once, just before a file of this name is copied."""
    copied = backup._copied
    waiting = [happens]

    def first(source: Path, to: Path) -> backup.FileEntry:
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
    other, records = restored(tmp_path, tmp_path / "elsewhere")
    try:
        for scan in ended:
            assert contents(other.scan(scan)) == contents(folder.scan(scan))
        assert (other.root / "key.sha256").read_text() == "0123"
        assert (other.calibrations / "c1" / "poses").is_dir()
        # None of them begins by itself on the rig of whoever restores.
        swept = sweep(records, other)
        assert (set(swept.interrupted), swept.resumed, swept.lost, swept.put_aside) == (open_, (), (), ())
        assert records.states() == {
            **dict.fromkeys(ended, JobState.SUCCEEDED),
            failed: JobState.FAILED,
            **dict.fromkeys(open_, JobState.INTERRUPTED),
        }
    finally:
        records.database.close()
        other.release()


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
    while_copying(monkeypatch, "bundle.json", lambda: folder.withdraw(gone))
    manifest = back_up(folder.root, tmp_path / "backup")
    assert manifest.left_out == (f"scans/{gone}: was removed meanwhile",)
    assert not any(str(gone) in name for name in (*manifest.files, *manifest.folders))
    other, records = restored(tmp_path, tmp_path / "elsewhere")
    assert records.states() == {stays: JobState.SUCCEEDED}
    records.database.close()
    other.release()


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
    other, records = restored(tmp_path, tmp_path / "elsewhere")
    assert list(records.states()) == [ended]
    assert sweep(records, other).put_aside == ()
    records.database.close()
    other.release()


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
    with pytest.raises(StorageError, match="no data folder of slrig"):
        back_up(tmp_path, tmp_path / "backup")
    with pytest.raises(StorageError, match="no whole backup"):
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
