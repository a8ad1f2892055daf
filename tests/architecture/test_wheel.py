"""The wheel holds what the code loads: modules and the files beside them."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("slrig", "drivers", "simulated_rig")


def test_every_module_and_template_is_in_the_wheel(tmp_path: Path) -> None:
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, tmp_path)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    built = subprocess.run(
        [sys.executable, "-c", "from setuptools.build_meta import build_wheel; build_wheel('.')"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    held = set(ZipFile(wheel).namelist())
    needed = [path for package in PACKAGES for path in (ROOT / package).rglob("*.*")]
    names = [
        path.relative_to(ROOT).as_posix() for path in needed if path.suffix in {".py", ".html", ".css", ".js", ".svg"}
    ]
    assert "slrig/reports/templates/report.html" in names
    assert [name for name in names if name not in held] == []
