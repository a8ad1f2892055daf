"""Little memory, few descriptors, a small disk: a scan that lacks room ends in words, and the next one is right."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit
from uuid import uuid4

import pytest

from slrig.errors import ServiceError
from tests.e2e.campaigns.conftest import Stand
from tests.e2e.campaigns.test_faults import marked
from tests.e2e.campaigns.test_foreign_code import checks, faults, right_mesh
from tests.e2e.conftest import scanned
from tests.e2e.faulty_rig.service import Desk, half_written, serve
from tests.e2e.schedules import awaited

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="takes rights to limit what others use"),
]

GROUPS = Path("/sys/fs/cgroup/memory")


def next_is_right(stand: Stand) -> None:
    awaited(lambda: not faults(stand), "readiness")
    again = scanned(stand.client)
    assert again["state"] == "succeeded", again
    right_mesh(stand, again)


@contextmanager
def memory_limited(process: int, more_bytes: int) -> Iterator[None]:
    """Have the kernel end a process that takes so much more memory than it has."""
    if not (GROUPS / "memory.limit_in_bytes").exists():
        pytest.skip("needs the memory controller of cgroup v1")
    group = GROUPS / f"slrig-{uuid4().hex[:8]}"
    group.mkdir()
    try:
        # What it has stays with the group that it came from.
        (group / "memory.limit_in_bytes").write_text(str(more_bytes))
        (group / "cgroup.procs").write_text(str(process))
        yield
    finally:
        for left in (group / "cgroup.procs").read_text().split():
            (GROUPS / "cgroup.procs").write_text(left)
        group.rmdir()


def test_a_worker_that_the_kernel_ends_for_its_memory_is_replaced(stand: Stand) -> None:
    worker = stand.service.worker_id()
    with memory_limited(worker, 2**19):
        record = scanned(stand.client)
    assert record["state"] == "succeeded", record
    assert stand.service.worker_id() != worker
    next_is_right(stand)


def test_a_service_whose_workers_find_no_memory_lives_and_says_so(stand: Stand) -> None:
    worker = stand.service.worker_id()
    with memory_limited(stand.service.process.pid, 2**27):
        os.kill(worker, signal.SIGKILL)
        record = scanned(stand.client)
        assert (record["state"], marked(record)) == ("failed", "worker-lost"), record
        assert "memory" in record["error"]["detail"]
        assert checks(stand)["reconstruction"] != "ok"
    next_is_right(stand)


def test_a_request_is_answered_beside_as_many_connections_as_descriptors(tmp_path: Path, desk: Desk) -> None:
    service = serve(tmp_path, desk, descriptors=2000)
    address = urlsplit(service.url)
    with ExitStack() as held:
        held.callback(service.kill)
        for _ in range(1900):
            held.enter_context(socket.create_connection((address.hostname, address.port), timeout=10))
        next_is_right(Stand(desk, service, held.enter_context(service.client())))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    place = tmp_path / "small"
    place.mkdir()
    mount, umount = shutil.which("mount"), shutil.which("umount")
    if mount is None or umount is None:
        pytest.skip("needs mount")
    made = subprocess.run([mount, "-t", "tmpfs", "-o", "size=64m", "tmpfs", place], check=False)  # noqa: S603
    if made.returncode:
        pytest.skip("this machine mounts nothing")
    try:
        yield place
    finally:
        subprocess.run([umount, "-l", place], check=True)  # noqa: S603


@pytest.mark.parametrize("left_bytes", [0, 400_000])
def test_a_scan_on_a_disk_that_is_full_ends_in_words(small_disk: Path, desk: Desk, left_bytes: int) -> None:
    service = serve(small_disk, desk)
    try:
        with service.client() as client:
            stand = Stand(desk, service, client)
            next_is_right(stand)
            filler = small_disk / "filler"
            free = shutil.disk_usage(small_disk).free
            filler.write_bytes(bytes(free - left_bytes))
            if left_bytes:
                record = scanned(client)
                assert (record["state"], marked(record)) == ("failed", "storage"), record
            else:
                with pytest.raises(ServiceError, match="free"):
                    scanned(client)
            filler.unlink()
            next_is_right(stand)
            assert half_written(service.data) == []
    finally:
        service.kill()
