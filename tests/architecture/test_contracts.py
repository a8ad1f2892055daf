"""import-linter notices a change that breaks the dependency rule. CI's own lint step checks the sources as they are."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_broken_contracts_are_noticed(tmp_path: Path) -> None:
    ignored = shutil.ignore_patterns("__pycache__", "*.nbc", "*.nbi")
    for package in ("slrig", "drivers", "simulated_rig"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=ignored, copy_function=os.symlink)
    for name, line in (("bundle/storage.py", "import slrig.discovery"), ("patterns/codes.py", "import pydantic")):
        spoilt = tmp_path / "slrig" / name
        text = spoilt.read_text()
        spoilt.unlink()
        spoilt.write_text(f"{text}\n{line}\n")
    (tmp_path / "slrig" / "helpers.py").write_text('"""A room that is not in the plan."""\n')
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    # What `lint-imports` starts. PYTHONPATH hides an installed slrig.
    command = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    result = subprocess.run(  # noqa: S603 - our own interpreter and a fixed command
        [sys.executable, "-c", command, "--no-cache"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path), "PATH": "", "PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert result.returncode == 1, result.stdout + result.stderr
    assert "slrig.bundle is not allowed to import slrig.discovery" in result.stdout
    assert "slrig.patterns is not allowed to import pydantic" in result.stdout
    assert "slrig.helpers" in result.stdout


ROOMS = (
    "bundle", "calibration", "capture", "conformance", "devices", "doctor", "importers", "meshing", "model",
    "multiview", "patterns", "reconstruction",
)  # fmt: skip
"""Rooms whose `__init__` exports all that others import from them."""

PUBLIC_MODULES = {
    # These load OpenCV or compiled kernels, which code that only names boards and calibrations must not.
    *(f"slrig.calibration.{name}" for name in ("accuracy", "hand_eye", "judgement", "printing")),
    *(f"slrig.calibration.{name}" for name in ("detection", "health", "health.drift", "health.verification")),
    *(f"slrig.calibration.{name}" for name in ("poses", "solving")),
    # These drive a rig, which a reconstruction of recorded frames has not.
    *(f"slrig.capture.{name}" for name in ("latency", "pulses", "sequencer", "streaming", "triggering")),
    # The rendered rig must not import slrig's lens: a contract names these two modules.
    "slrig.model.lens", "slrig.model.lens_kernels",
}  # fmt: skip
"""Modules of these rooms that others import directly."""


IMPORT = re.compile(rf"^ *from (slrig\.({'|'.join(ROOMS)})\.[\w.]+) import", re.MULTILINE)


def test_other_rooms_import_what_a_room_exports() -> None:
    sources = [each for name in ("slrig", "drivers", "simulated_rig") for each in (ROOT / name).rglob("*.py")]
    bypassing = {
        f"{path.relative_to(ROOT)}: {found[0]}"
        for path in sources
        for found in IMPORT.finditer(path.read_text(encoding="utf-8"))
        if ROOT / "slrig" / found[2] not in path.parents and found[1] not in PUBLIC_MODULES
    }
    assert bypassing == set()


@pytest.mark.slow
def test_the_service_loads_no_mathematics() -> None:
    """A package that exports mathematics is imported by the worker and by commands that compute, not by the service."""
    heavy = ("numba", "scipy.optimize", "scipy.spatial")
    code = f"import sys, slrig.api.app, slrig.api.server; print(*[m for m in {heavy} if m in sys.modules])"
    found = subprocess.run(  # noqa: S603 - our own interpreter and code
        [sys.executable, "-c", code],
        cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    assert found.stdout.split() == []
