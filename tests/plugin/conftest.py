"""Third-party packages, built and installed by pip into folders of their own."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

HERE = Path(__file__).parent
LEAST_SETUPTOOLS = 77

# Not ours to import: they are installed, and some of them fail on purpose.
collect_ignore_glob = ["*_package/*"]


def pip(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Have pip install something without what it requires."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    return subprocess.run([*command, *arguments], capture_output=True, text=True, check=False)  # noqa: S603


def pip_install(sources: Sequence[Path], work: Path) -> Path:
    """Build packages from copies of their sources and install them into a folder, offline; return that folder."""
    found = importlib.metadata.version("setuptools")
    if int(found.split(".")[0]) < LEAST_SETUPTOOLS:
        pytest.fail(
            f"asked setuptools {LEAST_SETUPTOOLS} to build packages with, found {found}: pip install -e '.[test]'"
        )
    # Building leaves folders beside the sources.
    copies = [str(shutil.copytree(source, work / "sources" / source.name)) for source in sources]
    target = work / "site"
    done = pip("--no-build-isolation", "--no-index", "--target", str(target), *copies)
    assert done.returncode == 0, done.stderr
    return target


def pip_fetch(requirement: str, work: Path) -> Path:
    """Install a package of an index into a folder, without what it requires; return that folder. Skips without one."""
    target = work / "fetched"
    done = pip("--only-binary=:all:", "--target", str(target), requirement)
    if done.returncode:
        pytest.skip(f"needs {requirement}, which pip could not get: {done.stderr.strip().splitlines()[-1]}")
    return target


def path_with(*sites: Path) -> str:
    known = os.environ.get("PYTHONPATH")
    return os.pathsep.join([*map(str, sites), *([known] if known else [])])


def slrig(
    *arguments: str, path: str, folder: Path, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run slrig as a process of its own, in a folder, with a PYTHONPATH and more of an environment."""
    return subprocess.run(  # noqa: S603 - our own command
        [sys.executable, "-m", "slrig.cli", *arguments],
        env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200", **(environment or {})},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


@pytest.fixture(scope="session")
def example_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the example camera and the projector that lights its chart are installed."""
    sources = [HERE / "example_package", HERE / "projector_package"]
    return pip_install(sources, tmp_path_factory.mktemp("examples"))


@pytest.fixture(scope="session")
def pylon_site(tmp_path_factory: pytest.TempPathFactory) -> str:
    """PYTHONPATH with the driver for Basler's SDK, that SDK, and a projector that lights its emulated camera."""
    work = tmp_path_factory.mktemp("pylon")
    sources = [HERE / name for name in ("pylon_package", "pylon_scene_package")]
    return path_with(pip_install(sources, work), pip_fetch("pypylon>=26.9", work))


@pytest.fixture(scope="session")
def broken_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the packages are installed that fail, each in its own way."""
    return pip_install([HERE / "broken_package", HERE / "faulty_package"], tmp_path_factory.mktemp("broken"))
