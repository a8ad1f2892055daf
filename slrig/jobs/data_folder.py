"""The data folder: its layout, how scans get there in one rename, and who may use it.

DATA/lock            locked by the one process that owns the folder, as long as it runs; empty
DATA/holder          that process's id, and that of the last one where none runs
DATA/slrig.sqlite    the records
DATA/scans/ID/       a finished scan: bundle/, mesh.ply, report.json ..., and files.json with the digests of all;
                     label.json where it was renamed
DATA/calibrations/   calibrations and their sessions: see `slrig.calibrate.store`
DATA/acceptance/     acceptance tests: see `slrig.accept.store`
DATA/models/         models of several scans: see `slrig.model_jobs.job`
DATA/hand_eye/       position of the rig on a robot: see `slrig.calibrate.hand_eye`
DATA/presets/NAME.json  stored presets: see `slrig.scan.plan`
DATA/webhook.json    the webhook set by a request: see `slrig.schedule.notices`
DATA/clock.json      the time that ages are reckoned by: see `slrig.jobs.retention`
DATA/doctor.json     latest findings of `slrig doctor`, and conform.json: see `slrig.doctor.job`
DATA/.incoming/ID/   a scan, a pose, a solve or a model being made; swept at the next start
DATA/.orphans/ID/    files found at start that no record knows, a damaged database; kept: they may be of value
DATA/.trash/         files removed by the limits of the settings, for a day: see `slrig.jobs.retention`
DATA/cache/          compiled kernels, where the package's own folder cannot be written
"""

from __future__ import annotations

import hashlib
import os
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID, uuid4

import structlog
from filelock import FileLock, Timeout
from pydantic import TypeAdapter, ValidationError

from slrig.bundle import sync_folder, sync_tree, write_file
from slrig.errors import DamagedError, DataFolderGoneError, StorageError
from slrig.failure import disk_errors
from slrig.jobs.records import LABEL, read_record, write_label

DATABASE, SCANS, ORPHANS, BUNDLE = "slrig.sqlite", "scans", ".orphans", "bundle"

RESULT = "result"
"""Below the folder of a job: files that can be fetched before it is over."""

FILES = "files.json"
"""In the folder of a finished job: size and digest of each of its files, as they were committed."""

MADE = "made.json"
"""In the folder of a finished job: size and digest of each file that was made on request since."""

_HOLDER = "holder"

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class FileEntry:
    """A file: its SHA-256 and its length."""

    sha256: str
    size_bytes: int


_entries_adapter = TypeAdapter(dict[str, FileEntry])


def write_entries(folder: Path) -> None:
    """Write `FILES`: the digests of all files of a folder. Raises StorageError."""
    found = {}
    for path in sorted(folder.rglob("*")):
        # A label may change: it is not part of what was committed.
        if path.is_file() and not path.is_symlink() and path not in {folder / FILES, folder / LABEL}:
            found[path.relative_to(folder).as_posix()] = file_entry(path)
    write_file(folder / FILES, _entries_adapter.dump_json(found))


def file_entry(path: Path) -> FileEntry:
    """Digest and length of a file. Raises OSError."""
    with path.open("rb") as file:
        return FileEntry(hashlib.file_digest(file, "sha256").hexdigest(), os.fstat(file.fileno()).st_size)


def _read_made(place: Path) -> dict[str, FileEntry]:
    try:
        return _entries_adapter.validate_json((place / MADE).read_bytes())
    except (ValidationError, OSError):
        return {}


def read_entries(folder: Path) -> Mapping[str, FileEntry]:
    """The entries of `FILES` in a folder: none where an earlier version of slrig finished the job; where it is gone or
    cannot be read, an impossible entry of itself, so that no damage keeps a service from its start.
    """
    try:
        return _entries_adapter.validate_json((folder / FILES).read_bytes())
    except FileNotFoundError:
        kept = read_record(folder)
        return {} if kept is None or not kept.has_files_json else {FILES: FileEntry("", -1)}
    except (ValidationError, OSError):
        return {FILES: FileEntry("", -1)}


def damaged_files(folder: Path, *, digests: bool, names: Iterable[str] | None = None) -> dict[str, str]:
    """Faults of the files of a finished job, by their names: gone, of another length, changed. Files that `FILES` does
    not name were made later, and are not checked; without `FILES` nothing is.

    digests : compare contents, too, which reads the files. names : those to check; None for all.
    """
    entries = read_entries(folder)
    if FILES in entries:
        return {FILES: "cannot be read" if (folder / FILES).exists() else "is gone"}
    found = {}
    for name in entries if names is None else entries.keys() & set(names):
        path, entry = folder / name, entries[name]
        try:
            size_bytes = path.lstat().st_size if not path.is_symlink() else -1
            if size_bytes != entry.size_bytes:
                found[name] = f"has {size_bytes} bytes of {entry.size_bytes}" if size_bytes >= 0 else "is a link"
            elif digests and file_entry(path) != entry:
                found[name] = "was changed"
        except OSError as error:
            found[name] = "is gone" if isinstance(error, FileNotFoundError) else f"cannot be read: {error.strerror}"
    return found


