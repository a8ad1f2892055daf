"""A backup of a service that scans meanwhile, restored elsewhere: every scan that had ended is there, byte for byte."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.e2e.campaigns.test_faults import READ
from tests.e2e.conftest import ServiceProcess, scanned, slrig
from tests.e2e.faulty_rig.desk import Desk

pytestmark = pytest.mark.slow


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_a_backup_while_scans_run_restores_every_finished_scan(
    serve_again: Callable[..., ServiceProcess], desk: Desk, tmp_path: Path
) -> None:
    first = serve_again()
    with first.client() as client:
        done = [scanned(client, label="first")["id"]]
        slrig("backup", tmp_path / "earlier", "--data", first.data)
        done.append(scanned(client, label="second")["id"])
        with desk.held(READ) as hold:
            shot, waits = (client.scans.start(if_busy="queue")["id"] for _ in range(2))
            hold.until_reached()
            linked = ("--link-previous", tmp_path / "earlier")
            made = slrig("backup", tmp_path / "backup", "--data", first.data, "--json", *linked).stdout
    assert json.loads(made)["scans"] == 2
    assert first.stop() == 0
    kept = {scan: contents(first.data / "scans" / scan) for scan in done}
    first.data.rename(tmp_path / "lost")
    slrig("restore", tmp_path / "backup", "--data", first.data)
    second = serve_again()
    with second.client() as client:
        states = {each["id"]: each["state"] for each in client.get("/scan")["scans"]}
        # What ran or waited is on record, and does not go on by itself.
        assert states == dict.fromkeys(done, "succeeded") | dict.fromkeys((shot, waits), "interrupted")
        assert all(len(files) > 10 for files in kept.values())
        assert {scan: contents(second.data / "scans" / scan) for scan in done} == kept
        assert scanned(client)["state"] == "succeeded"
