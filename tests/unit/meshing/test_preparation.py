"""The kernels that make a mesh, compiled beside the others: all of them, for the arrays that a scan has."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from slrig.kernels import _kernels
from slrig.meshing import preparation

_LATER = "slrig.meshing.rasteriser"
"""Of pictures."""
_SIGNATURES = """
from {module} import {name}
from tests.unit.meshing.test_preparation import compiled
{name}({given})
print("\\n".join(sorted(compiled())))
"""


def compiled() -> set[str]:
    """Each kernel of the meshing that is loaded in this process, with the types that it is compiled for."""
    return {
        f"{each.py_func.__module__}.{each.py_func.__qualname__}{types}"
        for each, _ in _kernels
        if each.py_func.__module__.startswith("slrig.meshing.") and each.py_func.__module__ != _LATER
        for types in each.signatures
    }


def _compiled_by(module: str, name: str, given: str = "") -> set[str]:
    code = _SIGNATURES.format(module=module, name=name, given=given)
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)  # noqa: S603 - ours
    return set(found.stdout.splitlines())


@pytest.mark.slow
def test_it_compiles_what_a_scan_needs() -> None:
    beside = _compiled_by("slrig.meshing.preparation", "mesh_sample")
    needed = _compiled_by("slrig.scan.reconstruct", "warm_kernels", "lambda _: None")
    assert len(beside) > 20
    assert needed - beside == set()


@pytest.mark.slow
def test_it_ends_in_peace_while_its_input_is_open() -> None:
    command = [sys.executable, "-m", preparation.__name__]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:  # noqa: S603 - our own
        assert process.wait(300) == 0
        assert process.stderr is not None
        assert process.stderr.read() == b""


@pytest.mark.slow
def test_it_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    process = subprocess.Popen(  # noqa: S603 - our own command
        [sys.executable, "-m", preparation.__name__],
        stdin=subprocess.PIPE,
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
    )
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(60) == 1