def check_files(root: Path) -> Iterator[tuple[str, str | None]]:
    """Compare every file of the finished jobs of a data folder with its committed digest, while a service runs or not:
    path in the folder and fault, None if it is whole.
    """
    for entries in sorted(root.rglob(FILES)):
        place = entries.parent.relative_to(root)
        if not place.parts or place.parts[0].startswith("."):
            continue
        names = read_entries(entries.parent)
        found = damaged_files(entries.parent, digests=True)
        if found and not entries.exists():
            # The job was deleted meanwhile.
            continue
        for name in sorted({*names, *found}):
            yield (place / name).as_posix(), found.get(name)


def require_whole(place: Path, *names: str, remedy: str) -> None:
    """Raise DamagedError unless files of a finished job are as they were committed; without names, all of them."""
    if found := damaged_files(place, digests=True, names=names or None):
        raise damage(f"Files of {place.name} are damaged", found, remedy)


def damage(what: str, found: Mapping[str, str], remedy: str) -> DamagedError:
    """The error of files that are not as they were written. what : their owner, for the message."""
    named = [f"{name} {cause}" for name, cause in sorted(found.items())]
    more = f" and {len(named) - 3} more" if len(named) > 3 else ""
    return DamagedError(f"{what}: {'; '.join(named[:3])}{more}. Check the disk. {remedy}")


def free_bytes(folder: Path) -> int:
    """Bytes that may still be written below `folder`."""
    return shutil.disk_usage(folder).free


