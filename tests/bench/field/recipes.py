"""Public captures: fetched with git when asked, checked, and imported as bundles."""

from __future__ import annotations

import hashlib
import json
import subprocess
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from scipy.io import loadmat

from tests.bench.field.measures import Camera, Reference, among
from tests.unit.command import done

Recipe = Mapping[str, Any]

_TEXT: Recipe = tomllib.loads((Path(__file__).parent / "recipes.toml").read_text())
SOURCES: Mapping[str, Recipe] = _TEXT["sources"]
CAPTURES: Mapping[str, Recipe] = {
    name: {**SOURCES[each["frames"].partition("/")[0]], "patterns": (), **each}
    for name, each in _TEXT["captures"].items()
}
DIGEST = hashlib.sha256(json.dumps(_TEXT, sort_keys=True).encode()).hexdigest()[:12]
LIT = 20  # grey levels of 255 between a pixel's brightest and darkest frame


def fetch(folder: Path) -> None:
    """Fetch from each source what the captures use, unless the source is there."""
    for name, source in SOURCES.items():
        home = str(folder / name)
        for words in (
            ["clone", "--quiet", "--filter=blob:none", "--no-checkout", source["url"], home],
            ["-C", home, "sparse-checkout", "set", source["path"]],
            ["-C", home, "checkout", "--quiet", source["commit"]],
        ):
            if words[0] != "clone" or not Path(home).exists():
                subprocess.run(["git", *words], check=True)  # noqa: S603, S607 - as asked for


def digest(folder: Path, recipe: Recipe) -> str:
    """Sha256 of all files that a capture uses, with their paths."""
    files = [folder / recipe[key] for key in ("calibration", "cloud") if key in recipe]
    for place in [recipe["frames"], *recipe.get("poses", [])]:
        files += sorted(each for each in (folder / place).iterdir() if each.suffix in {".bmp", ".png", ".jpg"})
    found = hashlib.sha256()
    for file in files:
        found.update(f"{file.relative_to(folder).as_posix()}\n".encode() + file.read_bytes())
    return found.hexdigest()


def make_bundle(captures: Path, recipe: Recipe, folder: Path) -> Path:
    """Import a capture with its calibration. Raises ValueError: its files are others than those of the recipe."""
    if (found := digest(captures, recipe)) != recipe["sha256"]:
        path = captures / recipe["frames"]
        raise ValueError(f"{path}: expected sha256 {recipe['sha256']}, found {found}; delete it and fetch again")
    words = ["--yes", "--projector", recipe["projector"], *recipe["patterns"]]
    for pose in recipe.get("poses", []):
        done("import", captures / pose, "--output", folder / "poses" / Path(pose).name, *words)
    if "poses" in recipe:
        calibration = folder / "calibration.json"
        done("calibrate", "solve", folder / "poses", "--output", calibration, *recipe["board"])
    else:
        calibration = captures / recipe["calibration"]
    done("import", captures / recipe["frames"], "--output", folder / "bundle", *words, "--calibration", calibration)
    return folder / "bundle"


def make_reference(captures: Path, recipe: Recipe, bundle: Path) -> tuple[Reference, Camera]:
    """What a bundle's points are compared with, and where; and its only camera."""
    (camera,) = json.loads((bundle / "calibration.json").read_text())["cameras"].values()
    files = [bundle / each["file"] for each in json.loads((bundle / "bundle.json").read_text())["frames"]]
    frames = np.array([cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files])
    lit = frames.max(axis=0).astype(np.int64) - frames.min(axis=0) > LIT
    lit &= cv2.fillPoly(np.zeros(lit.shape, np.uint8), [np.array(recipe["region_px"])], 1) > 0
    if "cloud" not in recipe:
        return Reference(lit, lit), camera
    if (path := captures / recipe["cloud"]).suffix == ".mat":
        points = loadmat(path)["xyz"].reshape(-1, 3)
    else:  # for viewers: y up, z towards the camera
        points = np.asarray(trimesh.load(path, process=False).vertices) * (1, -1, -1)
    return among(points[np.isfinite(points).all(axis=1)].astype(np.float64), lit, camera), camera
