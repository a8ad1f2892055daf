"""What a screen looks like, held against a small picture of it in golden/ that a person has looked at.

Letters of another machine's fonts, edges that are smoothed otherwise, and other digits of a time lie a little elsewhere
or are a little darker. So pictures are small, and blurred before they are compared; and what one shows at a place only
has to lie between the darkest and the brightest that the other one shows near by. What is missing, has another colour
or stands elsewhere differs over a good part of the tiles that it covers.

To make them again: `SLRIG_GOLDEN=make pytest -m slow tests/e2e/page`. Look at each before it is committed.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from playwright.sync_api import Page

Picture = NDArray[np.uint8]

MOST = 0.3
"""The share of a tile that may differ. Measured: 0.21 and 0.25 (desk, phone) with DejaVu Serif in place of Sans, 0.32
where one panel of text is missing and all else is in its place, 0.37 where all stands three lines lower, 1.0 for a mesh
that is mirrored, black, gone or of other colours.
"""

# A picture below the window that is loaded when it is scrolled to would never be.
_LOADED = """(all) => Promise.all(all.map((each) => {
  each.loading = "eager";
  return each.decode().catch(() => {});
}))"""
_FOLDER = Path(__file__).parent / "golden"
_PHONE_PX = 600
"""Windows less wide than this are a phone's."""

_TILE_PX = 32
_NEAR_PX = 8
_BLUR_PX = 1.0
_LEVELS = 20
_STEP = 15
"""Pictures are kept in multiples of so many levels, for a third of the bytes."""
_PACKED = (cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE,
           cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_FILTERED)  # fmt: skip


def looks_as_kept(page: Page, name: str) -> None:
    """Hold the upper part of a page against the picture of that name; or keep it as that where SLRIG_GOLDEN is set."""
    page.mouse.move(0, 0)
    page.locator("img:not([src*='/preview/'])").evaluate_all(_LOADED)
    factor, height = (4, 250) if page.evaluate("innerWidth") > _PHONE_PX else (3, 466)
    shown = small(page.screenshot(full_page=True, animations="disabled"), factor)[:height]
    if os.environ.get("SLRIG_GOLDEN"):
        levels = np.rint(shown / _STEP) * _STEP
        cv2.imwrite(str(_FOLDER / f"{name}.png"), levels.astype(np.uint8), _PACKED)
    found = unlike(shown, kept(name))
    place = Path(tempfile.gettempdir()) / f"slrig-golden-{name}.png"
    if found > MOST:
        cv2.imwrite(str(place), shown)
    assert found <= MOST, f"{name} looks otherwise, as in {place}: {found:.0%} of a tile"


def small(shot: bytes, factor: int) -> Picture:
    """A screenshot a few times smaller: (H, W, 3) uint8, blue, green, red."""
    whole = cv2.imdecode(np.frombuffer(shot, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert whole is not None
    size = (whole.shape[1] // factor, whole.shape[0] // factor)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def kept(name: str) -> Picture:
    found = cv2.imread(str(_FOLDER / f"{name}.png"))
    assert found is not None, f"there is no golden picture {name}"
    return np.asarray(found, dtype=np.uint8)


def unlike(one: Picture, other: Picture) -> float:
    """The greatest share of a tile, 32 x 32 px, in which one picture shows what the other does not show near by."""
    rows, columns = (max(ends) for ends in zip(one.shape[:2], other.shape[:2], strict=True))
    first, second = (_blurred(each, rows, columns) for each in (one, other))
    beyond = (_beyond(first, second) | _beyond(second, first)).astype(np.float32)
    return float(cv2.blur(beyond, (_TILE_PX, _TILE_PX)).max())


def _blurred(picture: Picture, rows: int, columns: int) -> NDArray[np.int16]:
    """The picture blurred, and as large as the larger one by what its border shows."""
    below, right = rows - picture.shape[0], columns - picture.shape[1]
    whole = cv2.copyMakeBorder(picture, 0, below, 0, right, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.GaussianBlur(whole, (0, 0), _BLUR_PX), dtype=np.int16)


def _beyond(shown: NDArray[np.int16], known: NDArray[np.int16]) -> NDArray[np.bool_]:
    """(H, W): where a picture shows what the other one has not near by."""
    near = np.ones((2 * _NEAR_PX + 1, 2 * _NEAR_PX + 1), dtype=np.uint8)
    over = np.maximum(cv2.erode(known, near) - shown, shown - cv2.dilate(known, near))
    return np.asarray((over > _LEVELS).any(axis=2))
