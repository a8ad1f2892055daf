"""What the bytes of a result depend on beside its input: the code, the libraries, and the kind of machine."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path

_LIBRARIES = ("slrig", "numpy", "numba", "llvmlite", "scipy", "opencv-python-headless")
_PACKAGE = Path(__file__).resolve().parent.parent


@cache
def versions() -> Mapping[str, str]:
    """By name: of slrig and the libraries that it computes with, `code`, a hash of slrig's own files, which tells two
    states of one version apart, and `machine`, the kind of processor. Where all are equal, so are the bytes of a mesh.
    """
    code = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        code.update(path.relative_to(_PACKAGE).as_posix().encode())
        code.update(path.read_bytes())
    found = {name: version(name) for name in _LIBRARIES}
    return {**found, "code": code.hexdigest()[:16], "machine": platform.machine()}


def computed(where: Mapping[str, str]) -> dict[str, object]:
    """The section `computed` of a report: `Task.where`, the machine's name, and `versions`."""
    return {**where, "host": platform.node(), "versions": dict(versions())}
