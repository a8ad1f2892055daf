"""Focal lengths that pictures state in EXIF, which Pillow wrote here."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from slrig.importers.captures import ImageNaming, assign_images, import_capture
from slrig.importers.exif import read_focal_px
from slrig.model import Pixels, Size
from tests.unit.test_import_images import CODE, photographed

SIZE = Size(120, 80)
FILM, FOCAL, RESOLUTION, UNIT, WIDTH, HEIGHT, ZOOM = 0xA405, 0x920A, 0xA20E, 0xA210, 0xA002, 0xA003, 0xA404
RATIO = IFDRational(25, 10)


def picture(path: Path, pixels: Pixels | None = None, **tags: object) -> Path:
    """Write a picture with EXIF tags, given by the names above."""
    told = {globals()[name]: value for name, value in tags.items()}
    written = Image.Exif()
    written.endian = ">"  # that of TIFFs is that of this machine
    written.get_ifd(0x8769).update(told)
    directory = ImageFileDirectory_v2()
    directory[0x8769] = told
    image = Image.fromarray(np.zeros(SIZE.shape, np.uint8) if pixels is None else pixels)
    image.save(path, **({"tiffinfo": directory} if path.suffix == ".tif" else {"exif": written}))
    return path


@pytest.mark.parametrize("ending", ["jpg", "tif"])
@pytest.mark.parametrize(
    ("tags", "focal_px"),
    [
        ({"FILM": 50}, 50 / math.hypot(36, 24) * math.hypot(120, 80)),
        # Resized to a half since: the angle of view is the same.
        ({"FILM": 50, "WIDTH": 240, "HEIGHT": 160}, 50 / math.hypot(36, 24) * math.hypot(120, 80)),
        # 100 px a millimetre of the sensor.
        ({"FOCAL": RATIO, "RESOLUTION": 1000, "UNIT": 3}, 250),
        ({"FOCAL": RATIO, "RESOLUTION": 2540}, 250),
        ({"FOCAL": RATIO, "RESOLUTION": 1000, "UNIT": 3, "WIDTH": 160, "HEIGHT": 240}, 125),
        # A part of what the lens saw.
        ({"FILM": 50, "WIDTH": 160, "HEIGHT": 80}, None),
        ({"FILM": 50, "ZOOM": IFDRational(2, 1)}, None),
        ({"FILM": 0}, None),
        ({"FOCAL": RATIO}, None),
        ({"FILM": 60_000}, None),
    ],
)  # fmt: skip
def test_a_picture_states_the_focal_length_of_its_camera(
    tmp_path: Path, ending: str, tags: dict[str, Any], focal_px: float | None
) -> None:
    found = read_focal_px(picture(tmp_path / f"a.{ending}", **tags), SIZE)
    assert found == (focal_px if focal_px is None else pytest.approx(focal_px, rel=1e-4))


@pytest.mark.parametrize("ending", ["jpg", "tif"])
def test_damaged_tags_state_nothing_or_something(tmp_path: Path, ending: str) -> None:
    path = picture(tmp_path / f"a.{ending}", FILM=50, FOCAL=RATIO, RESOLUTION=1000)
    whole, draw = path.read_bytes(), np.random.default_rng(5)
    for cut in range(0, min(len(whole), 300), 7):
        path.write_bytes(whole[:cut])
        read_focal_px(path, SIZE)
    for _ in range(300):
        damaged = bytearray(whole)
        for place in draw.integers(0, min(len(whole), 300), 4):
            damaged[place] = draw.integers(256)
        path.write_bytes(damaged)
        found = read_focal_px(path, SIZE)
        assert found is None or 0 < found < math.inf


def test_what_pictures_state_survives_their_import(tmp_path: Path) -> None:
    for index, image in enumerate(photographed()):
        picture(tmp_path / f"{index:02d}.tif", image, FILM=35)
    found = assign_images(tmp_path, CODE, ImageNaming("opencv"))
    import_capture(tmp_path, tmp_path / "bundle", CODE, found)
    (camera,) = json.loads((tmp_path / "bundle" / "bundle.json").read_text())["cameras"].values()
    assert camera["focal_px"] == pytest.approx(35 / math.hypot(36, 24) * math.hypot(128, 96), abs=0.1)
    assert any("state a focal length of 129 px" in note for note in found.notes)
