"""What the service bears: killed processes, unplugged cameras, restarts, and a stop in the middle of everything."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import httpx2
import pytest

from slrig.client import Client
from slrig.client.events import Progress
from slrig.errors import ServiceError
from tests.e2e.conftest import KEY, STOP_LIMIT_S, Start, write_rig
from tests.e2e.forking import ForkedCommand

pytestmark = pytest.mark.slow

# Takes as long as the frames of a real camera at a low rate, so that there is a middle to be stopped in.
SLOW = "realtime = true"


def followed_to(client: Client, scan: dict[str, Any], stage: str) -> None:
    """Return once the scan has told of this stage or state."""
    for event in client.follow(scan["links"]["events"]):
        if stage in {getattr(event, "stage", None), getattr(event, "state", None)}:
            return
    message = f"the scan ended without {stage}"
    raise AssertionError(message)


def ended(client: Client, scan: dict[str, Any]) -> dict[str, Any]:
    """The scan once it is over."""
    for _ in client.follow(scan["links"]["events"]):
        pass
    return client.get(scan["links"]["self"])


def test_a_terminal_that_is_closed_ends_it_in_good_order(start: Start, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig", head=SLOW)
    first = start(rig)
    with first.client() as client:
        scan = client.scans.start()
        begun = threading.Event()

        def follow() -> None:
            try:
                with first.client() as follower:
                    for event in follower.follow(scan["links"]["events"]):
                        if isinstance(event, Progress) and event.stage == "capture":
                            begun.set()
            except ServiceError:
                return

        # The stream stays open while the service is told to stop.
        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        assert begun.wait(60)
        assert first.stop(signal.SIGHUP) == 0
    assert not (first.data / "service.json").exists()
    second = start(rig)
    with second.client() as client:
        assert client.get(scan["links"]["self"])["state"] == "interrupted"
    assert second.stop() == 0


def test_killed_reconstruction_fails_its_scan_and_the_next_one_succeeds(start: Start, tmp_path: Path) -> None:
    service = start(write_rig(tmp_path / "rig"))
    with service.client() as client:
        assert ended(client, client.scans.start())["state"] == "succeeded"
        worker = service.worker_id()
        os.kill(worker, signal.SIGSTOP)
        scan = client.scans.start()
        followed_to(client, scan, "computing")
        os.kill(worker, signal.SIGKILL)
        record = ended(client, scan)
        assert record["state"] == "failed"
        assert record["error"]["type"] == "/problems/worker-lost"
        assert list(record["links"]["files"]) == ["bundle.zip"]
        assert ended(client, client.scans.start())["state"] == "succeeded"


def test_a_kill_costs_the_scan_that_is_shot_and_none_that_is_reconstructed(start: Start, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig", head=SLOW)
    first = start(rig)
    with first.client() as client:
        assert ended(client, client.scans.start())["state"] == "succeeded"
        worker = first.worker_id()
        os.kill(worker, signal.SIGSTOP)
        computed = [client.scans.start(label="first")]
        followed_to(client, computed[0], "computing")
        # Not in line: the rig is free.
        computed.append(client.scans.start(label="second"))
        followed_to(client, computed[1], "computing")
        assert client.get("/rig")["computing"] == [each["id"] for each in computed]
        shot = client.scans.start(label="third")
        for event in client.follow(shot["links"]["events"]):
            # Long enough for the frames of the second to be a bundle.
            if isinstance(event, Progress) and event.fraction > 0.25:
                break
        first.kill()
        os.kill(worker, signal.SIGKILL)
    second = start(rig)
    with second.client() as client:
        record = client.get(shot["links"]["self"])
        assert (record["state"], record["error"]["type"]) == ("interrupted", "/problems/scan-interrupted")
        for scan in computed:
            record = ended(client, scan)
            assert record["state"] == "succeeded", record
            assert (second.data / "scans" / scan["id"] / "mesh.ply").stat().st_size > 1000
        assert list((second.data / ".incoming").iterdir()) == []
        assert ended(client, client.scans.start())["state"] == "succeeded"
    assert second.stop() == 0


def test_cancelled_scan_leaves_the_rig_ready(start: Start, tmp_path: Path) -> None:
    service = start(write_rig(tmp_path / "rig", head=SLOW))
    with service.client() as client:
        scan = client.scans.start()
        followed_to(client, scan, "capture")
        client.post(scan["links"]["cancel"], None)
        assert ended(client, scan)["state"] == "cancelled"
        assert ended(client, client.scans.start())["state"] == "succeeded"


def test_rig_that_cannot_be_opened_as_its_file_is_ends_the_service_with_the_reason(tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig")
    text = rig.read_text()
    for old, new, words in (
        ('"simulated"', '"simulated"\ncolour = 1', "colour: unknown key"),
        ('"simulated"', '"simulate"', "no installed package provides the head driver 'simulate'"),
        ('"scene.toml"', '"scenes.toml"', "scenes.toml"),
        ('name = "small"', 'name = "small"\ncalibration = "none.json"', "none.json: expected a readable file"),
    ):
        rig.write_text(text.replace(old, new, 1))
        ended_by_rig(rig, words)


def refused(rig: Path, data: Path, log: Path, port: str = "0") -> str:
    """What a service tells that ends with exit code 2 as soon as it is started."""
    command = ForkedCommand(["serve", str(rig), "--port", port, "--data", str(data)], os.environ, log)
    code = command.wait(60)
    command.stdout.close()
    told = log.read_text()
    assert code == 2, told
    assert "Traceback" not in told
    return told


def ended_by_rig(rig: Path, words: str) -> None:
    """Serve a rig whose file is wrong: one message."""
    data, log = rig.parent / "data", rig.parent / "told.log"
    log.unlink(missing_ok=True)
    told = refused(rig, data, log)
    assert told.count("error: ") == 1, told
    assert words in told
    assert not (data / "service.json").exists()


def test_told_to_end_it_lets_the_scan_come_to_its_end_and_keeps_the_queue(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SLRIG_DRAIN_S", "60")
    rig = write_rig(tmp_path / "rig", head=SLOW)
    # A stream lives as long as the work that it follows, however little a stop may take besides.
    monkeypatch.setenv("SLRIG_SHUTDOWN_S", "0.1")
    first = start(rig)
    monkeypatch.delenv("SLRIG_SHUTDOWN_S")
    with first.client() as client:
        under_way = client.scans.start(patterns={"line_shift_period_px": 32}, exposures_s=[0.004, 0.008, 0.016])
        waiting = client.scans.start(if_busy="queue")
        followed_to(client, under_way, "capture")
        key = {"Authorization": f"Bearer {KEY}"}
        with httpx2.stream("GET", f"{first.url}{under_way['links']['events']}", headers=key, timeout=60) as events:
            first.process.send_signal(signal.SIGTERM)
            # It is told to everybody while it comes to its end; right after that nobody answers any more.
            assert '"succeeded"' in events.read().decode()
    assert first._gone(STOP_LIMIT_S) == 0
    second = start(rig)
    with second.client() as client:
        assert client.get(under_way["links"]["self"])["state"] == "succeeded"
        assert ended(client, waiting)["state"] == "succeeded"
        followed_to(client, client.scans.start(), "capture")
    # Told twice, it waits no longer.
    second.process.send_signal(signal.SIGTERM)
    second.process.send_signal(signal.SIGTERM)
    assert second.stop() == 0


def open_to_others(folder: Path) -> list[Path]:
    """What of a running service's folder others may read, write or enter."""
    found = []
    for path in [folder, *folder.rglob("*")]:
        with contextlib.suppress(FileNotFoundError):  # Written beside, and renamed since it was listed.
            if path.stat().st_mode & 0o077:
                found.append(path)
    return found


def test_service_does_not_outlive_the_program_that_started_it(tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig")
    command = [sys.executable, "-m", "slrig.cli", "serve", str(rig), "--port", "0", "--data", str(tmp_path / "data")]
    with subprocess.Popen(  # noqa: S603 - our own command
        [*command, "--until-eof"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as service:
        assert service.stdin is not None
        assert service.stdout is not None
        assert b" at http://" in service.stdout.readline()
        # No terminal: what is printed may be kept as a log.
        told = service.stdout.readline().decode()
        assert f"A first API key was made; read it in {tmp_path / 'data' / 'first-key'}" in told
        key = (tmp_path / "data" / "first-key").read_text().strip()
        assert key not in told
        assert open_to_others(tmp_path / "data") == []
        service.stdin.close()
        assert service.wait(STOP_LIMIT_S) == 0


def test_second_service_on_one_data_folder_is_refused(start: Start, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig")
    service = start(rig)
    assert f"process id {service.process.pid}" in refused(rig, service.data, tmp_path / "second.log")


def test_address_in_use_is_refused(start: Start, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig")
    service = start(rig)
    port = service.url.rsplit(":", 1)[1]
    assert "--port 0" in refused(rig, tmp_path / "other", tmp_path / "second.log", port)
