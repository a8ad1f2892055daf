"""`slrig report`: what is in the file, what is not, and that it goes on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import httpx2
import pytest

from slrig.cli.options import ServiceOptions
from slrig.client import Client
from slrig.errors import ServiceError
from slrig.jobs.records import JobKind
from tests.unit.client.service import client_of, failing
from tests.unit.command import done, refused, slrig

RIG = 'name = "bench"\n[[camera]]\ndevice = "rtsp://me:hush@10.0.0.2/live"\nmqtt_password = "hush hush"\n'
KEY = "the-key-of-the-service"


@pytest.fixture
def rig_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A rig whose service answers, and whose doctor fails."""

    def examined(_client: Client, kind: JobKind, *_: object) -> tuple[dict[str, Any], None]:
        if kind is JobKind.DOCTOR:
            message = "camera 'left' at http://me:hush@10.0.0.3/ is gone"
            raise ServiceError(message)
        return {"rig": "bench", "found": f"{kind} {Path.home()}/rig.toml"}, None

    def scanned(_client: Client, _request: object, output: Path, _part: object, *, files: tuple[str, ...]) -> None:
        output.mkdir()
        for name in files:
            (output / name).write_text(name)

    @contextmanager
    def serving(_rig: Path, data: Path, _told: object) -> Iterator[Client]:
        (data / "service.log").write_text(f"the key is {KEY}")
        with client_of(lambda _: httpx2.Response(200, json={"name": "bench"})) as client:
            yield client

    for name, instead in (
        ("examined_by", examined), ("scan_with", scanned), ("rig_service", serving), ("_tools", lambda: "tools"),
        ("_kernel_log", lambda: "usb 1-1: new device"), ("_devices", lambda: {"devices": []}),
    ):  # fmt: skip
        monkeypatch.setattr(f"slrig.cli.report.{name}", instead)
    monkeypatch.setenv("SLRIG_API_KEY", KEY)
    file = tmp_path / "rig.toml"
    file.write_text(RIG)
    return file


def unpacked(file: Path) -> Mapping[str, str]:
    with ZipFile(file) as packed:
        return {name: packed.read(name).decode() for name in packed.namelist()}


TEXTS = {
    "README.txt", "versions.json", "devices.json", "tools.txt", "dmesg.txt", "rig.toml", "rig.json", "latency.json",
    "conformance.json", "scan-1/report.json", "scan-2/report.json", "service.log",
}  # fmt: skip
PICTURES = {f"scan-{number}/{name}" for number in (1, 2) for name in ("preview.png", "bundle.zip")}


@pytest.mark.parametrize(("options", "pictures"), [([], set()), (["--pictures"], PICTURES)])
def test_report_holds_all_that_can_be_had_and_nothing_secret(
    tmp_path: Path, rig_file: Path, options: list[str], pictures: set[str]
) -> None:
    told = slrig("report", tmp_path / "bench.zip", "--rig", rig_file, *options)
    assert told.exit_code == 0
    assert "missing   doctor.json: camera 'left'" in told.stderr
    found = unpacked(tmp_path / "bench.zip")
    assert found.keys() == TEXTS | pictures
    assert [name for name, text in found.items() if "hush" in text or KEY in text or str(Path.home()) in text] == []
    assert 'device = "rtsp://…@10.0.0.2/live"\nmqtt_password = …\n' in found["rig.toml"]
    readme = found["README.txt"]
    assert [name for name in TEXTS if name.partition("/")[0] not in readme] == ["README.txt"]
    assert "missing           doctor.json: camera 'left' at http://…@10.0.0.3/ is gone" in readme
    assert ("no pictures" in readme) is (not pictures)


def test_report_of_a_machine_without_a_service_says_so_once(
    tmp_path: Path, rig_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ServiceOptions, "client", lambda _: client_of(failing(httpx2.ConnectError("refused"))))
    told = slrig("report", tmp_path / "bench.zip")
    assert told.exit_code == 0
    assert told.stderr.count("cannot be reached") == 1
    found = unpacked(tmp_path / "bench.zip")
    assert found.keys() == {"README.txt", "versions.json", "devices.json", "tools.txt", "dmesg.txt"}
    assert found["README.txt"].count("cannot be reached") == 1
    assert rig_file.is_file()


def test_report_overwrites_nothing_unless_it_is_told_to(tmp_path: Path, rig_file: Path) -> None:
    file = tmp_path / "bench.zip"
    file.write_text("another")
    assert "exists and is unchanged" in refused(slrig("report", file, "--rig", rig_file))
    assert file.read_text() == "another"
    assert str(file) in done("report", file, "--rig", rig_file, "--force")
    assert "rig.toml" in unpacked(file)
    assert list(tmp_path.glob(".*")) == []
