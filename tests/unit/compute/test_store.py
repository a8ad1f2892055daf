"""The store between a rig and its pool: what comes back, what is refused, and that no secret is told."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

pytest.importorskip("obstore", reason="needs a pool's libraries: pip install 'slrig[pool]'")

import obstore
from obstore.store import MemoryStore

from slrig.compute.store import CHUNK_BYTES, PoolError, PoolStore, open_store
from slrig.errors import ConfigError

SECRET = "the-secret-of-the-store"  # noqa: S105 - nothing but a test's


@pytest.fixture(autouse=True)
def _credentials(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [each for each in os.environ if each.startswith("AWS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "somebody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)


def bundle(folder: Path) -> Path:
    (folder / "frames").mkdir(parents=True)
    (folder / "frames" / "0.png").write_bytes(b"0123456789abcdef" * (CHUNK_BYTES // 10))
    (folder / "bundle.json").write_text("{}")
    return folder


def test_the_same_bundle_has_the_same_key_and_comes_back(tmp_path: Path) -> None:
    store = open_store((tmp_path / "shared").as_uri())
    first, second = bundle(tmp_path / "one"), bundle(tmp_path / "two")
    os.utime(second / "bundle.json", (1, 1))
    key = store.put_bundle(first, lambda: None)
    assert store.put_bundle(second, lambda: None) == key
    store.fetch_bundle(key, tmp_path / "back", lambda: None)
    for name in ("bundle.json", "frames/0.png"):
        assert (tmp_path / "back" / name).read_bytes() == (first / name).read_bytes()
    (second / "bundle.json").write_text("[]")
    assert store.put_bundle(second, lambda: None) != key


def test_a_transfer_that_is_to_end_leaves_nothing(tmp_path: Path) -> None:
    objects, checked = MemoryStore(), 0

    def check() -> None:
        nonlocal checked
        checked += 1
        if checked == 4:
            raise PoolError("it took too long")

    with pytest.raises(PoolError, match="too long"):
        PoolStore("memory://", objects).put_bundle(bundle(tmp_path / "bundle"), check)
    assert objects.list().collect() == []
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


def test_a_store_that_is_tidied_holds_nothing_and_may_be_tidied_again(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    store = open_store(shared.as_uri())
    key = store.put_bundle(bundle(tmp_path / "bundle"), lambda: None)
    store.put_result("job", tmp_path / "bundle" / "frames" / "0.png", lambda: None)
    for _ in range(2):
        store.clear(bundle=key, job="job")
        assert list(shared.iterdir()) == []


def test_a_slow_line_carries_one_part_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def put(*_args: object, max_concurrency: int = 12, **_options: object) -> None:
        asked.append(max_concurrency)

    monkeypatch.setattr(obstore, "put", put)
    store = PoolStore("memory://", MemoryStore())
    store.put_bundle(bundle(tmp_path / "bundle"), lambda: None)
    store.put_result("job", tmp_path / "bundle" / "frames" / "0.png", lambda: None)
    assert asked == [1, 1]


def test_a_store_that_is_gone_is_named_and_nothing_else(tmp_path: Path) -> None:
    with pytest.raises(PoolError) as caught:
        open_store("s3://scans/hall").put_bundle(bundle(tmp_path / "bundle"), lambda: None)
    assert str(caught.value).startswith("the store s3://scans/hall failed (")
    assert caught.value.__cause__ is None
    assert SECRET not in str(caught.value)


@pytest.mark.parametrize(
    "address",
    ["https://scans/hall", "s3://", "s3://me:secret@scans/hall", "file://host/scans", "s3://scans?key=secret"],
)
def test_an_address_that_is_none_is_refused_without_being_repeated(address: str) -> None:
    with pytest.raises(ConfigError, match="expected s3://BUCKET/PREFIX") as caught:
        open_store(address)
    assert "secret" not in str(caught.value)


def test_store_that_cannot_be_used_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"file/shared: the pool's store cannot be opened \(OSError\)"):
        open_store((tmp_path / "file" / "shared").as_uri())
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://store.plant.example:9000")
    with pytest.raises(ConfigError, match="unencrypted"):
        open_store("s3://scans/hall")


def test_credentials_come_from_the_environment_or_from_a_file_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    with pytest.raises(ConfigError, match="no credentials"):
        open_store("s3://scans/hall")
    login = tmp_path / "login"
    login.write_text(f"somebody:{SECRET}\n")
    login.chmod(0o640)
    with pytest.raises(ConfigError, match="chmod 600") as caught:
        open_store("s3://scans/hall", login)
    assert SECRET not in str(caught.value)
    login.chmod(0o600)
    assert open_store("s3://scans/hall", login).address == "s3://scans/hall"
    login.write_text(SECRET)
    with pytest.raises(ConfigError, match="does not hold KEY ID:SECRET") as caught:
        open_store("s3://scans/hall", login)
    assert SECRET not in str(caught.value)
