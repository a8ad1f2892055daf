"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

# GigE Vision has one port, and a camera on loopback answers whoever asks there.
_ONE_AT_A_TIME = {
    "gige-vision": ("tests/unit/drivers/genicam/", "tests/contract/test_contract.py"),
}


class ByFile(LoadScopeScheduling):  # type: ignore[misc] # xdist is untyped
    """Has several processes share the tests by file: what a file sets up once is set up once."""

    def _split_scope(self, nodeid: str) -> str:
        path = nodeid.partition("::")[0]
        return next((name for name, paths in _ONE_AT_A_TIME.items() if path.startswith(paths)), path)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> ByFile:
    """How `-n` shares the tests out."""
    return ByFile(config, log)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of sample data: SLRIG_SHARED, or `shared` beside the checkout. Skips where there is none."""
    folder = Path(os.environ.get("SLRIG_SHARED") or Path(__file__).resolve().parents[2] / "shared")
    if not (folder / "bundles").is_dir():
        pytest.skip(f"no sample data in {folder}: set SLRIG_SHARED to its folder")
    return folder
