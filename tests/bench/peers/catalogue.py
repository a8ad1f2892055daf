"""The methods that are compared: what each starts from, which library it needs, and how it is run."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from slrig.model import Surface
from tests.bench.peers.gray import Decoder, columns_by_arrays, columns_by_opencv, gray_mesh
from tests.bench.peers.measuring import Meter, Phase
from tests.bench.peers.meshers import ball_pivoting, image_delaunay, poisson
from tests.bench.peers.ours import copied_without_truth, read_mesh, reconstruct
from tests.bench.peers.scene import Cloud, read_cloud, read_gray_frames

Run = Callable[[Meter], Surface]


@dataclass(frozen=True, slots=True)
class Inputs:
    """Where a method finds its input and may write: a bundle, our points of it, an empty folder."""

    bundle: Path
    points_file: Path
    scratch: Path


@dataclass(frozen=True, slots=True)
class Method:
    """One row of the table. `from_frames`: it makes its own points; otherwise it is given ours.

    `compiles`: its first run may compile kernels.
    `prepare` reads the input and imports what is needed; what it returns is what is measured.
    """

    title: str
    from_frames: bool
    prepare: Callable[[Inputs], Run]
    compiles: bool = False


def _ours(inputs: Inputs) -> Run:
    bundle = copied_without_truth(inputs.bundle, inputs.scratch / "bundle")
    output = inputs.scratch / "output"

    def run(meter: Meter) -> Surface:
        reconstruct(bundle, output, meter)
        meter.enter(Phase.FILES)
        return read_mesh(output)

    return run


def _gray(inputs: Inputs, *, decoder: Decoder) -> Run:
    return partial(gray_mesh, read_gray_frames(inputs.bundle), decoder=decoder)


def _of_cloud(inputs: Inputs, *, mesher: Callable[[Cloud, Meter], Surface], library: str) -> Run:
    importlib.import_module(library)
    return partial(mesher, read_cloud(inputs.bundle, inputs.points_file))


OURS = "ours"

METHODS: dict[str, Method] = {
    OURS: Method("slrig", from_frames=True, prepare=_ours, compiles=True),
    "gray_opencv": Method(
        "Gray per pixel (OpenCV getProjPixel) + grid",
        from_frames=True,
        prepare=partial(_gray, decoder=columns_by_opencv),
    ),
    "gray_arrays": Method(
        "Gray per pixel (same rule, arrays) + grid",
        from_frames=True,
        prepare=partial(_gray, decoder=columns_by_arrays),
    ),
    "image_delaunay": Method(
        "our points + image Delaunay (scipy)",
        from_frames=False,
        prepare=partial(_of_cloud, mesher=image_delaunay, library="scipy.spatial"),
    ),
    "ball_pivoting": Method(
        "our points + ball pivoting (Open3D)",
        from_frames=False,
        prepare=partial(_of_cloud, mesher=ball_pivoting, library="open3d"),
    ),
    "poisson": Method(
        "our points + Poisson, depth 9 (Open3D)",
        from_frames=False,
        prepare=partial(_of_cloud, mesher=poisson, library="open3d"),
    ),
}
