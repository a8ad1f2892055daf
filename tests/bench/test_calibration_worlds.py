"""Whether a calibration's covariance holds in worlds that are not as its model has them. Prints a table.

    pytest -m slow tests/bench/test_calibration_worlds.py -s

Each world is rendered SLRIG_SEEDS (3) times, with another lens, noise and set of poses, and read and solved as a live
rig's poses are. χ² is that of all numbers of camera and projector against the truth, by the whole covariance that the
solve states; the board has the size that it is said to have. About a minute of processor time a row.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slrig.calibration.board import Board, BoardKind
from slrig.calibration.solution import Solution
from slrig.calibration.solving.parameters import difference
from slrig.model import Calibration
from tests.bench.test_calibration_seeds import BOARD, rig_options, solved
from tests.golden.test_image_processing import processed
from tests.unit.calibration.solving.against_truth import exact_covariance, rows_of

SEEDS = int(os.environ.get("SLRIG_SEEDS") or 3)
WITHIN = (0.6, 1.4)
CHARUCO = Board(BoardKind.CHARUCO, 6, 4, 26.0, marker_mm=20.0, dictionary="DICT_4X4_50")


def shaded(bundle: Path) -> None:
    """The left third of the camera's image is dark: something stands before the board."""
    for path in sorted((bundle / "frames").rglob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        image[:, : image.shape[1] // 3] //= 40
        assert cv2.imwrite(str(path), image)


@dataclass(frozen=True)
class World:
    """head, camera : options in place of the usual; poses : how many; more : of the board's table in the scene."""

    poses: int = 10
    head: dict[str, Any] = field(default_factory=dict)
    camera: dict[str, Any] = field(default_factory=dict)
    board: Board = BOARD
    more: str = ""
    spoil: Callable[[Path], None] = lambda _bundle: None


WORLDS = {
    "plain, 10 poses": World(),
    "7 poses": World(poses=7),
    "5 poses": World(poses=5),
    "bowed by 1 mm": World(more="bow_mm = 1.0"),
    "blur of 1.5 px": World(camera={"blur_px": 1.5}),
    "gamma 2.2, JPEG 80": World(spoil=lambda bundle: processed(bundle, gamma=2.2, quality=80)),
    "lamp of 8 %, rolling shutter": World(
        head={"ambient": 0.1, "ambient_flicker_depth": 0.08}, camera={"line_time_s": 3e-5}
    ),
    "k1 of -0.3": World(camera={"distortion": [-0.3, 0.12, 0.0003, -0.0003, 0.0]}),
    "ChArUco": World(board=CHARUCO),
    "ChArUco partly in view": World(board=CHARUCO, spoil=shaded),
}


def chi_square(solution: Solution, truth: Calibration) -> tuple[float, int]:
    """χ² of all numbers that are free, and how many."""
    off = difference(rows_of(solution.calibration), rows_of(truth)).ravel()
    covariance = exact_covariance(solution)
    free = np.diagonal(covariance) > 0
    sigma = np.sqrt(np.diagonal(covariance)[free])
    correlation = covariance[np.ix_(free, free)] / np.outer(sigma, sigma)
    z = off[free] / sigma
    return float(z @ np.linalg.solve(correlation, z)), int(free.sum())


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_a_covariance_holds(name: str, tmp_path: Path) -> None:
    world = WORLDS[name]
    squares, numbers, rms, lost = [], 0, [], 0
    for seed in range(1, SEEDS + 1):
        options = rig_options(100 + seed) | world.head
        options["camera"][0] |= world.camera
        options["poses"] |= {"count": world.poses}
        solution, truth, refused = solved(
            options, tmp_path / str(seed), board=world.board, more=world.more, spoil=world.spoil
        )
        square, numbers = chi_square(solution, truth)
        squares.append(square / numbers)
        rms.append(max(each.rms_px for each in solution.residuals.values()))
        lost += len(refused) + len(solution.outliers)
    sys.stdout.write(
        f"\n{name:30} χ²/{numbers} {np.mean(squares):.2f} ({', '.join(f'{each:.2f}' for each in squares)}), "
        f"rms {max(rms):.3f} px, {lost} of {SEEDS * world.poses} poses lost\n"
    )
    # The mean of so many squares of normal deviates scatters by itself.
    scatter = float(np.sqrt(2 / (numbers * SEEDS)))
    assert WITHIN[0] - 2 * scatter <= np.mean(squares) <= WITHIN[1] + 2 * scatter
