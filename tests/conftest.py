"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# GigE Vision has one port, and a camera on loopback answers whoever asks there.
_ONE_AT_A_TIME = {
    "gige-vision": ("tests/unit/drivers/genicam/", "tests/contract/test_contract.py", "tests/contract/test_pairing.py"),
}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Have several processes share the tests by file, so that what a file sets up once is set up once.

    First of all such hooks, since xdist reads the groups in its own.
    """
    for item in items:
        path = item.nodeid.partition("::")[0]
        group = next((name for name, paths in _ONE_AT_A_TIME.items() if path.startswith(paths)), path)
        item.add_marker(pytest.mark.xdist_group(group))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of sample data: SLRIG_SHARED, or `shared` beside the checkout. Skips where there is none."""
    folder = Path(os.environ.get("SLRIG_SHARED") or Path(__file__).resolve().parents[2] / "shared")
    if not (folder / "bundles").is_dir():
        pytest.skip(f"no sample data in {folder}: set SLRIG_SHARED to its folder")
    return folder
