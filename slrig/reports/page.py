"""Reports as single pages of HTML, filled in from templates: whatever they are given is escaped unless it is `Markup`.

A page holds everything that it shows: style, drawings (SVG) and pictures (JPEG). It runs no script and asks nobody for
anything, so that it can be mailed, printed and kept beside what it reports on.
"""

from __future__ import annotations

import math
from base64 import b64encode

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from slrig.model import Pixels

_TEMPLATES = Environment(
    loader=PackageLoader("slrig.reports"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.tests["nan"] = math.isnan


def filled(template: str, /, **values: object) -> str:
    """The page that a template of slrig/reports/templates makes of values."""
    return _TEMPLATES.get_template(template).render(values)


def begun(words: str) -> str:
    """Words as the beginning of a sentence: unlike `str.capitalize`, it leaves the others as they are.

    >>> begun("camera 'B' moved")
    "Camera 'B' moved"
    """
    return words[:1].upper() + words[1:]


_TEMPLATES.filters["begun"] = begun


def jpeg_uri(picture: Pixels, quality: int) -> str:
    """A picture, (H, W, 3) uint8, blue, green, red, as an address that holds it as JPEG.

    That is a twentieth of a PNG file's size, and a page holds dozens. Raises ValueError if it cannot be written so.
    """
    written, data = cv2.imencode(".jpg", np.ascontiguousarray(picture), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not written:
        message = f"a picture of {picture.shape} could not be written as JPEG"
        raise ValueError(message)
    return "data:image/jpeg;base64," + b64encode(data.tobytes()).decode("ascii")
