"""Registration of eight views against what people use today: small_gicp, one view after the other, from the same start.

    pip install '.[test,bench]'
    pytest tests/bench/test_registration.py -s

MIT, https://github.com/koide3/small_gicp. A chain of pairs is what it offers for several views.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Sequence
from types import ModuleType

import numpy as np
import pytest

from slrig.model import FloatArray, Mesh
from slrig.views.matching import side_of
from slrig.views.registration import registered
from tests.turned_views import Turned, bumpy, displacement_mm, seen, wrong_axis

ANGLES = [45.0 * number for number in range(8)]
KINDS = ("ICP", "PLANE_ICP", "GICP")
_REACHES_MM = (3.0, 0.5)


def small_gicp() -> ModuleType:
    """The peer. Skips where it is not installed."""
    try:
        return importlib.import_module("small_gicp")
    except ImportError as missing:
        pytest.skip(f"small_gicp is not installed ({missing}): pip install small_gicp")


def chained(peer: ModuleType, kind: str, views: Sequence[Mesh], starts: Sequence[FloatArray]) -> list[FloatArray]:
    """Poses by aligning each view with the one before, first from afar and then near, without its boundary."""
    points = [side.points_mm[side.usable] for side in map(side_of, views)]
    poses = [np.eye(4)]
    for k in range(1, len(views)):
        step = np.linalg.inv(starts[k - 1]) @ starts[k]
        for reach_mm in _REACHES_MM:
            step = peer.align(
                points[k - 1], points[k], init_T_target_source=step, registration_type=kind,
                downsampling_resolution=0.7, max_correspondence_distance=reach_mm, max_iterations=60,
            ).T_target_source  # fmt: skip
        poses.append(poses[-1] @ step)
    return poses


def worst_mm(turned: Turned, views: Sequence[Mesh], poses: Sequence[FloatArray]) -> float:
    return max(displacement_mm(*each) for each in zip(views, poses, turned.poses, strict=True))


def test_all_pairs_at_once_against_a_chain(capsys: pytest.CaptureFixture[str]) -> None:
    peer = small_gicp()
    turned = seen(bumpy, ANGLES, pitch_mm=0.5)
    views, starts = turned.noisy(0, length_mm=3.0), wrong_axis(ANGLES)
    began = time.process_time()
    ours = worst_mm(turned, views, list(registered(views, starts).poses))
    rows = [("slrig, all pairs at once", ours, time.process_time() - began)]
    for kind in KINDS:
        began = time.process_time()
        rows.append(
            (
                f"small_gicp {kind}",
                worst_mm(turned, views, chained(peer, kind, views, starts)),
                time.process_time() - began,
            )
        )
    with capsys.disabled():
        print("\n" + "\n".join(f"{name:<26}{1e3 * wrong:10.1f} µm {cpu_s:6.1f} s" for name, wrong, cpu_s in rows))  # noqa: T201
    assert ours < min(wrong for _, wrong, _ in rows[1:])
