"""Which images of a folder belong to which camera, and what they show: names propose groups, the images decide."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from slrig.bundle import DESCRIPTION, natural_sort_key, write_file
from slrig.errors import BundleError
from slrig.importers.detection import Light, sample_image, sample_step_px
from slrig.importers.images import ENDINGS, SourceImage, list_images
from slrig.importers.orders import pattern_words
from slrig.importers.understanding import Understanding, understand
from slrig.model import CameraFormat, Gray, Pattern, Pixels, Size

_MIN_IMAGES = 4
_MAX_CAMERAS = 16
_MAX_GROUPINGS = 8
_GOOD_COST = 1.0
_OTHER_CODES = 2.0  # cost of cameras that see different codes: likelier one camera's images of both axes
_THUMBNAIL_PX = 168
_REFERENCES = {
    "white", "black", "bright", "dark", "light", "on", "off", "full", "all", "none", "max", "min", "high", "low", "lit",
    "blank", "ambient", "reference", "ref", "texture", "color", "colour", "albedo", "inverse", "inv", "neg", "pos",
}  # fmt: skip
"""Words of images without a number that belong to a sequence."""

Groups = dict[str, list[SourceImage]]


@dataclass(frozen=True, slots=True)
class Picture:
    """An image, as far as it is needed to understand it. thumbnail : for people; brightest : sample of the image."""

    image: SourceImage
    thumbnail: Pixels
    samples: Light
    form: CameraFormat
    brightest: int


@dataclass(slots=True)
class UnderstoodFolder:
    """What the images of each camera show. alone : images beside the set."""

    cameras: dict[str, tuple[list[Picture], Understanding]]
    alone: list[Picture] = field(default_factory=list)

    @property
    def doubts(self) -> list[str]:
        """What is doubtful, each once, with the camera if there are several."""
        several = len(self.cameras) > 1
        found = [f"{name}: {doubt.text}" if several else doubt.text
                 for name, (_, each) in self.cameras.items() for doubt in each.doubts]  # fmt: skip
        if not self._is_one_code:
            found.append(f"{', '.join(self.cameras)} show different codes: they may be one camera's images")
        return list(dict.fromkeys(found))

    @property
    def faults(self) -> set[SourceImage]:
        """Images that do not show what their place says: copies, and exchanged ones."""
        return {
            pictures[image].image
            for pictures, each in self.cameras.values() for doubt in each.doubts if doubt.is_fault
            for image in doubt.images
        }  # fmt: skip

    @property
    def facts(self) -> list[str]:
        """What was found, in words."""
        found = []
        for name, (pictures, each) in self.cameras.items():
            found.append(f"camera {name}: {len(pictures)} images")
            found += [f"  {fact}" for fact in each.facts]
        if self.alone:
            found.append(f"beside the set, left out: {', '.join(each.image.name for each in self.alone)}")
        return found

    @property
    def assigned(self) -> dict[str, list[tuple[SourceImage, Pattern]]]:
        """The images of each camera with their patterns."""
        return {
            name: [(picture.image, shown) for picture, shown in zip(pictures, each.patterns, strict=True) if shown]
            for name, (pictures, each) in self.cameras.items()
        }

    @property
    def cost(self) -> float:
        """How unlike a capture this is: of the worst camera. Cameras see the same patterns."""
        worst = max(each.cost + 0.5 * len(each.left_out) for _, each in self.cameras.values())
        return worst + (0.0 if self._is_one_code else _OTHER_CODES)

    @property
    def _is_one_code(self) -> bool:
        codes = {
            frozenset(replace(shown, bit=0, inverted=False) for shown in each.patterns if isinstance(shown, Gray))
            for _, each in self.cameras.values()
        }
        return len(codes) == 1


def list_subfolders(folder: Path) -> tuple[Groups, list[str]]:
    """Return the images of each subfolder, in natural order, and how they were found in words.
    Raises BundleError: there are none.
    """
    subfolders = sorted(
        (each for each in folder.iterdir() if each.is_dir() and each.name[0] != "."), key=natural_sort_key
    )
    listed = {each.name: list_images(each) for each in subfolders}
    by_folder = {name: images for name, (images, _) in listed.items() if images}
    if not by_folder:
        if (folder / DESCRIPTION).is_file():
            message = f"{folder}: expected images to import, found a scan bundle; slrig reconstruct reads it"
            raise BundleError(message)
        raise BundleError(f"{folder}: expected images ({', '.join(sorted(ENDINGS))}), found none in it or below it")
    return by_folder, [note for _, notes in listed.values() for note in notes]


def camera_name(text: str) -> str:
    """Return text as the name of a camera."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text).strip("_-") or "cam0"


