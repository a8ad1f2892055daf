"""Where bundles and results lie on their way between a rig and a pool: an S3 store, or a folder that all can reach.

Everything is read back by the hash that the other side told, over the encrypted connection of the pool: what the store
does to a file is noticed. Nothing that a store says is passed on, because it may quote the credentials.
"""

from __future__ import annotations

import hashlib
import os
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from urllib.parse import urlsplit

import obstore
from obstore.exceptions import BaseError
from obstore.store import LocalStore, S3Store

from slrig.config import is_loopback, read_private_text
from slrig.disk import storage_errors
from slrig.errors import ConfigError

if TYPE_CHECKING:
    from obstore.store import ClientConfig, ObjectStore, RetryConfig

CHUNK_BYTES = 5 * 2**20
"""The least part of S3's uploads in parts, but for the last."""

_AT_ONCE = 1
"""Parts under way at a time: more of them would share the line, and none be through in its time."""

_CLIENT: ClientConfig = {"connect_timeout": "3s", "timeout": "20s"}
"""Of one request, which carries one chunk: 2 Mbit/s will do."""

_RETRIES: RetryConfig = {"max_retries": 2, "retry_timeout": timedelta(seconds=15)}

Check = Callable[[], None]
"""Is called before each chunk, and raises what is to end the transfer. It must not use the store: that one is busy."""


class PoolError(Exception):
    """The pool or its store did not do its part; its text says why. The rig computes by itself.
    final : whether another try would end in the same way.
    """

    def __init__(self, message: str, *, final: bool = False) -> None:
        super().__init__(message)
        self.final = final


class PoolStore:
    """`address` is told to people; `objects` is what it stands for."""

    def __init__(self, address: str, objects: ObjectStore) -> None:
        self.address = address
        self._objects = objects

    def put_bundle(self, bundle: Path, check: Check) -> str:
        """Bring a bundle to the store, unless it is there, and return its key: a hash of all of its bytes.

        Raises
        ------
        PoolError
            The store did not take it.
        StorageError
            This machine's disk refused.
        """
        # Beside the bundle, where there is room; it has no name, and is gone however this ends.
        with storage_errors(bundle.parent), tempfile.TemporaryFile(dir=bundle.parent) as packed:
            with tarfile.open(fileobj=packed, mode="w") as archive:
                for path in sorted(bundle.rglob("*")):
                    if path.is_file():
                        check()
                        _add(archive, path, path.relative_to(bundle).as_posix())
            packed.seek(0)
            key = hashlib.file_digest(packed, "sha256").hexdigest()
            with self._faults():
                if not self._has(_bundle(key)):
                    packed.seek(0)
                    self._put(_bundle(key), packed, check)
        return key

    def fetch_bundle(self, key: str, bundle: Path, check: Check) -> None:
        """Unpack the bundle of a key into a new folder. Raises as `put_bundle` does."""
        with storage_errors(bundle.parent), tempfile.TemporaryFile(dir=bundle.parent) as packed:
            self._fetch(_bundle(key), key, packed, check)
            packed.seek(0)
            with tarfile.open(fileobj=packed) as archive:
                archive.extractall(bundle, filter="data")

    def put_result(self, job: str, path: Path, check: Check) -> str:
        """Bring a file of a result to the store; return its hash. Raises as `put_bundle`."""
        with storage_errors(path), path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            file.seek(0)
            with self._faults():
                self._put(_result(job, path.name), file, check)
        return digest

    def fetch_result(self, job: str, hashes: Mapping[str, str], folder: Path, check: Check) -> Iterator[str]:
        """Fetch the files of a result into a folder one after another, each whole or not at all, and yield their names.
        Raises as `put_bundle` does.
        """
        for name, digest in hashes.items():
            if Path(name).name != name or name.startswith("."):
                message = f"the pool names a result '{name}', which is no name of a file"
                raise PoolError(message)
            part = folder / f".{name}.part"
            try:
                with storage_errors(folder):
                    with part.open("wb") as file:
                        self._fetch(_result(job, name), digest, file, check)
                    part.replace(folder / name)
            finally:
                part.unlink(missing_ok=True)
            yield name

    def stop(self, job: str) -> None:
        """Have the machine that computes a job stop. Raises PoolError."""
        with self._faults():
            obstore.put(self._objects, _stop(job), b"stop")

    def stopped(self, job: str) -> bool:
        """Whether a job is to stop. Raises PoolError."""
        with self._faults():
            return self._has(_stop(job))

    def clear(self, *, bundle: str | None = None, job: str | None = None) -> None:
        """Remove a bundle, or what a job left. Raises PoolError."""
        with self._faults():
            if bundle is not None:
                self._delete(_bundle(bundle))
            if job is not None:
                listed = obstore.list(self._objects, prefix=f"results/{job}").collect()
                for path in (*(each["path"] for each in listed), _stop(job)):
                    self._delete(path)

    def _put(self, path: str, file: IO[bytes], check: Check) -> None:
        chunks = _chunks(file, check)
        obstore.put(self._objects, path, chunks, chunk_size=CHUNK_BYTES, max_concurrency=_AT_ONCE)

    def _delete(self, path: str) -> None:
        # A folder tells that there is none; S3 does not.
        with suppress(FileNotFoundError):
            obstore.delete(self._objects, path)

    def _has(self, path: str) -> bool:
        try:
            obstore.head(self._objects, path)
        except FileNotFoundError:
            return False
        return True

    def _fetch(self, path: str, digest: str, file: IO[bytes], check: Check) -> None:
        hashed = hashlib.sha256()
        with self._faults():
            reader = obstore.open_reader(self._objects, path, buffer_size=CHUNK_BYTES)
        while True:
            check()
            with self._faults():
                chunk = bytes(reader.read(CHUNK_BYTES))
            if not chunk:
                break
            hashed.update(chunk)
            file.write(chunk)
        if hashed.hexdigest() != digest:
            message = f"what {self.address} holds as {path} is not what was put there"
            raise PoolError(message)

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except (BaseError, OSError) as error:
            message = f"the store {self.address} failed ({type(error).__name__})"
            raise PoolError(message) from None


