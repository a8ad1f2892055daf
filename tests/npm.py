"""Packages of the npm registry that tests run, fetched once into a cache."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NoReturn

import pytest

_FETCH_LIMIT_S = 40.0


def lacking(reason: str) -> NoReturn:
    """Skip a test that cannot have what it needs; fail it instead where CI=true, which installs what it needs."""
    if os.environ.get("CI") == "true":
        pytest.fail(reason)
    pytest.skip(reason)


def npm_package(package: str, purpose: str) -> Path:
    """The folder of `name@version`, from the cache (SLRIG_TEST_CACHE, or one in the folder of temporary files).

    purpose : what it is for, for whom it is missing. Skips without Node or the registry, and fails if CI=true.
    """
    if not shutil.which("node") or not shutil.which("npm"):
        lacking(f"needs Node 18 or newer with npm, {purpose}: apt install nodejs npm")
    name = package.rpartition("@")[0]
    cache = Path(os.environ.get("SLRIG_TEST_CACHE") or Path(tempfile.gettempdir()) / "slrig-test-npm")
    folder = cache / package.replace("/", "-")
    if not (folder / "node_modules" / name / "package.json").is_file():
        refusal = _fetched(package, folder)
        if refusal is not None:
            lacking(f"needs {package} from the npm registry, {purpose}; it could not be fetched: {refusal}")
    return folder / "node_modules" / name


@functools.cache
def _fetched(package: str, folder: Path) -> str | None:
    """Fetch the package, once however many tests ask; return why that cannot be done."""
    folder.mkdir(parents=True, exist_ok=True)
    command = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(folder), package]
    try:
        fetched = subprocess.run(  # noqa: S603 - a program of the system
            command, capture_output=True, text=True, check=False, timeout=_FETCH_LIMIT_S
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {_FETCH_LIMIT_S:g} s"
    return fetched.stderr[-300:] if fetched.returncode else None
