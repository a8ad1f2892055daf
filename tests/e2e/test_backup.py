"""A backup of a service that scans meanwhile, restored elsewhere: every scan that had ended is there, byte for byte."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.conftest import Start, write_rig
from tests.e2e.test_survival import SLOW, ended

BRACKET = [0.003, 0.005, 0.008, 0.012, 0.016, 0.02]
BOTH = {"rows": True}

pytestmark = pytest.mark.slow


def slrig(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "slrig.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)  # noqa: S603


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_backup_while_scans_run_restores_every_finished_scan(start: Start, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig", head=SLOW)
    first = start(rig)
    with first.client() as client:
        scans = [client.scans.start(label="first"), *(client.scans.start(if_busy="queue") for _ in range(3))]
        # A third of a minute each however fast the machine is, so that no backup finds the last one ended.
        scans += [client.scans.start(if_busy="queue", exposures_s=BRACKET, patterns=BOTH) for _ in range(4)]
        done = ended(client, scans[0])
        assert done["state"] == "succeeded"
        made = slrig("backup", tmp_path / "earlier", "--data", first.data, "--json")
        assert made.returncode == 0, made.stderr
        before = {each["id"] for each in client.get("/scan")["scans"] if each["state"] == "succeeded"}
        linked = ("--link-previous", tmp_path / "earlier")
        made = slrig("backup", tmp_path / "backup", "--data", first.data, "--json", *linked)
        assert made.returncode == 0, made.stderr
        for scan in reversed(scans):
            if client.get(scan["links"]["self"])["state"] in {"queued", "capturing"}:
                client.post(scan["links"]["cancel"], None)
        ends = [ended(client, scan)["state"] for scan in scans]
        assert ends[0] == "succeeded"
        assert ends[-1] == "cancelled"
        assert set(ends) == {"succeeded", "cancelled"}
    assert first.stop() == 0

    assert slrig("restore", tmp_path / "backup", "--data", tmp_path / "elsewhere").returncode == 0
    second = start(rig, tmp_path / "elsewhere")
    with second.client() as client:
        states = {each["id"]: each["state"] for each in client.get("/scan")["scans"]}
        kept = {scan for scan, state in states.items() if state == "succeeded"}
        assert before <= kept
        assert len(kept) == json.loads(made.stdout)["scans"]
        # Scans were made meanwhile, and none of them goes on by itself.
        assert set(states) == {scan["id"] for scan in scans}
        assert {states[scan] for scan in set(states) - kept} == {"interrupted"}
        for scan in kept:
            files = contents(second.data / "scans" / scan)
            assert len(files) > 10
            assert files == contents(first.data / "scans" / scan)
        client.fetch(done["links"]["files"]["mesh.ply"], tmp_path / "mesh.ply")
        assert (tmp_path / "mesh.ply").read_bytes() == (first.data / "scans" / done["id"] / "mesh.ply").read_bytes()
        assert ended(client, client.scans.start())["state"] == "succeeded"
    assert second.stop() == 0

    mesh = tmp_path / "backup" / "data" / "scans" / done["id"] / "mesh.ply"
    changed = bytearray(mesh.read_bytes())
    changed[-1] ^= 1
    mesh.write_bytes(changed)
    refused = slrig("restore", tmp_path / "backup", "--data", tmp_path / "third")
    assert refused.returncode == 2
    assert f"{mesh} was changed" in refused.stderr
    assert not (tmp_path / "third").exists()
