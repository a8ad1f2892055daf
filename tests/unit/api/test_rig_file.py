"""The rig file of a service: shown, changed with the rig opened by it, and as it was where that fails."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from slrig.api import rig_file
from slrig.config import RigConfig
from slrig.devices import Rig, Synchronisation
from slrig.doctor import Diagnosis, keep
from slrig.doctor.advice import ExposureAdvice
from slrig.errors import DeviceGoneError
from tests.unit.api.conftest import RIG, ServedBench, refusal

MEASURED = Diagnosis(
    "bench", (), {"cam0": ExposureAdvice(1 / 60, "1 × the refresh period", (0.002, 0.03))}, None,
    Synchronisation(0.02, 0.003), None, None, (),
)  # fmt: skip


@pytest.fixture
def opened(client: TestClient, served: ServedBench, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[RigConfig]]:
    """The rig files by which the rig was opened. One whose driver is "absent" cannot be opened."""
    path, configs = served.service.rig.path, list[RigConfig]()
    path.write_text(RIG)
    # The first opening.
    client.get("/rig/file")

    def open_rig(config: RigConfig) -> Rig:
        configs.append(config)
        if config.head is not None and config.head.driver == "absent":
            message = "The head does not answer."
            raise DeviceGoneError(message)
        return served.open_rig()

    monkeypatch.setattr(rig_file, "open_rig", open_rig)
    yield configs
    path.write_text(RIG)
    assert client.post("/rig/reopen").status_code == 204


def of(client: TestClient) -> dict[str, Any]:
    found: dict[str, Any] = client.get("/rig/file").json()
    return found


def test_what_the_doctor_measured_is_shown_as_a_difference_and_taken_over(
    client: TestClient, served: ServedBench, opened: list[RigConfig]
) -> None:
    assert of(client)["proposals"] == []
    keep(served.service.folder.root, "doctor", MEASURED.document())
    shown = of(client)
    (proposal,) = shown["proposals"]
    assert proposal["kind"] == "doctor"
    assert "-exposure_s = 0.5" in proposal["difference"]
    assert any(line.startswith("+exposure_s = 0.0166667 # 1 × the refresh") for line in proposal["difference"])
    changed = client.put("/rig/file", json={"text": proposal["text"], "version": shown["version"]}).json()
    assert (changed["text"], changed["proposals"]) == (proposal["text"], [])
    (served.service.folder.root / "doctor.json").unlink()
    assert [each.head is not None and each.head.exposure_s for each in opened] == [0.0166667]
    path = served.service.rig.path
    assert path.read_text() == proposal["text"]
    assert path.with_name("rig.toml.bak").read_text() == RIG
    assert client.get("/rig").json()["scan_defaults"] == {"line_shift_period_px": 6}
    # Made of a file that is another one by now.
    stale = {"text": RIG, "version": shown["version"]}
    assert refusal(client, "PUT", "/rig/file", json=stale) == (409, "/problems/rig-file-changed")
    assert path.read_text() == proposal["text"]
    assert client.get("/rig").json()["open"]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('driver = "tame"', 'driver = "absent"', "The rig cannot be opened so, and the file is as it was: The head"),
        ('name = "bench"', 'name = "other"', "name: expected 'bench'"),
        ("[scan]", "[skan]", "skan: unknown key"),
        ("[scan]", "[scan", "expected TOML"),
    ],
)
@pytest.mark.usefixtures("opened")
def test_a_file_that_is_wrong_changes_nothing(
    client: TestClient, served: ServedBench, old: str, new: str, problem: str
) -> None:
    asked = {"text": RIG.replace(old, new), "version": of(client)["version"]}
    answer = client.put("/rig/file", json=asked)
    assert answer.status_code == 422
    assert problem in answer.json()["detail"]
    assert served.service.rig.path.read_text() == RIG
    assert sorted(each.name for each in served.service.rig.path.parent.glob("*rig.toml*")) in (
        ["rig.toml"], ["rig.toml", "rig.toml.bak"],
    )  # fmt: skip
    rig = client.get("/rig").json()
    assert (rig["open"], rig["error"]) == (True, None)


@pytest.mark.usefixtures("opened")
def test_settings_are_changed_with_the_comments_kept(client: TestClient, served: ServedBench) -> None:
    shown = of(client)
    asked = {**shown["settings"], "version": shown["version"]}
    assert asked["cameras"] == {"head": {"exposure_s": 0.5, "gain": 1.0}}
    asked = {**asked, "cameras": {"head": {"exposure_s": 0.25, "gain": 1.0}}, "tolerance_mm": 0.1}
    changed = client.put("/rig/settings", json=asked).json()
    assert {**changed["settings"], "version": shown["version"]} == asked
    tables = tomllib.loads(RIG)
    tables["head"]["exposure_s"] = 0.25
    del tables["scan"]["exposure_s"]
    assert tomllib.loads(changed["text"]) == {**tables, "accuracy": {"tolerance_mm": 0.1}}
    assert 'driver = "tame" # as tests open it' in changed["text"]
    assert served.service.acceptance.tolerance_mm == served.service.calibrations.tolerance_mm == 0.1
    asked |= {"version": changed["version"], "cameras": {"head": {"exposure_s": 1e4, "gain": 1.0}, "right": {}}}
    faults = client.put("/rig/settings", json=asked).json()["errors"]
    assert [fault["field"] for fault in faults] == ["cameras.head.exposure_s"]
    asked["cameras"]["head"] = {"exposure_s": 2.0, "gain": 8.0}
    faults = client.put("/rig/settings", json=asked).json()["errors"]
    assert [fault["field"] for fault in faults] == [
        "cameras.head.exposure_s", "cameras.head.gain", "cameras.right",
    ]  # fmt: skip
    assert "which camera cam0 can" in faults[0]["message"]


@pytest.mark.usefixtures("opened")
def test_a_rig_is_opened_again_by_its_file_and_never_while_a_scan_holds_it(
    client: TestClient, served: ServedBench
) -> None:
    path = served.service.rig.path
    path.write_text(RIG.replace("0.5", "0.125"))
    assert client.post("/rig/reopen").status_code == 204
    assert client.get("/rig").json()["scan_defaults"]["exposure_s"] == 0.125
    held = served.held(client)
    assert refusal(client, "POST", "/rig/reopen") == (409, "/problems/rig-busy")
    version = of(client)["version"]
    assert refusal(client, "PUT", "/rig/file", json={"text": RIG, "version": version})[0] == 409
    assert path.read_text() == RIG.replace("0.5", "0.125")
    client.post(f"/scan/{held['id']}/cancel")
    served.gate.set()
    # A device that is gone is told of, and the next try is a new one.
    path.write_text(RIG.replace("tame", "absent"))
    client.get(f"/scan/{held['id']}/events")
    assert refusal(client, "POST", "/rig/reopen") == (503, "/problems/device-gone")


def test_a_file_that_the_service_may_not_write_says_so(
    client: TestClient, served: ServedBench, opened: list[RigConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = served.service.rig.path
    monkeypatch.setattr(os, "access", lambda each, _mode: Path(each) != path.parent)
    shown = of(client)
    assert f"may not write {path.parent}" in shown["refused"]
    asked = {"text": RIG, "version": shown["version"]}
    assert refusal(client, "PUT", "/rig/file", json=asked) == (507, "/problems/storage")
    assert opened == []
