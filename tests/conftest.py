"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of sample data: SLRIG_SHARED, or `shared` beside the checkout. Skips where there is none."""
    folder = Path(os.environ.get("SLRIG_SHARED") or Path(__file__).resolve().parents[2] / "shared")
    if not (folder / "bundles").is_dir():
        pytest.skip(f"no sample data in {folder}: set SLRIG_SHARED to its folder")
    return folder
