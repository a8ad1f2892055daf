"""What names of numbers mean: which device they are of, and what kind of number they are."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from slrig.model import FloatArray

Labels = frozenset[str]

_DEVICES: Mapping[str, str] = (
    dict.fromkeys(("cam", "camera", "cameras", "cams", "frame", "sensor"), "camera")
    | dict.fromkeys(("proj", "pro", "prj", "projector", "projectors", "screen", "display", "beamer"), "projector")
    | {"left": "left", "lft": "left", "right": "right", "rgt": "right", "first": "1", "second": "2"}
)
_LETTERS: Mapping[str, str] = {"c": "camera", "p": "projector", "l": "left", "r": "right"}


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


MATRIX_WORDS = _words("k kk m a mtx mat matrix matrices intrinsic intrinsics int params parameters internal")
LENS_WORDS = _words(
    "d dist dists distort distortion distortions coeffs coefs coeff coefficients kc k kappa dc radial tangential"
)
ROTATION_WORDS = _words(
    "r rot rotation rotate roration om omega rvec rodrigues orientation rotmat attitude quat quaternion q"
)
TRANSLATION_WORDS = _words("t tr trans translation translate tvec position offset shift origin")
VECTOR_WORDS = _words("vec vector mat matrix stereo of the in rel relative extrinsic extrinsics xyz mm cm m")
SIZE_WORDS = _words("size sizes resolution res shape dims dim dimensions dimension imsize wh extent")
_NOT_RAW = re.compile(
    r"\b(new|opt|rect|init|err|std|stds|vecs|rvecs|tvecs)\b|new(cam|mtx|k)|optimal|rectif|undist|initial|guess|error"
    "|uncertain|sigma|homograph|essential|fundamental|vectors|rotations|translations"
)
_SHORT = MATRIX_WORDS | LENS_WORDS | ROTATION_WORDS | TRANSLATION_WORDS | {"rt"}
_PART = re.compile(r"(?:(.*)[_.\- ])?(fx|fy|cx|cy|ppx|ppy|k[1-6]|p[12])(?:[_.\- ](.*))?")


def split_words(name: str) -> list[str]:
    """Return the words of a name in lower case: at separators, at digits, and where camel case begins one.

    >>> split_words("cameraMatrix1"), split_words("KK_left"), split_words("R_cam2proj"), split_words("cam000")
    (['camera', 'matrix', '1'], ['kk', 'left'], ['r', 'cam', '2', 'proj'], ['cam', '0'])
    """
    words = re.findall(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+", name)
    return [word.lstrip("0") or "0" if word.isdigit() else word.lower() for word in words]


def labels_of(path: Iterable[str]) -> Labels:
    """Return which devices a path of names speaks of: camera, projector, left, right, or numbers.

    >>> sorted(labels_of(["CameraParameters2", "K"])), sorted(labels_of(["Kp"])), sorted(labels_of(["mtx_r"]))
    (['2', 'camera'], ['projector'], ['right'])
    >>> sorted(labels_of(["R"])), sorted(labels_of(["R_p"]))
    ([], ['projector'])
    """
    words = [split_words(part) for part in path]
    found = {_DEVICES.get(word, word) for part in words for word in part if word in _DEVICES or word.isdigit()}
    for part in words:
        for place, word in enumerate(part):
            follows = part[place + 1] if place + 1 < len(part) else ""
            if word in _LETTERS and len(part) > 1 and (place > 0 or follows in MATRIX_WORDS | LENS_WORDS):
                found.add(_LETTERS[word])
    if not found and words and len(words[-1]) == 1 and words[-1][0][:-1] in _SHORT:
        # Kc, kp, Rp, KL.
        found |= {_LETTERS[word[-1]] for word in words[-1] if word[-1] in _LETTERS}
    return frozenset(found)


@dataclass(frozen=True, slots=True)
class Entry:
    """Numbers of a file. path : names of the maps around them and their own; values : float64; parts : for numbers put
    together from several entries, the names of these.
    """

    path: tuple[str, ...]
    values: FloatArray
    labels: Labels
    parts: tuple[str, ...] = field(default=())

    @property
    def name(self) -> str:
        """The path with dots, as --keys takes it."""
        return ".".join(self.path)

    @property
    def words(self) -> frozenset[str]:
        """Words of the last name, without those of devices."""
        words = split_words(self.path[-1])
        if len(words) == 1 and len(words[0]) > 1 and words[0] not in _SHORT and words[0][:-1] in _SHORT:
            words = [words[0][:-1]]
        # A letter that says the device: R_p, c_dist.
        letters = {n for n, word in enumerate(words) if word in _LETTERS and len(words) > 1 and (n or word != "r")}
        return frozenset(
            word for n, word in enumerate(words) if n not in letters and word not in _DEVICES and not word.isdigit()
        )

    @property
    def is_raw(self) -> bool:
        """False for what was computed from a calibration: rectified and optimal matrices, errors, first guesses."""
        return not _NOT_RAW.search(" ".join(word for part in self.path for word in split_words(part)))

    @property
    def vector(self) -> FloatArray | None:
        """(n,) the values if they are one row or one column."""
        return self.values.ravel() if self.values.size == max(self.values.shape, default=1) else None


def entries_of(leaves: Mapping[tuple[str, ...], object]) -> list[Entry]:
    """Return the numbers of a file; single ones that form a matrix or a lens (fx, cx, k1, ...) are put together."""
    entries = [
        Entry(path, np.atleast_1d(np.asarray(value, dtype=np.float64)), labels_of(path))
        for path, value in leaves.items()
        if not isinstance(value, str)
    ]
    groups: dict[tuple[str, ...], dict[str, Entry]] = {}
    for entry in entries:
        part = _PART.fullmatch(entry.path[-1].lower())
        if part is not None and entry.values.size == 1:
            around = (*entry.path[:-1], *(each for each in (part[1], part[3]) if each))
            groups.setdefault(around, {})[part[2].replace("ppx", "cx").replace("ppy", "cy")] = entry
    for around, parts in groups.items():
        numbers = {name: float(entry.values.item()) for name, entry in parts.items()}
        names = {name: entry.name for name, entry in parts.items()}
        if {"fx", "fy", "cx", "cy"} <= set(parts):
            matrix = np.array([
                [numbers["fx"], 0, numbers["cx"]], [0, numbers["fy"], numbers["cy"]], [0, 0, 1]
            ])  # fmt: skip
            used = tuple(names[each] for each in ("fx", "fy", "cx", "cy"))
            entries.append(Entry((*around, "matrix"), matrix, labels_of(around), used))
        if "k1" in parts:
            is_fisheye = "k4" in parts and "p1" not in parts
            terms = ["k1", "k2", "k3", "k4"] if is_fisheye else ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
            terms = terms if "k4" in parts else terms[:5]
            values = np.array([numbers.get(each, 0.0) for each in terms])
            used = tuple(names[each] for each in terms if each in names)
            entries.append(Entry((*around, "distortion"), values, labels_of(around), used))
    return entries + _vectors(leaves)


def _vectors(leaves: Mapping[tuple[str, ...], object]) -> list[Entry]:
    """Return vectors of maps of x, y and z, and rotations of maps of x, y, z and w."""
    maps: dict[tuple[str, ...], dict[str, float]] = {}
    for path, value in leaves.items():
        if len(path) > 1 and isinstance(value, float):
            maps.setdefault(path[:-1], {})[path[-1].lower().removeprefix("q")] = value
    found = []
    for path, parts in maps.items():
        if set(parts) == set("xyz"):
            found.append(Entry(path, np.array([parts[each] for each in "xyz"]), labels_of(path)))
        elif set(parts) == set("xyzw"):
            quaternion = np.array([parts[each] for each in "xyzw"])
            if abs(float(np.linalg.norm(quaternion)) - 1) < 1e-3:
                found.append(Entry(path, Rotation.from_quat(quaternion).as_matrix(), labels_of(path)))
    return found
