"""Fixtures that every test may use, and how a run of several processes begins."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog
from filelock import FileLock
from hypothesis import settings
from xdist.workermanage import WorkerController

from tests.postgres import Postgres

ROOT = Path(__file__).resolve().parents[1]

_OF_A_SHELL = ("NUMBA_", "SLRIG_", "XDG_")
_KEPT = {
    "SLRIG_SHARED", "SLRIG_GOLDEN", "SLRIG_FUZZ_FILES", "SLRIG_FUZZ_KILLS", "SLRIG_FUZZ_SEED", "SLRIG_ROS_PYTHON",
    "SLRIG_TEST_CACHE",
}  # fmt: skip
"""Variables for tests."""

NEED_KERNELS = (
    "tests/golden/", "tests/properties/", "tests/contract/", "tests/e2e/", "tests/unit/accept/",
    "tests/unit/calibrate/", "tests/unit/calibration/", "tests/unit/model_jobs/", "tests/unit/doctor/",
    "tests/unit/meshing/", "tests/unit/reconstruction/", "tests/unit/scan/", "tests/unit/simulated_rig/",
    "tests/unit/multiview/", "tests/unit/test_cli_calibrate.py", "tests/unit/test_cli_model.py",
    "tests/unit/test_cli_reconstruct.py", "tests/unit/test_colour_frames.py", "tests/unit/test_light_bound.py",
)  # fmt: skip
"""Tests that call compiled kernels. They run last, so that the kernels compile beside all others."""

_KERNELS_LOCK = pytest.StashKey[str]()

# Importing and rewriting all tests makes millions of objects that live to the end: looking for cycles among them, again
# and again, takes a third of the time.
gc.disable()

# The same draws every time, so that a run fails by the change it tests; --hypothesis-profile=default draws afresh.
settings.register_profile("repeatable", derandomize=True, deadline=None)  # other processes may take the time
settings.load_profile("repeatable")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option by which CI checks the indices of arrays in kernels."""
    parser.addoption(
        "--kernel-bounds",
        metavar="FOLDER",
        help="compile kernels that raise where they read or write past the end of an array, and keep them in FOLDER",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Take the variables of a person's shell away from tests and from what they start, before numba reads them."""
    for name in [name for name in os.environ if name.startswith(_OF_A_SHELL) and name not in _KEPT]:
        del os.environ[name]
    # What runs in the background or under nohup ignores these signals, and so would every process of a test.
    for number in (signal.SIGINT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)
    # Where processes outnumber cores, threads of OpenBLAS wait for one another by spinning.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if folder := config.getoption("kernel_bounds"):
        os.environ |= {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": folder}


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels of a scan beside the first tests of several processes, where none is compiled yet.

    Each process would compile them all for itself at the same time.
    """
    config = session.config
    several = config.getoption("numprocesses", None) and not hasattr(config, "workerinput")
    kept = Path(config.getoption("kernel_bounds") or ROOT / "slrig")
    if not several or config.option.collectonly or next(kept.rglob("*.nbc"), None) is not None:
        return
    folder = tempfile.TemporaryDirectory(prefix="kernels-")
    config.add_cleanup(folder.cleanup)
    lock = FileLock(Path(folder.name) / "compiling.lock", thread_local=False)
    lock.acquire()
    config.stash[_KERNELS_LOCK] = lock.lock_file
    # Tests of the command say why kernels cannot be compiled.
    process = subprocess.Popen(
        [sys.executable, "-m", "slrig.cli", "warm"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )

    def release() -> None:
        process.wait()
        lock.release()

    threading.Thread(target=release, name="kernels").start()
    config.add_cleanup(process.terminate)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: WorkerController) -> None:
    """Pass a process of tests the lock that is held while kernels compile."""
    node.workerinput["kernels_lock"] = node.config.stash.get(_KERNELS_LOCK, "")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Look for cycles among new objects only, and rarely, once all tests are imported."""
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(50_000, 20, 20)
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put tests that call kernels last."""
    items.sort(key=lambda item: item.nodeid.startswith(NEED_KERNELS))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Wait for the kernels before the first test that calls them."""
    workerinput: dict[str, str] = getattr(item.config, "workerinput", {})
    if item.nodeid.startswith(NEED_KERNELS) and (path := workerinput.pop("kernels_lock", "")):
        with FileLock(path):
            pass


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of sample data: SLRIG_SHARED, or `shared` beside the checkout. Skips where there is none."""
    folder = Path(os.environ.get("SLRIG_SHARED") or ROOT.parent / "shared")
    if not (folder / "bundles").is_dir():
        pytest.skip(f"no sample data in {folder}: set SLRIG_SHARED to its folder")
    return folder


@pytest.fixture(autouse=True)
def default_logging() -> Iterator[None]:
    """Reset the logs of this process after a command that a test ran has configured them."""
    yield
    structlog.reset_defaults()


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A running Postgres server. Skips where there is none, or no driver. A test that kills it starts its own."""
    with Postgres() as server:
        yield server
