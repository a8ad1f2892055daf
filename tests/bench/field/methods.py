"""The methods: `python methods.py BUNDLE METHOD AXIS MASK.npy OUT.npz` runs one twice, and times the second.

All but slrig are what most programs do: each pixel decides alone. They need NumPy and OpenCV only, so that an
environment with OpenCV's contributed modules can run them.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Frames = NDArray[np.uint8]  # (patterns, pixels)
Patterns = Sequence[Mapping[str, Any]]  # as bundle.json describes them

LEAST_DIFFERENCE = 5  # grey levels between a pattern and its inverse: what OpenCV asks for
AXES = ["column", "row"]
LACKS_MODULE = 3  # exit status, where OpenCV has no `structured_light`
_ROUNDS = 4  # of the place on the other axis, on which the projector's lens bends a sheet of light
_CHUNK = 8192  # pixels that are compared with all positions at once


def gray_positions(frames: Frames, patterns: Patterns, axis: str) -> Floats:
    """Middle of each pixel's code cell, projector px; NaN where a bit is not clear.

    A bit is bright against its inverse, or against the mean of white and black where it has none.
    """
    light = frames.astype(np.float64)
    code = {
        (p["bit"], p["inverted"]): i for i, p in enumerate(patterns) if (p["kind"], p.get("axis")) == ("gray", axis)
    }
    references = sum(light[i] for i, p in enumerate(patterns) if p["kind"] in ("white", "black"))
    number = np.zeros(frames.shape[1], dtype=np.int64)
    clear, binary = np.ones(frames.shape[1], dtype=bool), np.zeros(frames.shape[1], dtype=bool)
    for bit in sorted({bit for bit, _ in code}):
        direct = light[code[bit, False]]
        inverse = light[code[bit, True]] if (bit, True) in code else references - direct
        clear &= np.abs(direct - inverse) >= LEAST_DIFFERENCE
        binary ^= direct > inverse
        number = 2 * number + binary
    one = patterns[code[0, False]]
    return np.where(clear, (number + 0.5) * one["cell_px"] - one["offset_px"] - 0.5, np.nan)


def opencv_positions(frames: Frames, patterns: Patterns, axis: str, mask: NDArray[Any]) -> Floats:
    """The same by OpenCV's `GrayCodePattern`, which reads columns and rows together, with their inverses."""
    code = [i for i, p in enumerate(patterns) if p["kind"] == "gray"]
    code.sort(key=lambda i: (patterns[i]["axis"], patterns[i]["bit"], patterns[i]["inverted"]))
    size = [2 ** (sum(patterns[i]["axis"] == each for i in code) // 2) for each in AXES]
    decoder: Any = getattr(cv2, "structured_light").GrayCodePattern.create(*size)  # noqa: B009 - often not there
    decoder.setWhiteThreshold(LEAST_DIFFERENCE)
    images = np.zeros((len(code), *mask.shape), dtype=np.uint8)
    images[:, mask] = frames[code]
    position = np.full(frames.shape[1], np.nan)
    for place, (row, column) in enumerate(np.argwhere(mask).tolist()):
        failed, found = decoder.getProjPixel(list(images), column, row)
        if not failed:
            position[place] = found[AXES.index(axis)]
    return position


def phase_positions(frames: Frames, patterns: Patterns, axis: str, extent_px: int) -> Floats:
    """Position by the phase of the finest period that has several steps, projector px.

    Which of its periods it is tells a sinusoid of the projector's extent; where there is none, as in micro phase shift,
    the column whose light over all frames is most like the pixel's.
    """
    sines = [i for i, p in enumerate(patterns) if p["kind"] == "sine" and p["axis"] == axis]
    periods = [patterns[i]["period_px"] for i in sines]
    stepped = sorted({period for period in periods if periods.count(period) > 1})
    fine, coarse = stepped[0], stepped[-1]
    turns = np.array([patterns[i]["shift"] / patterns[i]["steps"] for i in sines])
    light = frames[sines].astype(np.float64)
    phasors = {period: np.exp(2j * np.pi * turns) * (np.array(periods) == period) @ light for period in stepped}
    part = np.angle(phasors[fine]) / (2 * np.pi) * fine
    if coarse > fine:
        rough = np.angle(phasors[coarse]) / (2 * np.pi) % 1 * coarse
    else:
        steps = periods.count(fine)
        level = light[[period == fine for period in periods]].mean(axis=0)
        seen = (light - level) / np.maximum(np.abs(phasors[fine]) * 2 / steps, 1e-6)
        shown = np.cos(2 * np.pi * (np.arange(extent_px) / np.array(periods)[:, None] - turns[:, None]))
        rough = np.concatenate([
            np.argmin((shown**2).sum(axis=0) - 2 * seen[:, start : start + _CHUNK].T @ shown, axis=1)
            for start in range(0, seen.shape[1], _CHUNK)
        ])  # fmt: skip
    return np.asarray(part + fine * np.rint((rough - part) / fine))


def triangulate(
    pixels: Floats, position: Floats, axis: str, camera: Mapping[str, Any], projector: Mapping[str, Any]
) -> Floats:
    """(n, 3) mm in the camera's axes: where each pixel's ray meets the sheet of light of its position."""
    (k, d), (kp, dp) = ((np.array(each["matrix"]), np.array(each["distortion"])) for each in (camera, projector))
    turn, shift = np.array(projector["rotation"]), np.array(projector["translation_mm"])
    ray = np.c_[cv2.undistortPoints(pixels[:, None], k, d)[:, 0], np.ones(len(pixels))]
    along = ray @ turn.T
    this = AXES.index(axis)
    light = np.full((len(pixels), 2), kp[1 - this, 2])
    light[:, this] = position
    for _ in range(_ROUNDS):
        sheet = cv2.undistortPoints(light[:, None], kp, dp)[:, 0, this]
        depth = (sheet * shift[2] - shift[this]) / (along[:, this] - sheet * along[:, 2])
        seen = cv2.projectPoints(along * depth[:, None] + shift, np.zeros(3), np.zeros(3), kp, dp)[0][:, 0]
        light[:, 1 - this] = np.clip(seen[:, 1 - this], 0, projector["size_px"][1 - this])
    return np.asarray(ray * depth[:, None], dtype=np.float64)


def measure(bundle: Path, method: str, axis: str, mask: NDArray[Any]) -> dict[str, Floats]:
    """Points of a bundle's only camera at the pixels of the mask, by `gray`, `opencv` or `phase`."""
    description = json.loads((bundle / "bundle.json").read_text())
    calibration = json.loads((bundle / "calibration.json").read_text())
    patterns = description["patterns"]
    files = sorted((each["pattern"], each["file"]) for each in description["frames"])
    frames = np.array([np.asarray(cv2.imread(str(bundle / file), cv2.IMREAD_GRAYSCALE))[mask] for _, file in files])
    if method == "gray":
        position = gray_positions(frames, patterns, axis)
    elif method == "opencv":
        position = opencv_positions(frames, patterns, axis, mask)
    else:
        position = phase_positions(frames, patterns, axis, description["projector"]["size_px"][AXES.index(axis)])
    (camera,) = calibration["cameras"].values()
    good = np.isfinite(position)
    pixels = np.argwhere(mask)[good][:, ::-1].astype(np.float64)
    return {"points": triangulate(pixels, position[good], axis, camera, calibration["projector"])}


def measure_by_slrig(bundle: Path) -> dict[str, Floats]:
    """Vertices of the mesh of `slrig reconstruct`, with their σ, mm. It writes all its files."""
    import trimesh

    from slrig.scan.plan import ReconstructionPlan
    from slrig.scan.reconstruct import reconstruct_bundle

    with TemporaryDirectory() as folder:
        reconstruct_bundle(bundle, Path(folder, "mesh"), plan=ReconstructionPlan())
        mesh: Any = trimesh.load(Path(folder, "mesh", "mesh.ply"), process=False)
    sigma_mm = np.asarray(mesh.metadata["_ply_raw"]["vertex"]["data"]["sigma_mm"], dtype=np.float64)
    return {"points": mesh.vertices * (1.0, -1.0, -1.0), "sigma_mm": sigma_mm.ravel()}  # from axes for viewers


if __name__ == "__main__":
    place, name, crossing, asked, output = sys.argv[1:]
    if name == "opencv" and not hasattr(cv2, "structured_light"):
        sys.exit(LACKS_MODULE)
    for _ in range(2):  # the first compiles
        began, mask = time.process_time(), np.load(asked)
        found = measure_by_slrig(Path(place)) if name == "slrig" else measure(Path(place), name, crossing, mask)
        seconds = time.process_time() - began
    np.savez(output, allow_pickle=False, cpu_s=np.array(seconds), **found)
