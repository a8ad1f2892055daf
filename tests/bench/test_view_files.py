"""What the files for pages cost: processor seconds, bytes and memory. `pytest tests/bench/test_view_files.py -s`.

A mesh of 1.68 million triangles, from the mesh.ply that the service reads to the bytes that it sends. Memory is what
was allocated at most, besides mesh.ply.
"""

from __future__ import annotations

import gzip
import sys
import time
import tracemalloc
from collections.abc import Callable
from functools import partial

import pytest

from slrig.model import Mesh
from slrig.scan.artefacts import decode_mesh_ply, encode_mesh_ply
from slrig.scan.mesh_formats import encode_mesh_glb
from slrig.scan.view_format import encode_coarse_glb, encode_view_glb
from tests.unit.scan.test_view_format import sheet

_RUNS = 5
_MOST_CPU_S = 0.5
_MOST_MB = 250

_ENCODERS: dict[str, Callable[[Mesh], bytes]] = {
    "mesh.glb": encode_mesh_glb,
    "view.glb": encode_view_glb,
    "coarse.glb": encode_coarse_glb,
}


def _least_cpu_s(work: Callable[[], object]) -> float:
    times = []
    for _ in range(_RUNS):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)


@pytest.fixture(scope="module")
def ply() -> bytes:
    return bytes(encode_mesh_ply(sheet(917, 918)))


def test_files_for_pages(ply: bytes) -> None:
    mesh = decode_mesh_ply(ply)
    assert len(mesh.faces) > 1_670_000
    reading_s = _least_cpu_s(partial(decode_mesh_ply, ply))
    sys.stdout.write(f"\nmesh.ply {len(ply) / 1e6:.1f} MB, read in {reading_s:.2f} s; least of {_RUNS} runs\n")
    for name, encode in _ENCODERS.items():
        data = encode(mesh)
        cpu_s = _least_cpu_s(partial(encode, mesh))
        tracemalloc.start()
        encode(decode_mesh_ply(ply))
        peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        packed = gzip.compress(data, 1)
        packing_s = _least_cpu_s(partial(gzip.compress, data, 1))
        sys.stdout.write(
            f"{name:10} {cpu_s:.2f} s CPU, {len(data) / 1e6:5.1f} MB, peak {peak_mb:3.0f} MB; "
            f"gzip -1: {packing_s:.2f} s, {len(packed) / 1e6:.1f} MB\n"
        )
        assert cpu_s <= _MOST_CPU_S, name
        assert peak_mb <= _MOST_MB, name
