"""Fixtures that every test may use."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
import structlog
from _pytest.doctest import DoctestModule
from hypothesis import settings
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling
from xdist.workermanage import WorkerController

from tests.postgres import Postgres

# Before numpy is loaded, here and in what tests start: where processes outnumber cores, threads of OpenBLAS wait for
# one another by spinning, and small matrices take four times the processor time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The same draws every time, so that a run fails by the change it tests; --hypothesis-profile=default draws afresh.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")

# GigE Vision has one port, and a camera on loopback answers whoever asks there.
_ONE_AT_A_TIME = {
    "gige-vision": ("tests/unit/drivers/genicam/", "tests/contract/test_contract.py"),
}


# One file is run by one process, so the longest of a run comes before all others.
_LONGEST = ("tests/e2e/test_readme_commands.py", "tests/contract/test_vivid.py")


class ByFile(LoadScopeScheduling):  # type: ignore[misc] # xdist is untyped
    """Has several processes share the tests by file: what a file sets up once is set up once.

    A test that kills its process fails once, and a new process runs the rest. xdist 3.8 by itself waits for ever: it
    hands the new one files that are finished, or a single test where a process begins when it has two (its issues 1323
    and 1327); and it hands on the test that killed.
    """

    def _split_scope(self, nodeid: str) -> str:
        path = nodeid.partition("::")[0]
        return next((name for name, paths in _ONE_AT_A_TIME.items() if path.startswith(paths)), path)

    def remove_node(self, node: WorkerController) -> str | None:
        """Take back what a process leaves undone; return the test it ended in, None where all is done."""
        left = {
            scope: undone
            for scope, tests in self.assigned_work.pop(node).items()
            if (undone := {test: done for test, done in tests.items() if not done})
        }
        if not left:
            return None
        scope = next(iter(left))
        test: str = next(iter(left[scope]))
        del left[scope][test]
        self.workqueue.update({scope: tests for scope, tests in left.items() if tests})
        for other in self.nodes:
            self._reschedule(other)
        return test

    def schedule(self) -> None:
        """Hand out tests; at least two to each process, or word that these are the last."""
        super().schedule()
        for node in self.nodes:
            self._reschedule(node)


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Before several processes share the tests, compile the kernels of a scan, where nothing is compiled yet.

    Each process, and the first service that each starts, would compile them all for itself at the same time.
    """
    config = session.config
    shared_out = config.getoption("numprocesses", None) and not hasattr(config, "workerinput")
    kept = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).resolve().parents[1] / "slrig")
    if shared_out and not config.option.collectonly and next(kept.rglob("*.nbc"), None) is None:
        # What cannot be compiled is told by the tests of it.
        subprocess.run([sys.executable, "-m", "slrig.cli", "warm"], stdout=subprocess.DEVNULL, check=False)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> ByFile:
    """How `-n` shares the tests out: in the order of collection."""
    config.option.loadscopereorder = False
    return ByFile(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_collect_file(file_path: Path) -> Generator[None, list[pytest.Collector], list[pytest.Collector]]:
    """Look for examples in no test's file that has none: every name in it would be looked at, a sixth of collecting."""
    found = yield
    if any(isinstance(each, DoctestModule) for each in found) and ">>>" not in file_path.read_text(encoding="utf-8"):
        return [each for each in found if not isinstance(each, DoctestModule)]
    return found


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files of few tests that take minutes come first: begun last, they would keep one process busy, and no other."""
    items.sort(key=lambda item: (not item.nodeid.startswith(_LONGEST), not item.nodeid.startswith("tests/e2e/")))


def pytest_collection_finish() -> None:
    """Take what is loaded by now out of the collector's rounds, which took one second in twenty-five."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of sample data: SLRIG_SHARED, or `shared` beside the checkout. Skips where there is none."""
    folder = Path(os.environ.get("SLRIG_SHARED") or Path(__file__).resolve().parents[2] / "shared")
    if not (folder / "bundles").is_dir():
        pytest.skip(f"no sample data in {folder}: set SLRIG_SHARED to its folder")
    return folder


@pytest.fixture(autouse=True)
def logs_as_they_come() -> Iterator[None]:
    """A command that a test runs sets up the logs of the whole process: afterwards they are as they were."""
    yield
    structlog.reset_defaults()


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A Postgres server that runs. Skips where there is none, or no driver. Who kills it makes one of their own."""
    with Postgres() as server:
        yield server
