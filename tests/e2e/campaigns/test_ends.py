"""The service ends, or is killed, at a step of a scan, and is started again on its data; or on a restored backup.

SIGTERM leaves the projector dark and every scan marked as interrupted; clients that follow a scan hear of it. After
SIGKILL the next start darkens the projector and marks the scan. A scan that waited waits again, and one with all its
frames is reconstructed.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx2
import pytest

from slrig.client import Client
from tests.e2e.campaigns.conftest import Stand
from tests.e2e.campaigns.test_faults import READ, preview
from tests.e2e.conftest import KEY, STOP_LIMIT_S, ServiceProcess, ended, followed_to, scanned, serving, slrig, write_rig
from tests.e2e.faulty_rig.driver import CAMERA_NAME, PLAYER
from tests.e2e.faulty_rig.service import Desk, Follower, Step, half_written

pytestmark = pytest.mark.slow

Serve = Callable[..., ServiceProcess]
DARK_STEPS = {"open", "configure"}
OPEN, SHOW, COMMIT = Step(PLAYER, "open"), Step(PLAYER, "show", 0), Step("disk", "commit")

# No step of the disk comes after one that may have all its frames: the next service writes those of its scan, too.
ENDED = (
    (OPEN, signal.SIGTERM),
    (Step(CAMERA_NAME, "configure"), signal.SIGTERM),
    (Step("disk", "write"), signal.SIGTERM),
    (SHOW, signal.SIGTERM),
    (COMMIT, signal.SIGTERM),
    (READ, signal.SIGHUP),  # as a terminal that is closed
    (Step(PLAYER, "blank"), signal.SIGTERM),
)
# What a kill leaves counts: a scan that waits, one without a frame, some frames, all written, all in their place.
KILLED = tuple((step, signal.SIGKILL) for step in (OPEN, SHOW, READ, Step("disk", "sync"), COMMIT))


def until_it_is_ending(service: ServiceProcess) -> None:
    """Wait until a service has noticed the signal that ends it."""
    limit_s = time.monotonic() + STOP_LIMIT_S
    while "is ending" not in httpx2.get(f"{service.url}/readyz").text:
        assert time.monotonic() < limit_s, service.log.read_text()


def settled(client: Client, scan: dict[str, Any]) -> str:
    """The state of a scan after the next start; an interrupted one says what to do."""
    record = ended(client, scan)
    if record["state"] != "succeeded":
        assert record["error"]["type"] == "/problems/scan-interrupted", record
        assert "Start it again" in record["error"]["detail"]
    return str(record["state"])


@pytest.mark.parametrize("instants", [ENDED, KILLED], ids=["ended", "killed"])
def test_an_end_at_any_step_loses_at_most_the_scan_of_that_step(
    desk: Desk, serve_again: Serve, instants: tuple[tuple[Step, signal.Signals], ...]
) -> None:
    before: tuple[dict[str, Any], str] | None = None
    waiting: dict[str, Any] | None = None
    for step, how in instants:
        desk.forget()
        with desk.held(step) as hold:
            # Each driver returns here, late on a busy machine, and what it has opened has to be closed then.
            service = serve_again(shutdown_s=STOP_LIMIT_S / 2)
            with service.client() as client:
                if step is OPEN:
                    hold.until_reached()
                scan = waiting or client.scans.start()
                hold.until_reached()
                assert desk.was_lit() or step.name in DARK_STEPS
                if before is not None:
                    assert settled(client, before[0]) == before[1], step
            follower = Follower(service, scan)
            service.process.send_signal(how)
            if how is not signal.SIGKILL:
                if step is OPEN:
                    # Otherwise the driver may return before the signal arrives, and the scan begins.
                    until_it_is_ending(service)
                desk.lift()
            assert service.gone() == (-how if how is signal.SIGKILL else 0)
        if how is signal.SIGKILL:
            left = "queued" if step is OPEN else "succeeded" if step is COMMIT else "interrupted"
        else:
            left = follower.last()
            allowed = {"queued"} if step is OPEN else {"interrupted", "computing"}
            assert left in allowed or step is COMMIT
            assert not (service.data / "service.json").exists()
            assert not desk.lit, desk.light
            opened = {device for device, name, _ in desk.steps if name == "open"}
            assert {device for device, name, _ in desk.steps if name == "close"} >= opened
            assert half_written(service.data) == []
        waiting = scan if left == "queued" else None
        before = None if waiting else (scan, "interrupted" if left == "interrupted" else "succeeded")
    assert before is not None
    service = serve_again()
    with service.client() as client:
        assert settled(client, before[0]) == before[1]
        assert half_written(service.data) == []
        assert scanned(client)["state"] == "succeeded"
    assert desk.dark()
    assert service.stop() == 0


def test_an_end_spares_every_scan_that_is_reconstructed(desk: Desk, serve_again: Serve) -> None:
    service = serve_again(shutdown_s=STOP_LIMIT_S / 2)
    for how in (signal.SIGTERM, signal.SIGKILL):
        with service.client() as client:
            assert scanned(client)["state"] == "succeeded"
            worker = service.worker_id()
            alive = os.pidfd_open(worker)
            os.kill(worker, signal.SIGSTOP)
            computed = [client.scans.start(if_busy="queue") for _ in range(2)]
            for scan in computed:
                followed_to(client, scan, "computing")
            # The rig is free meanwhile.
            assert client.get("/rig")["computing"] == [each["id"] for each in computed]
            with desk.held(READ) as hold:
                shot = client.scans.start()
                hold.until_reached()
                service.process.send_signal(how)
                if how is signal.SIGKILL:
                    service.gone()
        assert service.gone() == (0 if how is signal.SIGTERM else -how)
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(alive, signal.SIGCONT)
        # Its child does not stay.
        assert select.select([alive], [], [], STOP_LIMIT_S)[0]
        os.close(alive)
        service = serve_again(shutdown_s=STOP_LIMIT_S / 2)
        with service.client() as client:
            assert settled(client, shot) == "interrupted"
            assert [settled(client, scan) for scan in computed] == ["succeeded"] * 2
            assert half_written(service.data) == []
    assert service.stop() == 0


def test_the_end_of_the_service_ends_the_preview_and_a_kill_leaves_its_light_to_the_next_start(
    desk: Desk, serve_again: Serve
) -> None:
    for how in (signal.SIGTERM, signal.SIGKILL):
        service = serve_again()
        with service.client() as client:
            assert scanned(client)["state"] == "succeeded"
            with preview(Stand(desk, service, client)) as stream:
                assert desk.shines()
                service.process.send_signal(how)
                if how is signal.SIGTERM:
                    stream.read()
                assert service.gone() == (0 if how is signal.SIGTERM else -how)
        assert desk.lit == (how is signal.SIGKILL)
        assert "Cancel" not in service.log.read_text()
    service = serve_again()
    assert desk.dark()
    assert service.stop() == 0


def test_a_service_that_may_drain_finishes_its_scan_and_keeps_the_queue(desk: Desk, serve_again: Serve) -> None:
    # A stream lives as long as the work that it follows, however little time a stop may take.
    first = serve_again(shutdown_s=0.1, SLRIG_DRAIN_S="60")
    with first.client() as client, desk.held(READ) as hold:
        under_way, waiting = client.scans.start(), client.scans.start(if_busy="queue")
        hold.until_reached()
        key = {"Authorization": f"Bearer {KEY}"}
        with httpx2.stream("GET", f"{first.url}{under_way['links']['events']}", headers=key, timeout=60) as events:
            first.process.send_signal(signal.SIGTERM)
            hold.go.set()
            assert '"succeeded"' in events.read().decode()
    assert first.gone() == 0
    with desk.held(READ) as hold:
        second = serve_again(SLRIG_DRAIN_S="60")
        with second.client() as client:
            assert client.get(under_way["links"]["self"])["state"] == "succeeded"
            hold.until_reached()
            assert client.get(waiting["links"]["self"])["state"] == "capturing"
        second.process.send_signal(signal.SIGTERM)
        with pytest.raises(subprocess.TimeoutExpired):
            second.process.wait(1)
        # After a second signal it waits no longer.
        assert second.stop() == 0


def refused(rig: Path, data: Path, port: str = "0") -> str:
    return slrig("serve", rig, "--port", port, "--data", data, codes=(2,)).stderr


def test_a_service_that_cannot_start_says_why(tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig")
    with serving(rig, tmp_path / "data") as service:
        assert f"process id {service.process.pid}" in refused(rig, service.data)
        assert "--port 0" in refused(rig, tmp_path / "other", str(urlsplit(service.url).port))
    rig.write_text(rig.read_text().replace('"scene.toml"', '"scenes.toml"'))
    assert "scenes.toml" in refused(rig, tmp_path / "other")


def test_a_service_ends_with_the_program_that_started_it(tmp_path: Path) -> None:
    data = tmp_path / "data"
    command = ["serve", str(write_rig(tmp_path / "rig")), "--port", "0", "--data", str(data), "--until-eof"]
    with subprocess.Popen(  # noqa: S603 - our own command
        [sys.executable, "-m", "slrig.cli", *command],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    ) as service:  # fmt: skip
        assert service.stdin is not None
        assert service.stdout is not None
        assert b" at http://" in service.stdout.readline()
        # Without a terminal, what is printed may be kept as a log.
        printed = service.stdout.readline().decode()
        assert f"First API key written to {data / 'first-key'}" in printed
        assert (data / "first-key").read_text().strip() not in printed
        assert [path for path in (data, data / "first-key", data / "slrig.sqlite") if path.stat().st_mode & 0o077] == []
        service.stdin.close()
        assert service.wait(STOP_LIMIT_S) == 0


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
