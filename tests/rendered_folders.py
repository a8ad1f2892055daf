"""Folders of images as other programs leave them, of rendered scenes: orders, names, noise, light and faults by chance.

A scene is traced once; every pattern is a table look-up without noise. Noise, the response of the camera, its exposure
and the names of files are put on when a folder is written. The patterns are made here, a second time.
"""

from __future__ import annotations

import random
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from simulated_rig.light import Float32Array
from simulated_rig.options import HeadOptions
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import build_surface, read_scene
from slrig.errors import SlrigError
from slrig.examples import EXAMPLES
from slrig.importers import ImageNaming, ProjectorCode, assign_images
from slrig.importers.captures import ImageAssignment
from slrig.model import Axis, Black, Gray, LineShift, Pattern, Pixels, Sine, Size, White
from tests.light_bound import ExposedView

SCENES = (
    ("relief", Size(512, 384), Size(480, 384)),
    ("stairs", Size(640, 400), Size(480, 360)),
    ("ball_bar", Size(1024, 768), Size(640, 512)),
    ("relief", Size(800, 600), Size(560, 420)),
)
"""Scene, projector and camera."""


NAMES = (
    "plain", "prefix", "camera before", "camera after", "stamp", "stamp and number", "axes", "letters", "folder",
    "unpadded",
)  # fmt: skip


class FolderScene:
    """A scene before a rig of a projector and a camera."""

    def __init__(self, scene: str, projector: Size, camera: Size) -> None:
        self.size = projector
        table = tomllib.loads((EXAMPLES / "rigs" / "relief.toml").read_text(encoding="utf-8"))["head"]
        del table["driver"]
        table["projector"] = _scaled(table["projector"], projector)
        table["camera"] = [_scaled(table["camera"][0], camera)]
        table["samples_per_axis"] = 2
        options = HeadOptions.model_validate(table)
        eye, lamp = options.camera[0], options.projector
        surface = build_surface(read_scene(EXAMPLES / "scenes" / f"{scene}.toml"), EXAMPLES / "scenes")
        distance_mm = float(np.linalg.norm(lamp.pinhole().centre_mm))
        stage = SceneState(surface, lamp.pinhole(), working_distance_mm=distance_mm)
        view = CameraView(
            eye.pinhole(), stage, blur_px=eye.blur_px, ambient=0.0, jitter=False, seed=1, samples_per_axis=2,
            workers=1,
        )  # fmt: skip
        sensor = eye.sensor()
        self._exposed = ExposedView(view, lamp.size, lamp.response(), sensor, sensor.saturation_s)
        self._light: dict[bytes, Float32Array] = {}
        self._white = float(np.percentile(self._electrons(np.full((1, 1), 255, np.uint8)), 99.9))

    def light(self, profile: Pixels) -> Float32Array:
        """(H, W): light of a pattern relative to the brightest white."""
        return self._electrons(profile) / np.float32(self._white)

    def _electrons(self, profile: Pixels) -> Float32Array:
        key = bytes(str(profile.shape), "ascii") + profile.tobytes()
        if key not in self._light:
            self._light[key] = np.asarray(self._exposed.electrons(profile), np.float32)
        return self._light[key]


def _scaled(device: dict[str, object], size: Size) -> dict[str, object]:
    """A device of another extent that sees the same."""
    old = device["size_px"]
    assert isinstance(old, list)
    scale = (size.width_px / old[0], size.height_px / old[1])
    changed = {
        key: [round(value * factor, 3) for value, factor in zip(device[key], scale, strict=True)]  # type: ignore[call-overload]
        for key in ("focal_px", "principal_px")
    }
    wide = changed["focal_px"][0]
    return {**device, **changed, "focal_px": [wide, wide], "size_px": [size.width_px, size.height_px]}


@cache
def scene(number: int) -> FolderScene:
    """One of the scenes, traced once."""
    return FolderScene(*SCENES[number])