def open_store(address: str, login: Path | None = None) -> PoolStore:
    """The store at s3://BUCKET/PREFIX or file:///FOLDER. login : a file with `KEY ID:SECRET`, in place of the variables
    AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; where an S3 store is that is not Amazon's, AWS_ENDPOINT_URL says.

    Raises
    ------
    ConfigError
        The address is none, its folder cannot be made, its credentials are missing, may be read by others, or would
        travel unencrypted.
    """
    parts = urlsplit(address)
    if parts.scheme == "file" and parts.path and not parts.netloc:
        with _unusable(address):
            return PoolStore(address, LocalStore(prefix=parts.path, automatic_cleanup=True, mkdir=True))
    if parts.scheme != "s3" or not parts.hostname or parts.username or parts.query:
        # What was found is not repeated: it may hold a secret.
        message = "The pool's store has no address: expected s3://BUCKET/PREFIX, or file:///FOLDER that all share."
        raise ConfigError(message)
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    server = urlsplit(endpoint or "")
    plain = server.scheme == "http"
    if plain and not is_loopback(server.hostname or ""):
        message = "AWS_ENDPOINT_URL: scans would travel unencrypted. Use https://; http:// is for 127.0.0.1 alone."
        raise ConfigError(message)
    options: dict[str, Any] = {} if endpoint is None else {"endpoint": endpoint, "virtual_hosted_style_request": False}
    if login is not None:
        name, found, secret = read_private_text(login, f"compute_login_file: {login}").strip().partition(":")
        if not found:
            message = f"compute_login_file: {login} does not hold KEY ID:SECRET."
            raise ConfigError(message)
        options |= {"access_key_id": name, "secret_access_key": secret}
    elif not (os.environ.get("AWS_ACCESS_KEY_ID") and os.environ.get("AWS_SECRET_ACCESS_KEY")):
        message = (
            f"{address}: there are no credentials for it. Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or "
            "compute_login_file, a file with KEY ID:SECRET that nobody else may read."
        )
        raise ConfigError(message)
    options["region"] = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1"
    client: ClientConfig = {**_CLIENT, "allow_http": plain}
    prefix = parts.path.strip("/") or None
    with _unusable(address):
        objects = S3Store(parts.netloc, prefix=prefix, client_options=client, retry_config=_RETRIES, **options)
    return PoolStore(address, objects)


@contextmanager
def _unusable(address: str) -> Iterator[None]:
    try:
        yield
    except (BaseError, OSError, ValueError) as error:
        message = (
            f"{address}: the pool's store cannot be opened ({type(error).__name__}). Name a folder that can be made "
            "and written, or a bucket; see to AWS_ENDPOINT_URL and AWS_REGION as well."
        )
        raise ConfigError(message) from None


def _bundle(key: str) -> str:
    return f"bundles/{key}.tar"


def _result(job: str, name: str) -> str:
    return f"results/{job}/{name}"


def _stop(job: str) -> str:
    return f"stops/{job}"


def _add(archive: tarfile.TarFile, path: Path, name: str) -> None:
    """Add a file such that the same bytes give the same archive, whoever wrote them and when."""
    entry = tarfile.TarInfo(name)
    entry.size = path.stat().st_size
    with path.open("rb") as file:
        archive.addfile(entry, file)


def _chunks(file: IO[bytes], check: Check) -> Iterator[bytes]:
    check()
    while chunk := file.read(CHUNK_BYTES):
        yield chunk
        check()