class DataFolder:
    """The data folder, held by this process from construction until `release`, and closed to other users of the
    machine except those of `group`, who may read it.

    Raises
    ------
    StorageError
        Another process holds it, or it cannot be made.
    """

    def __init__(self, root: Path, *, free: Callable[[Path], int] = free_bytes, group: str | None = None) -> None:
        self.root = root.resolve()
        self._free = free
        self._whole: dict[Path, tuple[int, int, int]] = {}
        self._noting = threading.Lock()
        # Files that are moved to their place get no new label meanwhile.
        self.naming = threading.Lock()
        with disk_errors(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            # Any thread may end the service and release it; a kernel that cannot lock is refused, without a fallback.
            self._lock = FileLock(self.root / "lock", mode=0o600, thread_local=False, fallback_to_soft=False)
            try:
                self._lock.acquire(blocking=False)
            except Timeout as error:
                message = (
                    f"The data folder {self.root} is in use by the slrig service with process id {self._holder()}. "
                    "Stop that service, or give this one another folder with --data."
                )
                raise StorageError(message) from error
            try:
                # A file of its own: Windows allows no other process to read a locked file.
                (self.root / _HOLDER).write_text(f"{os.getpid()}\n", encoding="ascii")
                # Permissions change only once the lock is held.
                self._close_to_others(group)
                for folder in (self.scans, self.calibrations, self.incoming):
                    folder.mkdir(exist_ok=True)
            except BaseException:
                self._lock.release()
                raise

    def _close_to_others(self, group: str | None) -> None:
        if os.name == "nt":
            return
        try:
            if group is not None:
                shutil.chown(self.root, group=group)
            # What is made below belongs to the group of its folder (set-group-ID).
            self.root.chmod(0o700 if group is None else 0o2750)
        except LookupError as error:
            message = f"There is no group '{group}' on this machine. Make it, or name another with data_group."
            raise StorageError(message) from error
        except PermissionError as error:
            if group is not None:
                message = (
                    f"The data folder {self.root} cannot be given to the group '{group}': {error.strerror}. Make the "
                    "user of the service owner of the folder and member of the group, or leave data_group out."
                )
                raise StorageError(message) from error
            # A file system without users, or a folder of another user.
            _log.warning("other users of this machine may be able to read the data folder", folder=str(self.root))

    def _holder(self) -> str:
        """The process id of who holds the folder."""
        try:
            return (self.root / _HOLDER).read_text(encoding="ascii", errors="replace").strip() or "unknown"
        except OSError:
            return "unknown"

    @property
    def scans(self) -> Path:
        """Folder of finished scans."""
        return self.root / SCANS

    @property
    def calibrations(self) -> Path:
        """Folder of calibrations."""
        return self.root / "calibrations"

    @property
    def incoming(self) -> Path:
        """Folder in which scans and files of calibrations are made."""
        return self.root / ".incoming"

    @property
    def orphans(self) -> Path:
        """Folder of files without a record."""
        return self.root / ORPHANS

    @property
    def database(self) -> Path:
        """The records."""
        return self.root / DATABASE

    def release(self) -> None:
        """Release the folder for other processes. Idempotent."""
        self._lock.release()

    def require_present(self) -> None:
        """Raise DataFolderGoneError unless the folder is there; where its disk is not mounted, an empty one may be."""
        if not (self.scans.is_dir() and self.incoming.is_dir()):
            message = (
                f"The data folder {self.root} is gone, or empty: removed, renamed, or its disk is not mounted. Bring "
                "it back, and start the service again."
            )
            raise DataFolderGoneError(message)

    def owns(self, path: Path) -> bool:
        """Whether a path exists below one of the folders here, and no link leads to it. The folders themselves may be
        links: `scans` to another disk.
        """
        top, *below = path.relative_to(self.root).parts
        return path.exists() and path.resolve() == (self.root / top).resolve().joinpath(*below)

    def read(self, path: Path) -> bytes:
        """Return the bytes of a file below one of the folders here. Raises StorageError, also where a link leads to it;
        FileNotFoundError.
        """
        with disk_errors(path):
            if path.exists() and not self.owns(path):
                message = (
                    f"{path} is a link, or below one, and what that leads to is not ours. Put the file itself there."
                )
                raise StorageError(message)
            return path.read_bytes()

    def require_space(self, needed_bytes: int) -> None:
        """Raise StorageError unless the folder is there, and `needed_bytes` can be written."""
        self.require_present()
        free = self._free(self.root)
        if free < needed_bytes:
            message = (
                f"This may need {needed_bytes / 1e6:.0f} MB in {self.root}, and {free / 1e6:.0f} MB are free. "
                "Delete scans that are no longer wanted (DELETE /scan/ID), empty .trash there, or move the data folder "
                "to a larger disk."
            )
            raise StorageError(message)

    def scan(self, scan_id: UUID) -> Path:
        """Folder of a finished scan."""
        return self.scans / str(scan_id)

    def staging(self, scan_id: UUID) -> Path:
        """Folder in which the files of a running scan are made."""
        return self.incoming / str(scan_id)

    def recording(self, scan_id: UUID) -> Path:
        """Folder in which a running scan's frames are recorded, until `keep_recording`."""
        return self.staging(scan_id) / "recording"

    def keep_recording(self, scan_id: UUID) -> None:
        """Make what was recorded the scan's bundle, durable: where a bundle is staged, it is whole."""
        staged = self.staging(scan_id)
        with disk_errors(staged):
            sync_tree(self.recording(scan_id))
            self.recording(scan_id).rename(staged / BUNDLE)
            sync_folder(staged)

    def result(self, scan_id: UUID) -> Path:
        """Folder of the finished files of a scan that is being reconstructed."""
        return self.staging(scan_id) / RESULT

    def places(self, scan_id: UUID) -> tuple[Path, Path, Path]:
        """Folders where a file of a scan that is being reconstructed may lie. `put` moves it from one to the next:
        a search in this order finds it.
        """
        return self.result(scan_id), self.staging(scan_id), self.scan(scan_id)

    def hidden(self, scan_id: UUID) -> str:
        """Path prefix to remove from messages that outlast the staging folder."""
        return f"{self.staging(scan_id)}/"

    def stage(self, scan_id: UUID) -> Path:
        """Make the staging folder of a scan, empty."""
        folder = self.staging(scan_id)
        with disk_errors(folder):
            folder.mkdir()
        return folder

    def stage_bundle(self, job_id: UUID, place: Path) -> None:
        """Stage a finished job again, with its bundle: links to the same files, which never change."""
        staged = self.stage(job_id)
        with disk_errors(staged):
            shutil.copytree(place / BUNDLE, staged / BUNDLE, copy_function=os.link)
            sync_tree(staged)

    def put(self, job_id: UUID, place: Path) -> None:
        """Move what is staged for a job to its place, by one rename, durable: all but a bundle, which is so already.

        Files that could be fetched before are next to the bundle then. Files there of an attempt that was interrupted
        before its end was on record are removed.
        """
        staged = self.staging(job_id)
        with self.naming, disk_errors(staged):
            result = self.result(job_id)
            if result.is_dir():
                for file in sorted(result.iterdir()):
                    file.rename(staged / file.name)
                result.rmdir()
            write_entries(staged)
            sync_tree(staged, except_folder=BUNDLE)
            self.remove(place)
            staged.rename(place)
            sync_folder(place.parent)
            sync_folder(self.incoming)

    def require_whole(self, place: Path, *names: str) -> None:
        """Raise DamagedError unless files of a finished job are as they were committed. Each is read once, until it
        changes.
        """
        stamps = {}
        for name in names:
            with suppress(OSError):
                stamps[place / name] = _stamp_of(place / name)
        unknown = [each for each in names if self._whole.get(place / each) != stamps.get(place / each, ())]
        if unknown:
            require_whole(place, *unknown, remedy="They are not given out.")
        self._whole.update(stamps)

    def note_made(self, place: Path, name: str) -> None:
        """Keep the digest of a file that was made on request in the folder of a finished job. Raises StorageError."""
        with self._noting, disk_errors(place):
            made = {**_read_made(place), name: file_entry(place / name)}
            write_file(place / MADE, _entries_adapter.dump_json(made))

    def relabel(self, job_id: UUID, place: Path | None, label: str | None) -> None:
        """Keep the new label of a job with its files, where they are or where they are made. Hold `naming` meanwhile.

        Raises StorageError.
        """
        # In the order in which `put` moves them.
        for folder in (self.staging(job_id), place):
            if folder is not None and folder.is_dir():
                try:
                    write_label(folder, label)
                except StorageError:
                    if folder.is_dir():
                        raise

    def has_made(self, place: Path, name: str) -> bool:
        """Whether a file that was made on request is there, as it was made; read once, until it changes."""
        entry, path = _read_made(place).get(name), place / name
        if entry is None or path.is_symlink():
            return False
        with suppress(OSError):
            stamp = _stamp_of(path)
            if self._whole.get(path) == stamp or file_entry(path) == entry:
                self._whole[path] = stamp
                return True
        _log.warning("a file that was made on request is damaged, and made again", file=str(path))
        return False

    def remove(self, place: Path, trash: Path | None = None) -> None:
        """Remove files by one rename out of their place first, or move them to `trash`. Idempotent.

        Raises StorageError.
        """
        if not os.path.lexists(place):
            return
        self._forget(place)
        gone = trash or self.incoming / f"gone-{uuid4().hex}"
        with disk_errors(place):
            place.rename(gone)
        if trash is None:
            shutil.rmtree(gone, ignore_errors=True)

    def put_aside(self, place: Path) -> None:
        """Move files that no record knows to `orphans`, next to earlier ones. Raises StorageError."""
        above = place.parent.relative_to(self.root).parts
        name = place.name if above == (SCANS,) else "-".join([*above, place.name])
        with disk_errors(place):
            self.orphans.mkdir(exist_ok=True)
            if os.path.lexists(self.orphans / name):
                name = f"{name}-{uuid4().hex[:8]}"
            place.rename(self.orphans / name)

    def keep_bundle(self, job_id: UUID, place: Path) -> None:
        """Put the bundle of a job that came to nothing in its place, whole or cut short, and nothing else of it. Does
        nothing where none was recorded.
        """
        if self.recording(job_id).is_dir():
            self.keep_recording(job_id)
        if not (self.staging(job_id) / BUNDLE).is_dir() or self.owns(place / BUNDLE):
            # Nothing was recorded; or it was computed once more, and is there.
            return
        self.clear_results(job_id)
        self.put(job_id, place)

    def clear_results(self, scan_id: UUID) -> Path:
        """Remove all that is staged for a scan but its bundle, and return the staging folder."""
        staged = self.staging(scan_id)
        for other in staged.iterdir():
            if other.name != BUNDLE:
                remove(other)
        return staged

    def discard(self, scan_id: UUID, trash: Path | None = None) -> None:
        """Remove what was staged for a scan, or move it to `trash`, which may raise StorageError. Idempotent."""
        if trash is not None:
            self.remove(self.staging(scan_id), trash)
        shutil.rmtree(self.staging(scan_id), ignore_errors=True)

    def withdraw(self, place: Path, job_id: UUID) -> None:
        """Take the files of a job back into staging by one rename: the first half of a deletion."""
        if os.path.lexists(place):
            self._forget(place)
            with disk_errors(place):
                place.rename(self.staging(job_id))

    def _forget(self, place: Path) -> None:
        """Forget which files in a folder that goes were found whole."""
        self._whole = {path: stamp for path, stamp in self._whole.items() if not path.is_relative_to(place)}


def _stamp_of(path: Path) -> tuple[int, int, int]:
    """A value that differs once a file was changed or replaced. Raises OSError."""
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns


def missing_files(place: Path, promised: Iterable[str]) -> list[str]:
    """The promised files that are not in a folder. Links do not count as files or folders of ours."""
    is_ours = not place.is_symlink()
    return [name for name in promised if not (is_ours and (place / name).is_file() and not (place / name).is_symlink())]


def require_files(place: Path, promised: Iterable[str], noun: str) -> None:
    """Raise StorageError where promised files of a job that was computed are not in a folder."""
    if missing := missing_files(place, promised):
        gone = " and ".join(missing)
        message = f"The {noun} was computed, and {gone} is not on the disk. Check the disk, and start it again."
        raise StorageError(message)


def remove(path: Path) -> None:
    """Remove a file, a folder with all that is in it, or a link and not what it leads to. Raises OSError."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
