"""The keys of the service: who has one, what for, and until when. Kept as `keys.json` in the data folder.

Only the SHA-256 of a key is kept: it has 256 random bits, so it needs no salt and no slow hash. A running service reads
the file anew whenever it was changed: a key that was revoked opens nothing from the next request on.
"""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Literal

from filelock import FileLock
from pydantic import AwareDatetime, Field, TypeAdapter, ValidationError

from slrig import KEY_VARIABLE
from slrig.api.scopes import Scope
from slrig.bundle import Strict, write_file
from slrig.errors import ConfigError, StorageError
from slrig.failure import disk_errors
from slrig.jobs.records import Clock, utc_now

LEAST_KEY_LENGTH = 16
"""A key that people made up and that is shorter than this can be guessed."""

FIRST_NAME = "owner"
"""Whom the key belongs to that the service makes at its first start."""

GIVEN_NAME = "environment"
"""Whom the key of the environment belongs to."""

KEY_NAME = r"^[A-Za-z0-9][A-Za-z0-9 ._@-]{0,63}$"


ALL_SCOPES = tuple(Scope)


class Key(Strict):
    """One key: the name of who has it, its digest, what it is for. It ends at `expires_at`, or when it is revoked."""

    name: Annotated[str, Field(pattern=KEY_NAME)]
    digest: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    scopes: Annotated[tuple[Scope, ...], Field(strict=False)]
    created_at: Annotated[AwareDatetime, Field(strict=False)]
    expires_at: Annotated[AwareDatetime, Field(strict=False)] | None = None
    revoked_at: Annotated[AwareDatetime, Field(strict=False)] | None = None

    def fault(self, now: datetime) -> str | None:
        """Why the key opens nothing, None where it does."""
        if self.revoked_at is not None:
            return f"was revoked on {self.revoked_at:%Y-%m-%d}"
        if self.expires_at is not None and self.expires_at <= now:
            return f"expired on {self.expires_at:%Y-%m-%d}"
        return None


class _KeyFile(Strict):
    format: Literal["slrig-keys"]
    version: Literal[1]
    keys: Annotated[tuple[Key, ...], Field(strict=False)]


_adapter = TypeAdapter(_KeyFile)


def digest(key: str) -> str:
    """What is kept of a key."""
    return hashlib.sha256(key.encode()).hexdigest()


class KeyRing:
    """The keys in a file, and the one of the environment beside them, which is kept nowhere.

    Raises
    ------
    ConfigError
        The given key is too short or cannot travel in a header.
    StorageError
        Here and in every call: the file cannot be read or written, or somebody changed it into something else.
    """

    def __init__(self, path: Path, *, given: str | None = None, clock: Clock = utc_now) -> None:
        self._path = path
        self._clock = clock
        self._given = None if given is None else _given_key(given, clock())
        self._seen: tuple[int, int, int] | None = None
        self._by_digest: dict[str, Key] = {}
        self._look()

    def find(self, sent: str) -> Key | None:
        """The key that somebody sent, if it is one, whether or not it still opens anything."""
        self._look()
        return self._by_digest.get(digest(sent))

    def named(self, name: str) -> Key | None:
        """The newest key of a name."""
        return next((key for key in reversed(self.everybody) if key.name == name), None)

    @property
    def everybody(self) -> tuple[Key, ...]:
        """Every key, from old to new."""
        self._look()
        return tuple(self._by_digest.values())

    def add(self, name: str, scopes: Iterable[Scope], *, life: timedelta | None = None) -> str:
        """Make a key and return it: this is the only time that it is seen. Raises ConfigError: the name is taken, or is
        none.
        """
        if not re.fullmatch(KEY_NAME, name):
            message = (
                f"{name!r} is no name for a key: expected up to 64 letters, digits, spaces and any of "
                "'._@-', the first a letter or a digit. Name the person or the program that gets it."
            )
            raise ConfigError(message)
        key = secrets.token_urlsafe(32)
        now = self._clock()
        made = Key(
            name=name,
            digest=digest(key),
            scopes=tuple(each for each in Scope if each in {Scope.LOOK, *scopes}),
            created_at=now,
            expires_at=None if life is None else now + life,
        )
        with self._changing() as keys:
            if any(each.name == name and each.fault(now) is None for each in keys) or name == GIVEN_NAME:
                message = f"There is a key of the name '{name}' already. Revoke it first, or choose another name."
                raise ConfigError(message)
            keys.append(made)
        return key

    def revoke(self, name: str) -> None:
        """Have the key of a name open nothing any more. Raises ConfigError: there is none."""
        now = self._clock()
        with self._changing() as keys:
            found = [place for place, key in enumerate(keys) if key.name == name and key.fault(now) is None]
            if not found:
                known = ", ".join(sorted(key.name for key in keys if key.fault(now) is None)) or "none at all"
                message = f"There is no key of the name '{name}' that could be revoked, but {known}."
                raise ConfigError(message)
            keys[found[0]] = keys[found[0]].model_copy(update={"revoked_at": now})

    @contextmanager
    def _changing(self) -> Iterator[list[Key]]:
        with disk_errors(self._path.parent), FileLock(self._path.with_suffix(".lock"), mode=0o600):
            keys = list(self._read())
            yield keys
            file = _KeyFile(format="slrig-keys", version=1, keys=tuple(keys))
            write_file(self._path, _adapter.dump_json(file, indent=1) + b"\n")
            self._path.chmod(0o600)

    def _look(self) -> None:
        try:
            found = self._path.stat()
        except FileNotFoundError:
            seen = (0, 0, 0)
        except OSError as error:
            message = f"The keys in {self._path} cannot be read: {error.strerror}. See that slrig may read the file."
            raise StorageError(message) from error
        else:
            seen = (found.st_mtime_ns, found.st_ino, found.st_size)
        if seen == self._seen:
            return
        keys = self._read()
        self._by_digest = {key.digest: key for key in (*keys, *([] if self._given is None else [self._given]))}
        self._seen = seen

    def _read(self) -> tuple[Key, ...]:
        try:
            return _adapter.validate_json(self._path.read_bytes()).keys
        except FileNotFoundError:
            return ()
        except (OSError, ValidationError) as error:
            message = (
                f"The keys in {self._path} cannot be read: {_first_line(error)}. Restore the file from a "
                "backup, or remove it and make the keys anew with `slrig key add`."
            )
            raise StorageError(message) from error


def _first_line(error: OSError | ValidationError) -> str:
    if isinstance(error, OSError):
        return error.strerror or str(error)
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc'])) or 'file'}: {first['msg']}"


def _given_key(given: str, now: datetime) -> Key:
    sendable = given.isascii() and given.isprintable()
    if len(given) < LEAST_KEY_LENGTH or not sendable:
        others = "" if sendable else ", and others among them"
        message = (
            f"{KEY_VARIABLE}: expected a key of {LEAST_KEY_LENGTH} or more printable ASCII characters, found "
            f"{len(given)}{others}. Unset it, and the service makes a key of its own."
        )
        raise ConfigError(message)
    return Key(name=GIVEN_NAME, digest=digest(given), scopes=ALL_SCOPES, created_at=now)


def first_key(ring: KeyRing, *, fresh: bool) -> str | None:
    """The key that a service makes at its start, to be shown once: where there is none, or a `fresh` one is asked for,
    which takes the place of the one made so before. None where none is made.
    """
    if fresh:
        owner = ring.named(FIRST_NAME)
        if owner is not None and owner.revoked_at is None:
            ring.revoke(FIRST_NAME)
    elif ring.everybody:
        return None
    return ring.add(FIRST_NAME, ALL_SCOPES)