def group_by_prefix(images: Sequence[SourceImage]) -> Groups:
    """Group images by the part of their names before the last number."""
    groups: Groups = {}
    for image in images:
        groups.setdefault(re.sub(r"\d+\D*$", "", image.stem), []).append(image)
    if len(groups) == 1:
        return {"cam0": list(images)}
    return {camera_name(prefix): each for prefix, each in groups.items()}


def groupings(images: Sequence[SourceImage]) -> Iterator[Groups]:
    """Yield groups of images by camera that their names may mean: all of one camera; by words; by one of the numbers or
    words that few values of occur; by the part before the last number.
    """
    yield {"cam0": list(images)}
    fields = [re.findall(r"\d+|[^\W\d_]+", image.stem) for image in images]
    candidates: list[list[str]] = [[" ".join(re.findall(r"[^\W\d_]+", image.stem)) for image in images]]
    shapes = Counter(map(len, fields))
    usual = shapes.most_common(1)[0][0]
    candidates += [[each[k] if len(each) == usual else "" for each in fields] for k in range(usual)]
    candidates.append([re.sub(r"\d+\D*$", "", image.stem) for image in images])
    found: list[list[list[SourceImage]]] = []
    for keys in candidates:
        counts = Counter(keys)
        if not 1 < len(counts) <= _MAX_CAMERAS or counts.most_common(2)[1][1] < _MIN_IMAGES:
            continue
        groups = {key: [image for image, own in zip(images, keys, strict=True) if own == key] for key in counts}
        if list(groups.values()) not in found:
            found.append(list(groups.values()))
            yield {camera_name(key if not key.isdigit() else f"cam{key}"): each for key, each in groups.items()}


def read_picture(source: SourceImage) -> Picture:
    """Read an image in samples and as a small picture. Raises BundleError: it cannot be read."""
    form = source.read_format()
    image, _ = source.read(form)
    scale = _THUMBNAIL_PX / max(image.shape)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return Picture(source, small, sample_image(image), form, int(image.max()))


def understand_folder(
    groups: Sequence[Groups] | Iterator[Groups],
    projector: Size,
    *,
    cell_px: int | None = None,
    offset_px: int | None = None,
) -> UnderstoodFolder:
    """Return what images show, in those of some groups by camera whose images make codes best.

    Raises BundleError: no group of images is understood; the words of the fewest groups.
    """
    cache: dict[SourceImage, Picture] = {}
    best: UnderstoodFolder | None = None
    failure: BundleError | None = None
    for number, group in enumerate(groups):
        if number == _MAX_GROUPINGS:
            break
        try:
            found = _understand(group, projector, cache, cell_px=cell_px, offset_px=offset_px)
        except BundleError as cause:
            failure = failure or cause
            continue
        if best is None or found.cost < best.cost - 0.3:
            best = found
        if best.cost < _GOOD_COST:
            break
    if best is None:
        raise failure or BundleError("expected images, found none")
    return best


