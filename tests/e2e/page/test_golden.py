"""What the comparison with golden pictures lets pass, and what it does not."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from tests.e2e.page.golden import MOST, Picture, kept, unlike

RESULT, DEVICES = "result-stripe", "devices"
MESH = (slice(30, 190), slice(5, 195))
"""Where the mesh is shown."""


def changed(name: str, part: tuple[slice, slice], change: Callable[[Picture], Picture]) -> float:
    """How much a picture is unlike itself with one part changed."""
    found = kept(name)
    found[part] = change(found[part])
    return unlike(found, kept(name))


def moved(picture: Picture, right: float, down: float) -> Picture:
    shift = np.array(((1.0, 0.0, right), (0.0, 1.0, down)))
    size = picture.shape[1], picture.shape[0]
    return np.asarray(cv2.warpAffine(picture, shift, size, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)


@pytest.mark.parametrize("name", [RESULT, DEVICES])
def test_what_another_machine_draws_otherwise_passes(name: str) -> None:
    picture = kept(name)
    noise = np.random.default_rng(1).normal(0, 4, picture.shape)
    assert unlike(picture, picture) == 0
    assert unlike(moved(picture, 1.5, -1.5), picture) <= MOST
    assert unlike(np.clip(picture + noise, 0, 255).astype(np.uint8), picture) <= MOST
    assert unlike(cv2.erode(picture, np.ones((2, 2))), picture) <= MOST, "bolder letters"


def test_what_is_wrong_does_not_pass() -> None:
    everything = (slice(None), slice(None))
    assert changed(RESULT, MESH, lambda part: part[:, ::-1]) > MOST, "mirrored"
    assert changed(RESULT, MESH, lambda part: part[..., ::-1]) > MOST, "another map of colours"
    assert changed(RESULT, MESH, np.zeros_like) > MOST, "black"
    assert changed(RESULT, MESH, lambda part: np.full_like(part, 255)) > MOST, "no mesh"
    assert changed(DEVICES, (slice(20, 85), slice(80, 160)), lambda part: np.full_like(part, 246)) > MOST, "no panel"
    assert changed(DEVICES, everything, lambda part: moved(part, 0, 12)) > MOST, "12 px below its place"
    assert changed(DEVICES, everything, lambda part: 255 - part) > MOST, "dark"
