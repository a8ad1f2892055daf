"""What the comparison with golden pictures lets pass, and what it does not."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from tests.e2e.page.golden import MOST, Picture, kept, unlike

pytestmark = pytest.mark.slow

RESULT, DEVICES = "result-stripe", "devices"
EVERYTHING = (slice(None), slice(None))
MESH, PANEL = (slice(30, 190), slice(5, 195)), (slice(20, 85), slice(80, 160))


def moved(picture: Picture, right: float, down: float) -> Picture:
    shift = np.array(((1.0, 0.0, right), (0.0, 1.0, down)))
    size = picture.shape[1], picture.shape[0]
    return np.asarray(cv2.warpAffine(picture, shift, size, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)


def noisy(picture: Picture) -> Picture:
    return np.clip(picture + np.random.default_rng(1).normal(0, 4, picture.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("name", "part", "change", "passes"),
    [
        pytest.param(RESULT, EVERYTHING, lambda part: moved(part, 1.5, -1.5), True, id="other edges"),
        pytest.param(RESULT, EVERYTHING, noisy, True, id="noise"),
        pytest.param(DEVICES, EVERYTHING, lambda part: cv2.erode(part, np.ones((2, 2))), True, id="bolder letters"),
        pytest.param(RESULT, MESH, lambda part: part[:, ::-1], False, id="mirrored"),
        pytest.param(RESULT, MESH, lambda part: part[..., ::-1], False, id="another map of colours"),
        pytest.param(RESULT, MESH, lambda part: np.full_like(part, 255), False, id="no mesh"),
        pytest.param(DEVICES, PANEL, lambda part: np.full_like(part, 246), False, id="no panel"),
        pytest.param(DEVICES, EVERYTHING, lambda part: moved(part, 0, 12), False, id="12 px below its place"),
    ],
)
def test_a_picture_that_is_wrong_does_not_pass(
    name: str, part: tuple[slice, slice], change: Callable[[Picture], Picture], passes: bool
) -> None:
    found = kept(name)
    found[part] = change(found[part])
    assert (unlike(found, kept(name)) <= MOST) is passes