def gray_light(extent: int, bit: int, bits: int, cell: int = 1, offset: int = 0, *, inverted: bool = False) -> Pixels:
    """(extent,) one bit of a Gray code, most significant first: bit b of i is b of i xor i/2."""
    place = (np.arange(extent) + offset) // cell
    power = bits - 1 - bit
    lit = (place // 2**power + place // 2 ** (power + 1)) % 2 == 1
    return np.asarray((lit != inverted) * 255, np.uint8)


def pattern_light(pattern: Pattern, size: Size) -> Pixels:
    """Light of a pattern: (1, W), (H, 1) or (1, 1)."""
    match pattern:
        case White() | Black():
            return np.full((1, 1), 255 if isinstance(pattern, White) else 0, np.uint8)
        case Gray(axis, bit, bits, cell, offset, inverted):
            line = gray_light(size.along(axis), bit, bits, cell, offset, inverted=inverted)
        case LineShift(axis, shift, period, width):
            line = (((np.arange(size.along(axis)) - shift) % period < width) * 255).astype(np.uint8)
        case Sine(axis, sine_period, phase, steps):
            turns = np.arange(size.along(axis)) / sine_period - phase / steps
            line = np.rint(127.5 + 127.5 * np.cos(2 * np.pi * turns)).astype(np.uint8)
        case _:
            raise AssertionError(pattern)
    return line[None, :] if axis is Axis.COLUMN else line[:, None]


@dataclass(slots=True)
class Folder:
    """A folder of images. shown : what each file shows, None for those that do not belong. kinds : how it was made, in
    words.
    """

    path: Path
    projector: Size
    shown: dict[str, Pattern | None] = field(default_factory=dict)
    kinds: list[str] = field(default_factory=list)


def sequence(chance: random.Random, size: Size, kinds: list[str]) -> list[Pattern]:
    """A random program's order."""
    axes = chance.choice([[Axis.COLUMN], [Axis.COLUMN], [Axis.COLUMN, Axis.ROW], [Axis.COLUMN, Axis.ROW],
                          [Axis.ROW, Axis.COLUMN]])  # fmt: skip
    style = chance.choice(["pairs", "pairs", "pairs", "plain", "plain", "blocks", "inverse first"])
    ends = chance.choice(["WB first", "WB first", "BW first", "WB last", "none", "both"])
    code = chance.choice(["whole", "whole", "whole", "first bits", "cells", "centred"])
    order = chance.choice(["coarse", "coarse", "coarse", "fine"])
    mixed = len(axes) == 2 and chance.random() < 0.2
    lines = len(axes) == 1 and chance.random() < 0.3
    if lines:
        code = "cells"
    kinds += [style, ends, code, order, *(["mixed"] if mixed else []), *(["lines"] if lines else []),
              "+".join(axis.value for axis in axes)]  # fmt: skip
    bits: dict[Axis, list[Gray]] = {}
    whole = {axis: (size.along(axis) - 1).bit_length() for axis in axes}
    count = min(whole.values()) if code == "centred" else 0
    for axis in axes:
        cell = {"whole": 1, "first bits": 2, "cells": 4, "centred": 1 << (whole[axis] - count)}[code]
        offset = (2 ** whole[axis] - size.along(axis)) // 2 if code == "centred" else 0
        number = ((size.along(axis) - 1 + offset) // cell).bit_length()
        bits[axis] = [Gray(axis, bit, number, cell, offset) for bit in range(number)]
        if order == "fine":
            bits[axis].reverse()
    if code == "centred":
        style, ends, mixed = "pairs", "WB first", False
    if mixed:
        longest = max(map(len, bits.values()))
        turns = [bits[axis][k] for k in range(longest) for axis in axes if k < len(bits[axis])]
    else:
        turns = [each for axis in axes for each in bits[axis]]
    match style:
        case "plain":
            body: list[Pattern] = list(turns)
        case "blocks":
            body = [*turns, *(each.inverse for each in turns)]
        case "inverse first":
            body = [each for bit in turns for each in (bit.inverse, bit)]
        case _:
            body = [each for bit in turns for each in (bit, bit.inverse)]
    if lines:
        width = chance.choice([1, 2, 4])
        body += [LineShift(axes[0], shift, 8, width) for shift in range(8)]
    white, black = White(), Black()
    leading: dict[str, list[Pattern]] = {"WB first": [white, black], "BW first": [black, white], "both": [white, black]}
    closing: dict[str, list[Pattern]] = {"WB last": [white, black], "both": [white, black]}
    return [*leading.get(ends, []), *body, *closing.get(ends, [])]


def make_folder(seed: int, path: Path) -> Folder:
    """Write a folder of images by chance."""
    chance = random.Random(seed)
    number = chance.randrange(len(SCENES))
    stage = scene(number)
    folder = Folder(path, stage.size)
    shown: list[Pattern | None] = list(sequence(chance, stage.size, folder.kinds))
    folder.kinds.append(f"scene {number}")
    fault = chance.choice(["right"] * 10 + ["missing", "missing", "twice", "twice", "mirrored", "turned", "lone"])
    folder.kinds.append(fault)
    profiles = [pattern_light(each, stage.size) for each in shown if each is not None]
    if fault == "mirrored":
        # A program that inverts its first bit: the code runs backward.
        for place, each in enumerate(shown):
            if isinstance(each, Gray) and each.axis is Axis.COLUMN and each.bit == 0:
                shown[place] = each.inverse
                profiles[place] = 255 - profiles[place]
    if fault == "missing":
        place = chance.randrange(len(shown))
        folder.kinds.append(f"without {shown[place]}")
        del shown[place], profiles[place]
    if fault == "turned":
        shown, profiles = [*shown[1:], shown[0]], [*profiles[1:], profiles[0]]
    images = _photographed(chance, stage, profiles, folder.kinds)
    if fault == "twice":
        _double_one(chance, folder, shown, images)
    _write(chance, folder, shown, images)
    if fault == "lone":
        room = cv2.GaussianBlur(
            np.random.default_rng(seed).uniform(0, 255, images[0].shape).astype(np.float32), (0, 0), 9
        )
        kind = np.uint16 if images[0].dtype == np.uint16 else np.uint8
        file = next(iter(path.rglob("*.png"))).parent / "setup.png"
        lone = cv2.normalize(room, None, 0, 250, cv2.NORM_MINMAX).astype(kind)
        cv2.imwrite(str(file), lone if chance.random() < 0.5 else lone[:-7])
        folder.shown[str(file.relative_to(path))] = None
    return folder


def _double_one(chance: random.Random, folder: Folder, shown: list[Pattern | None], images: list[Pixels]) -> None:
    place = chance.randrange(1, len(shown))
    folder.kinds.append(f"twice {shown[place]}")
    shown.insert(place, shown[place])
    images.insert(place, images[place].copy())


def _write(chance: random.Random, folder: Folder, shown: Sequence[Pattern | None], images: Sequence[Pixels]) -> None:
    folder.path.mkdir(parents=True)
    for name, pattern, image in zip(_names(chance, len(images), folder.kinds), shown, images, strict=True):
        folder.shown[name] = pattern
        file = folder.path / name
        file.parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(file), image)


def _photographed(
    chance: random.Random, stage: FolderScene, profiles: Sequence[Pixels], kinds: list[str]
) -> list[Pixels]:
    """Images of patterns by a camera of some noise, response, exposure and depth."""
    noise = chance.choice([0.0, 0.5, 1.0, 2.0, 3.0, 4.0])
    gamma = chance.choice([1.0, 1.0, 0.45, 0.7, 1.5, 2.2])
    exposure = chance.choice(["fixed", "fixed", "drift", "automatic"])
    level, room = chance.uniform(0.5, 1.05), chance.choice([0.0, 0.02, 0.08])
    depth = chance.choice(["8", "8", "8", "12 left", "12 right"])
    kinds += [f"noise {noise:g}", f"gamma {gamma:g}", exposure, depth, f"room {room:g}"]
    rng = np.random.default_rng(chance.randrange(2**31))
    drift = chance.uniform(-0.25, 0.25)
    images = []
    for place, profile in enumerate(profiles):
        light = stage.light(profile)
        factor = 1.0
        if exposure == "drift":
            factor = 1 + drift * place / len(profiles)
        elif exposure == "automatic":
            # Half way to the same mean light, as a slow loop ends.
            factor = float(np.clip((0.15 / (float(light.mean()) + room + 0.02)) ** 0.5, 0.6, 1.6)) * rng.uniform(
                0.95, 1.05
            )
        value = np.clip((light + np.float32(room)) * np.float32(level * factor), 0, 1) ** np.float32(gamma)
        value = value * 255 + rng.normal(0, noise, value.shape) if noise else value * 255
        images.append(np.clip(value, 0, 255))
    if depth == "8":
        return [np.rint(each).astype(np.uint8) for each in images]
    scale = 16 if depth == "12 left" else 1
    return [(np.rint(each * (4095 / 255)) * scale).astype(np.uint16) for each in images]


def _names(chance: random.Random, count: int, kinds: list[str]) -> list[str]:
    """Names of images in the order of the sequence."""
    kind = chance.choice(NAMES)
    kinds.append(kind)
    start = chance.choice([0, 0, 1])
    numbers = range(start, start + count)
    match kind:
        case "plain":
            return [f"{number:02}.png" for number in numbers]
        case "prefix":
            return [f"graycode_{number:03}.png" for number in numbers]
        case "camera before":
            return [f"cam1_im{number}.png" for number in numbers]
        case "camera after":
            return [f"{number:03}_left.png" for number in numbers]
        case "stamp":
            return [f"20240511_{101500 + 3 * number:06}_{number * 137 % 1000:03}.png" for number in numbers]
        case "stamp and number":
            return [f"2024-05-11T10.{15 + number // 60:02}.{number % 60:02}_frame{number:02}.png" for number in numbers]
        case "axes":
            half = count // 2
            return [
                f"{number // half if number < 2 * half else 2:02}_{number % half:02}.png" for number in range(count)
            ]
        case "letters":
            return [f"scan_{chr(97 + number // 26)}{chr(97 + number % 26)}.png" for number in range(count)]
        case "folder":
            return [f"left/{number:02}.png" for number in numbers]
        case _:
            return [f"Image{number}.png" for number in numbers]


def judge(folder: Folder, understood: ImageAssignment | SlrigError) -> str:
    """`right`, `wrong` or `wrong in silence`; `refused`, or `named` where a bit has no image, which is said."""
    if isinstance(understood, SlrigError):
        lacks_bit = "missing" in folder.kinds and "plain" in folder.kinds
        return "named" if lacks_bit and "no image shows" in str(understood) else "refused"
    found = {
        path.place.relative_to(folder.path).as_posix(): pattern
        for files in understood.cameras.values()
        for path, pattern in files
    }
    shown = list(folder.shown.values())
    for name, pattern in folder.shown.items():
        taken = found.get(name)
        is_copy = taken is None and pattern is not None and shown.count(pattern) > 1
        if is_copy or (pattern is None and taken is None):
            continue
        if pattern is None or taken is None:
            break
        one, other = pattern_light(pattern, folder.projector), pattern_light(taken, folder.projector)
        if not np.array_equal(one, other):
            break
    else:
        return "right"
    return "wrong" if understood.understood is not None and understood.understood.doubts else "wrong in silence"


def understand_folder_of(seed: int, path: Path) -> tuple[Folder, str]:
    """Write a folder by chance and judge what the importer makes of it without an option."""
    folder = make_folder(seed, path)
    try:
        understood: ImageAssignment | SlrigError = assign_images(path, ProjectorCode(folder.projector), ImageNaming())
    except SlrigError as cause:
        understood = cause
    return folder, judge(folder, understood)
