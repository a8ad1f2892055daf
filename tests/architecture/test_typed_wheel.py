"""An installed wheel: its types reach the type checker of another project."""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from zipfile import ZipFile

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
from slrig.client import Client
from slrig.devices import Camera

result = Client().scan(label="cup", exposure_s=0.01)
reveal_type(result.points_mm)
reveal_type(result.causes)
Client().scan(exposure="bright")
Client().scans.get(7)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout, built in a copy."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, folder)
    for package in ("slrig", "drivers", "simulated_rig"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    build = [sys.executable, "-c", "from setuptools.build_meta import build_wheel; build_wheel('.')"]
    built = subprocess.run(build, cwd=folder, capture_output=True, text=True, timeout=300, check=False)  # noqa: S603
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("*.whl")
    return path


def test_a_scan_is_typed_in_another_project(wheel: Path, tmp_path: Path) -> None:
    pytest.importorskip("mypy", reason="needs mypy: pip install -e '.[lint]'")
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)  # noqa: S603
    site = next(environment.glob("lib/python*/site-packages"))
    ZipFile(wheel).extractall(site)
    # numpy and httpx2 come from where the tests run.
    (site / "others.pth").write_text(sysconfig.get_paths()["purelib"])
    (tmp_path / "program.py").write_text(PROGRAM)
    checked = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "mypy", "--strict", "--python-executable", environment / "bin" / "python", "program.py"],
        cwd=tmp_path,
        env={"PATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = checked.stdout.splitlines()
    revealed = [line for line in lines if "Revealed type" in line]
    assert "ndarray" in revealed[0], checked.stdout
    assert "float" in revealed[0]
    assert "tuple[" in revealed[1]
    faults = [line for line in lines if "error:" in line]
    assert len(faults) == 2, checked.stdout
    assert 'Unexpected keyword argument "exposure"' in faults[0]
    assert 'expected "str"' in faults[1]
