"""Backup of a data folder, also while a service uses it, and restore.

TO/backup.json   what was copied and what was left out: `Manifest`; written last
TO/data/         the files, as they lie in the data folder

The records come first, as SQLite copies them; then the files. A service makes files durable before it records them, so
files may be newer than the records: as after a power cut, which the next start of a service settles.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Literal

from pydantic import TypeAdapter, ValidationError

from slrig.bundle import sync_folder, sync_tree
from slrig.disk import staging_name, storage_errors
from slrig.errors import StorageError
from slrig.jobs.data_folder import DATABASE, ORPHANS, SCANS, FileEntry, file_entry, read_entries
from slrig.jobs.database import PATIENCE_S
from slrig.jobs.records import JobKind, JobState, utc_now

MANIFEST, DATA = "backup.json", "data"

OF_ONE_RUN = frozenset({"lock", "holder", "service.json", "cache", "keys.lock", "first-key"})
"""Files that only the process that holds a data folder, or only this machine, can use; and the unread first key."""

_CHUNK_BYTES = 2**20
_MOST_TRIES = 5


@dataclass(frozen=True, slots=True)
class Manifest:
    """Contents of a backup. files, folders : by their paths in the data folder, with slashes.

    left_out : what was in the data folder as the backup began and is not in it, each with the reason. scans : how many
    scans have files in it.
    """

    format: Literal["slrig-backup"]
    version: Literal[1]
    made_at: datetime
    scans: int
    files: Mapping[str, FileEntry]
    folders: tuple[str, ...]
    left_out: tuple[str, ...]

    @property
    def size_bytes(self) -> int:
        """Total size of its files."""
        return sum(entry.size_bytes for entry in self.files.values())


_manifest_adapter = TypeAdapter(Manifest)


def back_up(root: Path, to: Path, *, previous: Path | None = None) -> Manifest:
    """Copy the data folder `root` into the new folder `to`, whole or not at all; a service may be running on it.

    previous : an earlier backup on the same disk; files that have not changed since are hard links to its files.

    Raises
    ------
    StorageError
        `root` is not a data folder, `to` exists, `previous` is not a backup, or the disk refused.
    """
    root, to = root.resolve(), to.resolve()
    with _refusals(root):
        if not (root / DATABASE).is_file():
            message = f"{root} holds no {DATABASE}: it is not a data folder of slrig. Name the folder of slrig serve."
            raise StorageError(message)
        if to.is_relative_to(root) or to.exists():
            why = "exists already" if to.exists() else "lies in the data folder itself"
            message = f"{to} {why}: name a new folder elsewhere, best on another disk; a backup is never changed."
            raise StorageError(message)
        earlier = None if previous is None else _Earlier(previous / DATA, read_manifest(previous).files)
        with _new_folder(to) as staged:
            data = staged / DATA
            data.mkdir(mode=0o700)
            scans = _copy_records(root / DATABASE, data / DATABASE)
            copy = _BackupCopy(root, data, earlier)
            copy.everything(scans)
            _forget(data / DATABASE, copy.gone)
            copy.files[DATABASE] = file_entry(data / DATABASE)
            count = sum(name.startswith(f"{SCANS}/") and name.count("/") == 1 for name in copy.folders)
            manifest = Manifest(
                "slrig-backup", 1, utc_now(), count, copy.files, tuple(copy.folders), tuple(copy.left_out)
            )
            with _created(staged / MANIFEST) as file:
                file.write(_manifest_adapter.dump_json(manifest, indent=1))
    return manifest


def restore(backup: Path, root: Path) -> Manifest:
    """Make the data folder `root` of a backup, after every byte of that was found as it was written.

    Raises
    ------
    StorageError
        `backup` is none, or a file in it is missing or changed; `root` holds something; or the disk refused.
    """
    root = root.resolve()
    with _refusals(backup):
        if root.exists() and (not root.is_dir() or any(root.iterdir())):
            message = (
                f"{root} holds something already, or a service uses it: a backup is restored into a folder that is new "
                "or empty. Name another; or stop the service, move that folder away, and restore again."
            )
            raise StorageError(message)
        manifest = read_manifest(backup)
        with _new_folder(root) as staged:
            for name in manifest.folders:
                (staged / name).mkdir(mode=0o700)
            for name, entry in manifest.files.items():
                source = backup / DATA / name
                found = "is missing"
                if source.is_file() and not source.is_symlink():
                    copied = _copied(source, staged / name)
                    found = (
                        ""
                        if copied == entry
                        else f"was changed (SHA-256 {copied.sha256[:12]}…, not {entry.sha256[:12]}…)"
                    )
                if found:
                    message = f"{source} {found}. Nothing was restored: take another backup."
                    raise StorageError(message)
    return manifest


def read_manifest(backup: Path) -> Manifest:
    """The manifest of a backup. Raises StorageError, also where the folder is not a backup."""
    path = backup / MANIFEST
    try:
        manifest = _manifest_adapter.validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        message = f"{path} cannot be read: {backup} is not a complete backup. Name a folder that slrig backup made."
        raise StorageError(message) from error
    for name in (*manifest.files, *manifest.folders):
        parts = PurePosixPath(name).parts
        if not parts or name.startswith("/") or ".." in parts or "\\" in name:
            message = f"{path} names '{name}', which lies outside a data folder: it was not made by slrig backup."
            raise StorageError(message)
    return manifest


@dataclass(frozen=True, slots=True)
class _Earlier:
    """The files of an earlier backup."""

    data: Path
    files: Mapping[str, FileEntry]

    def linked(self, source: Path, name: str, to: Path) -> FileEntry | None:
        """Link `to` to the same file there, if that has the size and time of `source`; None if not."""
        entry, kept = self.files.get(name), self.data / name
        if entry is None or not kept.is_file():
            return None
        then, now = kept.stat(), source.stat()
        if (then.st_size, then.st_mtime_ns) != (now.st_size, now.st_mtime_ns):
            return None
        os.link(kept, to)
        return entry


class _GoneError(Exception):
    """A folder was removed while it was being copied."""


class _BackupCopy:
    """Copies folders of files that a service goes on using. files, folders : what was copied, by path below the root.

    left_out : what was not, with the reason. gone : the paths of folders that were removed meanwhile.
    """

    def __init__(self, root: Path, to: Path, earlier: _Earlier | None) -> None:
        self.files: dict[str, FileEntry] = {}
        self.folders: list[str] = []
        self.left_out: list[str] = []
        self.gone: list[str] = []
        self._root = root
        self._to = to
        self._earlier = earlier

    def everything(self, scans: Mapping[str, JobState]) -> None:
        """Copy the data folder except its records. Of scans, only those that had ended."""
        self._contents("", leave=OF_ONE_RUN | {SCANS})
        self._make(SCANS)
        for scan, state in scans.items():
            # One that did not succeed need not have files.
            if state is JobState.SUCCEEDED or (self._root / SCANS / scan).is_dir():
                self._whole(f"{SCANS}/{scan}")

    def _contents(self, below: str, *, leave: frozenset[str] = frozenset()) -> None:
        """Copy what lies in a folder. Raises _GoneError."""
        source = self._root / below
        try:
            before = source.stat()
            with os.scandir(source) as found:
                # Files first: what points at a folder is then no newer than that folder.
                entries = sorted(found, key=lambda each: (each.is_dir(follow_symlinks=False), each.name))
            for entry in entries:
                name = f"{below}{entry.name}"
                # Hidden is what is being made.
                hidden = entry.name.startswith(".") and name != ORPHANS
                if hidden or entry.name in leave or name.startswith(DATABASE):
                    continue
                if entry.is_dir(follow_symlinks=False):
                    self._whole(name) if below else self._unbroken(name)
                elif entry.is_file(follow_symlinks=False):
                    self._file(name)
                else:
                    self.left_out.append(f"{name}: is neither a file nor a folder")
            after = source.stat()
        except FileNotFoundError as error:
            raise _GoneError from error
        if (before.st_dev, before.st_ino) != (after.st_dev, after.st_ino):
            raise _GoneError

    def _unbroken(self, name: str) -> None:
        """Copy a folder, and again where a part of it was removed meanwhile: another part may have named that one."""
        for _ in range(_MOST_TRIES):
            self._whole(name)
            if not any(gone.startswith(f"{name}/") for gone in self.gone):
                return
            self._drop(name)
        self._whole(name)

    def _whole(self, name: str) -> None:
        """Copy a folder, or nothing of it if it is removed meanwhile."""
        self._make(name)
        try:
            self._contents(f"{name}/")
            self._leave_damaged(name)
        except _GoneError:
            self._drop(name)
            self.gone.append(name)
            self.left_out.append(f"{name}: was removed meanwhile")

    def _leave_damaged(self, name: str) -> None:
        """Leave out files of a finished job that are not as they were committed."""
        entries = read_entries(self._to / name)
        for file, entry in entries.items():
            copied = self.files.get(f"{name}/{file}")
            if copied != entry:
                self.left_out.append(f"{name}/{file}: is damaged")
                if copied is not None:
                    del self.files[f"{name}/{file}"]
                    (self._to / name / file).unlink()

    def _make(self, name: str) -> None:
        (self._to / name).mkdir(mode=0o700)
        self.folders.append(name)

    def _drop(self, name: str) -> None:
        """Forget the copy of a folder."""
        shutil.rmtree(self._to / name)
        below = f"{name}/"
        self.files = {each: entry for each, entry in self.files.items() if not each.startswith(below)}
        for names in (self.folders, self.left_out, self.gone):
            names[:] = [each for each in names if each != name and not each.startswith(below)]

    def _file(self, name: str) -> None:
        source, to = self._root / name, self._to / name
        try:
            linked = None if self._earlier is None else self._earlier.linked(source, name, to)
            self.files[name] = linked or _copied(source, to)
        except FileNotFoundError:
            # With its folder, as will show; or by itself, as what names the calibration in use when none is any more.
            self.left_out.append(f"{name}: was removed meanwhile")


def _copied(source: Path, to: Path) -> FileEntry:
    """Copy a file with its time of change, following no link. Raises OSError."""
    digest, size_bytes = hashlib.sha256(), 0
    with open(source, "rb", opener=_unfollowed) as file, _created(to) as copy:
        status = os.fstat(file.fileno())
        while chunk := file.read(_CHUNK_BYTES):
            copy.write(chunk)
            digest.update(chunk)
            size_bytes += len(chunk)
    os.utime(to, ns=(status.st_atime_ns, status.st_mtime_ns))
    return FileEntry(digest.hexdigest(), size_bytes)


def _unfollowed(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0))


def _created(path: Path) -> BinaryIO:
    """A new file that only its owner may read."""
    return open(path, "xb", opener=lambda name, flags: os.open(name, flags, 0o600))


def _copy_records(source: Path, to: Path) -> dict[str, JobState]:
    """Copy the database as it is at one instant, and return the state of every scan in it that had ended."""
    to.touch(mode=0o600)
    ended = [state for state in JobState if state.final]
    with (
        _records_errors(source),
        closing(sqlite3.connect(f"{source.as_uri()}?mode=ro", uri=True, timeout=PATIENCE_S)) as records,
        closing(sqlite3.connect(to)) as copy,
    ):
        # In one step: with a write-ahead log it blocks no writer, and steps would start over with every change.
        records.execute("BEGIN")
        records.execute("SELECT count(*) FROM sqlite_schema").fetchone()
        records.backup(copy)
        # A waiting job would start by itself on the rig after a restore. Marked as running, it ends as interrupted.
        copy.execute("UPDATE job SET state = ? WHERE state = ?", (JobState.CAPTURING, JobState.QUEUED))
        copy.commit()
        rows = copy.execute("SELECT id, state FROM job WHERE kind = ? ORDER BY number", (JobKind.SCAN,))
        return {scan: JobState(state) for scan, state in rows if state in ended}


def _forget(records: Path, gone: list[str]) -> None:
    """Take scans out of the copied records that were removed before their files were copied."""
    scans = [(PurePosixPath(name).name,) for name in gone if name.startswith(f"{SCANS}/")]
    with _records_errors(records), closing(sqlite3.connect(records)) as copy:
        copy.execute("PRAGMA foreign_keys = ON")
        copy.executemany("DELETE FROM job WHERE id = ?", scans)
        copy.commit()


@contextmanager
def _records_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except sqlite3.Error as error:
        message = (
            f"The records {path} could not be copied: {error}. Start slrig serve on that folder once, and try again."
        )
        raise StorageError(message) from error


@contextmanager
def _new_folder(to: Path) -> Iterator[Path]:
    """A hidden folder next to `to` that replaces it, durably, when the block succeeds, and is removed if not."""
    staged = staging_name(to)
    staged.mkdir(mode=0o700)
    try:
        yield staged
        sync_tree(staged)
        if to.is_dir():
            # Empty; not every system renames over it.
            to.rmdir()
        staged.rename(to)
        sync_folder(to.parent)
    except BaseException:
        shutil.rmtree(staged, ignore_errors=True)
        raise


@contextmanager
def _refusals(source: Path) -> Iterator[None]:
    """Turn what the disk says into a StorageError: about what is read below `source`, or about what is written."""
    try:
        yield
    except OSError as error:
        path = Path(error.filename or source)
        if isinstance(error, PermissionError) and path.is_relative_to(source):
            message = f"{path} may not be read. Run this as the user that the service runs as: sudo -u slrig slrig …"
            raise StorageError(message) from error
        with storage_errors(path):
            raise
