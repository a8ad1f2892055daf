"""Scans of rendered rigs that several files compare with the truth, made once for all of them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from filelock import FileLock

from slrig.examples import EXAMPLES

RIGS = EXAMPLES / "rigs"


class Scan(NamedTuple):
    """A rendered bundle with its truth, the folder of what was reconstructed from it, and the report."""

    bundle: Path
    folder: Path
    report: Any


@pytest.fixture(scope="session")
def scan_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Scan]:
    """The scan of an example rig, by its name. Processes that share out the tests share the scans, too."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent

    # Not above: the process that hands out tests loads this file first, and needs no mathematics.
    from slrig.config import read_rig
    from slrig.discovery import open_rig
    from slrig.scan.acquisition import capture_frames
    from slrig.scan.plan import ScanPlan
    from tests.golden.test_bundles import reconstructed

    def made(name: str) -> Scan:
        folder = root / f"golden-{name}"
        bundle, output = folder / "bundle", folder / "out"
        with FileLock(root / f"golden-{name}.lock"):
            if not (output / "report.json").exists():
                with open_rig(read_rig(RIGS / f"{name}.toml")) as rig:
                    taken = capture_frames(rig, ScanPlan(), bundle)
                    taken.finish()
                reconstructed(bundle, output)
        return Scan(bundle, output, json.loads((output / "report.json").read_text()))

    return made
