"""Several keys with names: made, shown once, kept as digests, ended."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from slrig.api.keys import ALL_SCOPES, FIRST_NAME, GIVEN_NAME, Key, KeyRing, first_key
from slrig.api.scopes import Scope
from slrig.errors import ConfigError, StorageError

NOW = datetime(2026, 11, 24, 12, tzinfo=UTC)


def ring(folder: Path, *, given: str | None = None, now: datetime = NOW) -> KeyRing:
    return KeyRing(folder / "keys.json", given=given, clock=lambda: now)


def known(keys: KeyRing, key: str | None) -> Key:
    found = keys.find(str(key))
    assert found is not None
    return found


def test_key_is_shown_once_and_kept_as_its_digest(tmp_path: Path) -> None:
    key = ring(tmp_path).add("Ann", [Scope.SCAN])
    path = tmp_path / "keys.json"
    assert key not in path.read_text()
    assert path.stat().st_mode & 0o777 == 0o600
    found = known(ring(tmp_path), key)
    assert (found.name, found.scopes, found.fault(NOW)) == ("Ann", (Scope.LOOK, Scope.SCAN), None)
    assert ring(tmp_path).find(key[:-1]) is None


def test_what_another_process_changes_holds_at_once(tmp_path: Path) -> None:
    serving, elsewhere = ring(tmp_path), ring(tmp_path)
    key = elsewhere.add("Ann", [])
    assert serving.find(key) is not None
    elsewhere.revoke("Ann")
    assert known(serving, key).fault(NOW) == "was revoked on 2026-11-24"
    assert serving.find(elsewhere.add("Ann", [])) is not None


def test_a_key_ends_when_it_was_said_to(tmp_path: Path) -> None:
    key = ring(tmp_path).add("guest", [], life=timedelta(days=2))
    found = known(ring(tmp_path), key)
    assert found.fault(NOW + timedelta(days=1.9)) is None
    assert found.fault(NOW + timedelta(days=2)) == "expired on 2026-11-26"


def test_names_of_keys_are_unique_and_printable(tmp_path: Path) -> None:
    keys = ring(tmp_path, given="x" * 16)
    keys.add("Ann", [])
    for taken in ("Ann", GIVEN_NAME):
        with pytest.raises(ConfigError, match="There is a key of the name"):
            keys.add(taken, [])
    for none in ("", "a\nb", "\x1b[31m", "x" * 65, "-rf"):
        with pytest.raises(ConfigError, match="is no name for a key"):
            keys.add(none, [])
    with pytest.raises(ConfigError, match="no key of the name 'Bob' that could be revoked, but Ann"):
        keys.revoke("Bob")


def test_the_first_start_makes_a_key_and_a_lost_one_is_replaced(tmp_path: Path) -> None:
    keys = ring(tmp_path)
    first = first_key(keys, fresh=False)
    assert first_key(keys, fresh=False) is None
    fresh = first_key(keys, fresh=True)
    old, new = known(keys, first), known(keys, fresh)
    assert old.fault(NOW) is not None
    assert (new.name, new.scopes, new.fault(NOW)) == (FIRST_NAME, ALL_SCOPES, None)


def test_the_key_of_the_environment_is_kept_nowhere(tmp_path: Path) -> None:
    keys = ring(tmp_path, given="the key of tests")
    found = known(keys, "the key of tests")
    assert (found.name, found.scopes) == (GIVEN_NAME, ALL_SCOPES)
    assert first_key(keys, fresh=False) is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["", "{}", '{"format": "slrig-keys", "version": 1, "keys": [{"name": "Ann"}]}'])
def test_a_damaged_file_opens_nothing(tmp_path: Path, text: str) -> None:
    keys = ring(tmp_path)
    key = keys.add("Ann", [])
    (tmp_path / "keys.json").write_text(text)
    with pytest.raises(StorageError, match=r"cannot be read: .*Restore the file from a backup"):
        keys.find(key)