def _understand(
    groups: Mapping[str, Sequence[SourceImage]],
    projector: Size,
    cache: dict[SourceImage, Picture],
    *,
    cell_px: int | None,
    offset_px: int | None,
) -> UnderstoodFolder:
    found = UnderstoodFolder({})
    for name, files in groups.items():
        for path in files:
            if path not in cache:
                cache[path] = read_picture(path)
        pictures = [cache[path] for path in files]
        form = Counter(each.form for each in pictures).most_common(1)[0][0]
        own = [each for each in pictures if each.form == form]
        if len(own) < len(pictures) - max(2, len(pictures) // 8):
            raise BundleError(
                f"found images of {len({each.form for each in pictures})} extents or depths as one camera"
            )
        found.alone += [each for each in pictures if each.form != form]
        unnumbered = [each for each in own if not re.search(r"\d", each.image.stem)]
        if 0 < len(unnumbered) <= max(2, len(own) // 10) and not any(
            _REFERENCES & set(re.findall(r"[a-z]+", each.image.stem.lower())) for each in unnumbered
        ):
            own = [each for each in own if re.search(r"\d", each.image.stem)]
            found.alone += unnumbered
        if len(own) < _MIN_IMAGES:
            if len(groups) == 1:
                raise BundleError(
                    f"expected at least {_MIN_IMAGES} images of a camera, found {len(own)}: the steps of one period "
                    "number nothing"
                )
            found.alone += own
            continue
        names = [each.image.name for each in own]
        understood = understand(
            [each.samples for each in own], projector, names.__getitem__, cell_px=cell_px, offset_px=offset_px,
            step_px=sample_step_px(form.size.shape),
        )  # fmt: skip
        found.cameras[name] = (own, understood)
    if not found.cameras:
        raise BundleError(f"{len(groups)} cameras of fewer than {_MIN_IMAGES} images each")
    return found


def contact_sheet(understood: UnderstoodFolder) -> Pixels:
    """Draw all images with what each was taken for, doubtful ones in red: (H, W, 3) uint8 of blue, green and red."""
    tiles: list[Pixels] = []
    for camera, (pictures, found) in understood.cameras.items():
        doubtful = {image for doubt in found.doubts for image in doubt.images}
        brightest = max(int(each.thumbnail.max()) for each in pictures) or 1
        for index, picture in enumerate(pictures):
            shown = found.patterns[index]
            words = pattern_words(shown) if shown is not None else f"left out: {found.left_out.get(index, 'unknown')}"
            label = picture.image.name if len(understood.cameras) == 1 else f"{camera}: {picture.image.name}"
            is_red = index in doubtful or shown is None
            tiles.append(_tile(picture.thumbnail, brightest, label, words, is_red=is_red))
    for picture in understood.alone:
        brightest = int(picture.thumbnail.max()) or 1
        tiles.append(_tile(picture.thumbnail, brightest, picture.image.name, "left out: beside the set", is_red=True))
    columns = min(len(tiles), 8)
    height = max(each.shape[0] for each in tiles)
    tiles = [np.pad(each, ((0, height - each.shape[0]), (0, 0), (0, 0)), constant_values=32) for each in tiles]
    blank = np.full_like(tiles[0], 32)
    tiles += [blank] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[start : start + columns]) for start in range(0, len(tiles), columns)]
    lines = [*understood.facts, *(f"doubtful: {each}" for each in understood.doubts)]
    text = np.full((22 * len(lines) + 14, rows[0].shape[1], 3), 32, np.uint8)
    for number, line in enumerate(lines):
        _write(text, line, (8, 22 * number + 22), red=line.startswith("doubtful"), size=0.45)
    return np.vstack([text, *rows])


def write_contact_sheet(path: Path, understood: UnderstoodFolder) -> None:
    """Write the contact sheet as a PNG file. Raises StorageError."""
    write_file(path, cv2.imencode(".png", contact_sheet(understood))[1].tobytes())


def _tile(thumbnail: Pixels, brightest: int, label: str, words: str, *, is_red: bool) -> Pixels:
    side = _THUMBNAIL_PX + 12
    tile = np.full((thumbnail.shape[0] + 48, side, 3), 32, np.uint8)
    grey = np.clip(thumbnail.astype(np.float32) * (255 / brightest), 0, 255).astype(np.uint8)
    left = (side - grey.shape[1]) // 2
    if is_red:
        cv2.rectangle(tile, (left - 3, 3), (left + grey.shape[1] + 2, grey.shape[0] + 8), (60, 60, 255), 3)
    tile[6 : 6 + grey.shape[0], left : left + grey.shape[1]] = grey[..., None]
    _write(tile, label if len(label) < 27 else f"...{label[-24:]}", (6, grey.shape[0] + 22), red=False, size=0.38)
    _write(tile, words, (6, grey.shape[0] + 38), red=is_red, size=0.38)
    return tile


def _write(image: Pixels, text: str, place: tuple[int, int], *, red: bool, size: float) -> None:
    plain = text.encode("ascii", "replace").decode()
    colour = (90, 90, 255) if red else (235, 235, 235)
    cv2.putText(image, plain, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
