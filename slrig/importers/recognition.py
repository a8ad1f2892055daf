"""Recognition of a rig's calibration among the numbers of a file: by shape, by what their names share, by what fits.

Matrices, lenses, poses and sizes are found by their shape; their names say which device they are of. Where the order
of the devices or the direction of the pose is open, the images of a capture decide, and without them it is asked.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from slrig.bundle import CAMERA_NAME, MAX_SIDE_PX
from slrig.errors import CalibrationError
from slrig.importers.coded_images import CodedImages
from slrig.importers.documents import Leaf, Name
from slrig.importers.lenses import Lens, as_lens
from slrig.importers.names import (
    LENS_WORDS,
    ROTATION_WORDS,
    SIZE_WORDS,
    TRANSLATION_WORDS,
    VECTOR_WORDS,
    Entry,
    Labels,
    entries_of,
    labels_of,
    split_words,
)
from slrig.model import Calibration, FloatArray, LengthUnit, Pinhole, Size

PROJECTOR = "projector"
POSE = "pose"
KNOWN_HELP = (
    "Files of OpenCV, MATLAB, NumPy, ROS, Kalibr, scan3d-capture, SLStudio, sltk and procam-calibration are read as "
    "they are"
)
KEYS_HELP = "--keys 'camera=K1,D1,1280x1024 projector=K2,D2,1024x768 pose=R,T'"

_MIN_FOCAL_PX = 10.0
_MAX_SKEW = 0.1  # of the focal length
_TERM_COUNTS = (2, 3, 4, 5, 8, 12, 14)
_ROTATION_ERROR = 5e-3  # of numbers rounded to three digits
_EXACT_ROTATION = 1e-4  # of `Pinhole`
_MIN_SIDE_PX = 64
_STATED_WORDS = {"r", "t", "rot", "rotation", "roration", "trans", "translation", "om", "rvec", "tvec"} | VECTOR_WORDS
"""Words of poses that are x_second = R x_first + T, as OpenCV, MATLAB and all programs above them have it."""
_MODEL_WORDS = {"model", "type", "distortion", "lens", "projection"}
_FISHEYE = re.compile(r"fisheye|equi(distant)?(?![a-z])|kannala", re.IGNORECASE)
_OTHER_MODELS = re.compile(r"\b(omni\w*|ds|eucm|double.?sphere|inverse\w*|scaramuzza|fov|mei)\b", re.IGNORECASE)
_NOT_IMAGES = {"board", "square", "pattern", "chess", "chessboard", "checkerboard", "marker", "grid", "roi", "cell"}
_SIDES = re.compile(r"(.*?)(width|height|cols|rows|nx|ny|resx|resy|w|h)")
_WIDTHS = ("width", "cols", "nx", "resx", "w")
_UNITS: Mapping[str, LengthUnit] = {
    "mm": "mm", "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm", "cm": "cm",
    "centimeters": "cm", "centimetres": "cm", "meter": "m", "meters": "m", "metres": "m", "inches": "inch", "m": "m",
}  # fmt: skip

_MAX_OFF_CENTRE = 0.12
"""Distance of a camera's principal point from the middle of its image, in sides of the image."""
_AGREES = 0.35
"""Residual of the best reading of a file over that of the next best, for the capture to decide between them."""
_MAX_AGREEING_PX = 20.0
_CONTRADICTS_PX = 1.0  # residual of the usual reading from which another one may take its place
_IN_FRONT, _BEHIND = 0.9, 0.5  # shares of points


@dataclass(frozen=True, slots=True)
class Keys:
    """Which numbers of a file are which. devices : name of each device and its entries or groups of entries, first the
    cameras; pose : rotation and translation; sizes : where the file has none. inverse : True if the pose maps the last
    device's axes to the first one's.
    """

    devices: Mapping[str, tuple[str, ...]]
    pose: tuple[str, ...] = ()
    sizes: Mapping[str, Size] | None = None
    inverse: bool = False


def parse_keys(words: Sequence[str]) -> Keys | None:
    """Return the keys of words such as `camera=K1,D1,1280x1024`, `pose=R,T` or `pose=R,T,inverse`; None for none.
    Raises CalibrationError.
    """
    devices: dict[str, tuple[str, ...]] = {}
    sizes: dict[str, Size] = {}
    inverse = False
    for word in " ".join(words).split():
        name, _, text = word.partition("=")
        items = [item for item in text.split(",") if item]
        if not items or name in devices or not (name in (PROJECTOR, POSE) or re.match(CAMERA_NAME, name)):
            raise CalibrationError(f"--keys: expected words as in {KEYS_HELP}, each name once, found '{word[:60]}'")
        for item in items:
            sides = re.fullmatch(r"([1-9]\d{0,4})[xX]([1-9]\d{0,4})", item)
            if sides is not None:
                sizes[name] = Size(int(sides[1]), int(sides[2]))
        devices[name] = tuple(each for each in items if not re.fullmatch(r"\d+[xX]\d+|inverse", each))
        inverse |= name == POSE and "inverse" in items
    pose = devices.pop(POSE, ())
    return Keys(devices, pose, sizes, inverse) if words else None


@dataclass(frozen=True, slots=True)
class Device:
    """A lens of a file. terms : of its distortion, of any number; size : as the file states it, None if it does not."""

    labels: Labels
    matrix: FloatArray
    matrix_name: str
    terms: FloatArray
    lens_name: str
    is_equidistant: bool = False
    size: Size | None = None
    is_transposed: bool = False

    @property
    def names(self) -> str:
        """The entries of the file that it is of."""
        return ", ".join(each for each in (self.matrix_name, self.lens_name) if each)


@dataclass(frozen=True, slots=True)
class Pose:
    """A rotation and a translation of a file. is_stated : True if its names say that it maps the first device's axes to
    the second's.
    """

    labels: Labels
    rotation: FloatArray
    translation: FloatArray
    names: str
    is_stated: bool

    @property
    def is_identity(self) -> bool:
        """True for the pose of the device whose axes are the world's."""
        return bool(np.allclose(self.rotation, np.eye(3)) and np.allclose(self.translation, 0))

    def equals(self, other: Pose) -> bool:
        """Return True if both map alike."""
        size = float(np.linalg.norm(self.translation))
        return bool(
            np.allclose(self.rotation, other.rotation, atol=_ROTATION_ERROR)
            and np.allclose(self.translation, other.translation, atol=_ROTATION_ERROR * size)
        )

    def inverse(self) -> Pose:
        """Return the pose that maps the other way."""
        return replace(self, rotation=self.rotation.T, translation=-self.rotation.T @ self.translation)


@dataclass(frozen=True, slots=True)
class Reading:
    """One way to read a file. words : what was taken for what; sized : devices whose size the file states; direction :
    what the pose maps, is_stated : True if its names say so.
    """

    calibration: Calibration
    words: tuple[str, ...]
    sized: frozenset[str]
    poses: str
    direction: str
    is_stated: bool


@dataclass(frozen=True, slots=True)
class Found:
    """The calibration of a file in the unit of its numbers. unit : as the file states it; notes : what was read as
    what, and how that was decided; sized : devices whose size the file states.
    """

    calibration: Calibration
    unit: LengthUnit | None
    notes: tuple[str, ...]
    sized: frozenset[str]


class Recognition:
    """Finds the calibration among the numbers of a file.

    leaves : as `slrig.importers.documents.read_document` returns them. cameras, projector : extents of a capture, which
    replace sizes that the file lacks; empty without one. capture : decides between ways to read the file. program :
    that wrote the file, empty if it is not known.
    """

    def __init__(
        self,
        leaves: Mapping[Name, Leaf],
        path: Path,
        keys: Keys | None,
        cameras: Mapping[str, Size],
        projector: Size | None,
        capture: CodedImages[Any] | None,
        program: str,
    ) -> None:
        self._path, self._keys, self._capture = path, keys or Keys({}), capture
        self._cameras, self._projector = cameras, projector
        self._program = f", in a file of {program}" if program else ""
        self._entries = entries_of(leaves)
        self._texts = {name: text for name, text in leaves.items() if isinstance(text, str)}
        # MATLAB's objects count pixels from 1, and multiply rows from the left.
        self._is_matlab = any(name[-1] == "RotationOfCamera2" for name in leaves)
        self._lenses: dict[tuple[str, Size], Lens] = {}

    def found(self) -> Found:
        """Return the calibration. Raises CalibrationError: something is missing, or open and to be asked."""
        devices = self._keyed_devices() or self._devices()
        poses = self._keyed_poses() or self._poses(devices)
        roles = self._roles(devices)
        # Sizes that the file states tell which device is which.
        fitting = [each for each in roles if all(map(self._fits_capture, each, devices))] or roles[:1]
        readings: list[Reading] = []
        for each in fitting:
            try:
                readings += self._readings(devices, each, poses)
            except CalibrationError:
                # Another order may give a lens that cannot be, at another size.
                if each == fitting[0]:
                    raise
        chosen, reason = self._choose(readings)
        unit = self._unit()
        notes = (*chosen.words, chosen.direction + (f", {reason}" if reason else ""))
        notes += (f"lengths in {unit}, as the file says",) if unit else ()
        return Found(chosen.calibration, unit, notes, chosen.sized)

    def _fits_capture(self, role: str, device: Device) -> bool:
        wanted = self._projector if role == PROJECTOR else self._cameras.get(role)
        return wanted is None or device.size is None or device.size == wanted

    def _refuse(self, expected: str, found: str, remedy: str) -> NoReturn:
        raise CalibrationError(f"{self._path}: expected {expected}, found {found}; {remedy}")

    # ---- Lenses

    def _matrices(self) -> Iterator[tuple[Entry, FloatArray, bool]]:
        for entry in self._entries:
            if entry.values.size == 9 and (entry.values.shape == (3, 3) or entry.vector is not None):
                square = entry.values.reshape(3, 3)
                for matrix, transposed in ((square, False), (square.T, True)):
                    if _is_intrinsic(matrix):
                        corner = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]]) if self._is_matlab else 0
                        yield entry, matrix - corner, transposed
                        break

    def _devices(self) -> list[Device]:
        """Return the lenses of the file in its order, those of cameras before that of a projector."""
        matrices = [each for each in self._matrices() if each[0].is_raw] or list(self._matrices())
        common = frozenset.intersection(*(each[0].labels for each in matrices)) if len(matrices) > 1 else frozenset()
        groups: dict[Labels, list[tuple[Entry, FloatArray, bool]]] = {}
        for each in matrices:
            groups.setdefault(each[0].labels - common, []).append(each)
        if len(groups) < 2 and len(matrices) == 2:
            # Names that share all words with a meaning: the order of the file tells them apart.
            groups = {frozenset({str(n)}): [each] for n, each in enumerate(matrices)}
        for labels, group in groups.items():
            if len(group := _distinct(group)) > 1:
                names = ", ".join(each[0].name for each in group)
                self._refuse(f"one matrix of each device, here {' '.join(sorted(labels)) or 'the first'}", names,
                             f"say which, as {KEYS_HELP}")  # fmt: skip
        if len(groups) < 2:
            self._refuse_numbers("the matrices of two devices, each [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels")
        devices = [self._device(labels, common, group[0], list(groups)) for labels, group in groups.items()]
        lacking = [n for n, device in enumerate(devices) if not device.lens_name]
        free = [e for e in self._entries if _owner(e.labels - common, list(groups)) is None and LENS_WORDS & e.words]
        terms, name = self._terms([e for e in free if e.is_raw], matrices[0][0]) if lacking else (np.zeros(5), "")
        if name and len(lacking) > 1:
            self._refuse("the distortion of each device", f"{name} alone", f"say of which it is, as {KEYS_HELP}")
        if name:
            devices[lacking[0]] = replace(devices[lacking[0]], terms=terms, lens_name=name)
        sizes = self._sizes(devices, common)
        devices = [replace(device, size=sizes.get(n)) for n, device in enumerate(devices)]
        return sorted(devices, key=lambda device: (PROJECTOR in device.labels, _order(device.labels)))

    def _refuse_numbers(self, expected: str) -> NoReturn:
        shapes = ", ".join(
            f"{e.name} ({' x '.join(map(str, e.values.shape))})" for e in self._entries if e.values.size > 1
        )
        self._refuse(expected, f"{shapes[:300] or 'no arrays'}",
                     f"name them, as {KEYS_HELP}, or export a file that has them. {KNOWN_HELP}")  # fmt: skip

    def _device(
        self, labels: Labels, common: Labels, matrix: tuple[Entry, FloatArray, bool], others: Sequence[Labels]
    ) -> Device:
        entry, values, transposed = matrix
        own = [e for e in self._entries if _owner(e.labels - common, others) == labels and e.is_raw]
        terms, name = self._terms(own, entry)
        texts = " ".join(
            text
            for path, text in self._texts.items()
            if _MODEL_WORDS & set(split_words(path[-1])) and _owner(labels_of(path) - common, others) in (labels, None)
        )
        if match := _OTHER_MODELS.search(texts):
            self._refuse(
                "a pinhole lens", f"'{match[0]}'", "slrig has no such lens: calibrate with OpenCV's five terms"
            )
        equidistant = _FISHEYE.search(f"{texts} {name} {entry.name}") is not None and terms.size == 4
        return Device(labels, values, _names(entry), terms, name, equidistant, is_transposed=transposed)

    def _terms(self, own: Sequence[Entry], matrix: Entry) -> tuple[FloatArray, str]:
        """Return the distortion among the entries of a device, and its name; zeros without a name if there is none."""
        vectors = [(e, v) for e in own if (v := e.vector) is not None and e.values.size in _TERM_COUNTS]
        named = [(e, v) for e, v in vectors if LENS_WORDS & e.words]
        radial = [each for each in named if "radial" in each[0].words]
        tangential = [each for each in named if "tangential" in each[0].words]
        if radial:
            k = np.zeros(3)
            k[: radial[0][1].size] = radial[0][1][:3]
            p = tangential[0][1][:2] if tangential else np.zeros(2)
            return np.array([k[0], k[1], p[0], p[1], k[2]]), ", ".join(e.name for e, _ in radial[:1] + tangential[:1])
        known = ROTATION_WORDS | TRANSLATION_WORDS | SIZE_WORDS
        by_shape = [(e, v) for e, v in vectors if v.size >= 4 and not known & e.words]
        # Whole numbers are flags and regions.
        found = named or [(e, v) for e, v in by_shape if not v.any() or (v % 1).any()]
        nearest = [(e, v) for e, v in found if e.path[:-1] == matrix.path[:-1]] or found
        nearest = [
            each for n, each in enumerate(nearest) if not any(np.array_equal(each[1], b[1]) for b in nearest[:n])
        ]
        if len(nearest) > 1:
            names = ", ".join(e.name for e, _ in nearest)
            self._refuse(f"one distortion with {matrix.name}", names, f"say which, as {KEYS_HELP}")
        return (nearest[0][1], _names(nearest[0][0])) if nearest else (np.zeros(5), "")

    def _sizes(self, devices: Sequence[Device], common: Labels) -> dict[int, Size]:
        """Return the extents that the file states, by the number of the device."""
        # Width and height have their names; of a pair, the order is open (None) or stated.
        pairs: list[tuple[Labels, float, float, bool | None]] = []
        sides: dict[tuple[str, ...], dict[bool, float]] = {}
        for entry in self._entries:
            words = set(split_words(entry.path[-1]))
            part = _SIDES.fullmatch(re.sub(r"[_.\- ]", "", entry.path[-1].lower()))
            if words & _NOT_IMAGES:
                continue
            if entry.values.size == 2 and SIZE_WORDS & (words | entry.words):
                a, b = entry.values.ravel().tolist()
                pairs.append((entry.labels, a, b, True if "shape" in words or self._is_matlab else None))
            elif part is not None and entry.values.size == 1:
                around = (*entry.path[:-1], part[1])
                sides.setdefault(around, {})[part[2] in _WIDTHS] = float(entry.values.item())
        pairs += [(labels_of(a), both[True], both[False], False) for a, both in sides.items() if len(both) == 2]
        labels = [device.labels for device in devices]
        found: dict[int, tuple[Size, bool | None]] = {}
        for of, a, b, is_rows_first in pairs:
            if not all(float(side).is_integer() and _MIN_SIDE_PX <= side <= MAX_SIDE_PX for side in (a, b)):
                continue
            owner = _owner(of - common, labels)
            numbers = [n for n, each in enumerate(labels) if each == owner]
            if owner is None:
                # The extent of all cameras; that of a projector has its name.
                numbers = [n for n, each in enumerate(labels) if PROJECTOR not in each]
                numbers = numbers if len(numbers) == 1 or self._projector is None else []
            for n in numbers:
                found.setdefault(n, (Size(int(a), int(b)), is_rows_first))
        flip = self._are_rows_first({n: size for n, (size, stated) in found.items() if stated is None}, devices)
        return {
            n: Size(*size.shape) if stated or (stated is None and flip) else size for n, (size, stated) in found.items()
        }

    def _are_rows_first(self, pairs: Mapping[int, Size], devices: Sequence[Device]) -> bool:
        """Return True if pairs are (rows, columns): by the capture, or by the principal points of cameras."""
        wanted = [*self._cameras.values(), *([self._projector] if self._projector else [])]
        fits, turned = (sum(each in wanted for each in sizes) for sizes in (
            pairs.values(), [Size(*each.shape) for each in pairs.values()]
        ))  # fmt: skip
        if fits != turned:
            return turned > fits
        off = np.zeros(2)
        for n, size in pairs.items():
            centre = devices[n].matrix[:2, 2] + 0.5
            if PROJECTOR not in devices[n].labels:
                sides = np.array([size.width_px, size.height_px])
                off += [np.abs(centre / each - 0.5).max() for each in (sides, sides[::-1])]
        return bool(off[1] < 0.5 * off[0])

    def _keyed_devices(self) -> list[Device]:
        """Return the devices that --keys names; none if it names only the pose or sizes."""
        if not any(self._keys.devices.values()):
            return []
        devices = []
        for name, items in self._keys.devices.items():
            own = [entry for item in items for entry in self._named(item)]
            inner = {id(entry) for entry in own}
            matrices = _distinct([each for each in self._matrices() if id(each[0]) in inner])
            if len(matrices) != 1:
                self._refuse(f"one matrix of '{name}' in --keys", f"{len(matrices)} in {', '.join(items)}",
                             f"name it, as {KEYS_HELP}")  # fmt: skip
            entry, values, transposed = matrices[0]
            rest = [e for e in own if e is not entry]
            terms, lens = self._terms(rest, entry)
            if not lens and len(rest) == 1 and rest[0].vector is not None:
                terms, lens = rest[0].values.ravel(), rest[0].name
            equidistant = terms.size == 4 and any(_FISHEYE.search(e.name) for e in own)
            is_only = sum(each != PROJECTOR for each in self._keys.devices) == 1
            labels = entry.labels - {"camera", PROJECTOR} | {"camera" if is_only and name != PROJECTOR else name}
            devices.append(Device(labels, values, _names(entry), terms, lens, equidistant, is_transposed=transposed))
        if len(devices) < 2:
            self._refuse("two devices in --keys", "one", f"name both, as {KEYS_HELP}")
        sizes = self._sizes(devices, frozenset())
        devices = [replace(device, size=sizes.get(n)) for n, device in enumerate(devices)]
        return sorted(devices, key=lambda device: PROJECTOR in device.labels)

    def _named(self, item: str) -> list[Entry]:
        """Return the entries of a name, of the end of one, or of a group."""
        whole = [entry for entry in self._entries if entry.name == item]
        ends = [entry for entry in self._entries if entry.name.endswith(f".{item}")]
        found = whole or ends or [entry for entry in self._entries if f".{item}." in f".{entry.name}"]
        if not found:
            known = ", ".join(entry.name for entry in self._entries if entry.values.size > 1)
            self._refuse(f"the name '{item}' of --keys", f"{known[:300] or 'no arrays'}", "correct it")
        return found

    # ---- Poses

    def _poses(self, devices: Sequence[Device]) -> list[Pose]:
        """Return all pairs of a rotation and a translation, whole poses included, each once."""
        found: list[Pose] = []
        for pose in self._poses_in([entry for entry in self._entries if entry.is_raw], devices):
            if not any(pose.labels == each.labels and pose.equals(each) for each in found):
                found.append(pose)
        return [pose for pose in found if pose.labels or not pose.is_identity]

    def _poses_in(self, entries: Sequence[Entry], devices: Sequence[Device]) -> Iterator[Pose]:
        rotations = [(entry, r) for entry in entries for r in _rotations(entry)]
        named = [each for each in rotations if each[0].words & ROTATION_WORDS]
        translations = [
            entry
            for entry in entries
            if entry.vector is not None and entry.values.size == 3 and not LENS_WORDS & (entry.words - {"d", "k"})
        ]
        of_name = [entry for entry in translations if entry.words & TRANSLATION_WORDS]
        transpose = self._is_matlab or (bool(devices) and all(device.is_transposed for device in devices))
        turns, shifts = named or rotations, of_name or translations
        pairs = [(turn, shift) for turn in turns for shift in shifts if shift is not turn[0]]
        alike = [
            (turn, shift)
            for turn, shift in pairs
            if shift.path[:-1] == turn[0].path[:-1] and shift.labels == turn[0].labels
        ]
        for (entry, rotation), other in alike or (pairs if len(named) == len(of_name) == 1 else []):
            turn = rotation.T if transpose and entry.values.size == 9 else rotation
            stated = entry.words | other.words <= _STATED_WORDS and not (transpose and not self._is_matlab)
            names, vector = f"{entry.name}, {other.name}", other.values.ravel()
            yield _from_to(Pose(entry.labels, turn, vector, names, stated), entry)
        for entry in entries:
            if entry.values.size in (12, 16) and entry.values.shape in ((3, 4), (4, 4), (12,), (16,)):
                rows = entry.values.reshape(-1, 4)
                rotation, vector = rows[:3, :3], rows[:3, 3]
                if len(rows) == 4 and not np.allclose(rows[3], (0, 0, 0, 1)):
                    continue
                nearest = _nearest_rotation(rotation)
                if nearest is not None:
                    yield _from_to(Pose(entry.labels, nearest, vector, entry.name, is_stated=False), entry)

    def _keyed_poses(self) -> list[Pose]:
        """Return the pose that --keys names; none if it names none."""
        if not self._keys.pose:
            return []
        own = [entry for item in self._keys.pose for entry in self._named(item)]
        if len(own) == 2 and all(entry.values.size == 3 for entry in own):
            turn = Rotation.from_rotvec(own[0].values.ravel()).as_matrix()
            return [Pose(frozenset(), turn, own[1].values.ravel(), f"{own[0].name}, {own[1].name}", is_stated=True)]
        found = list(self._poses_in([replace(entry, labels=frozenset(), path=(entry.name,)) for entry in own], []))
        if len(found) != 1:
            self._refuse("a rotation and a translation, or one pose of 3 x 4 or 4 x 4, as pose of --keys",
                         f"{len(found)} poses in {', '.join(self._keys.pose)}", "correct it")  # fmt: skip
        return [replace(found[0], labels=frozenset(), is_stated=True)]

    # ---- Ways to read the file

    def _roles(self, devices: Sequence[Device]) -> list[tuple[str, ...]]:
        """Return names of the devices in their order for each way to name them, the usual one first."""
        count = len(devices)
        projectors = [n for n, device in enumerate(devices) if PROJECTOR in device.labels]
        if len(projectors) > 1:
            self._refuse("one projector", f"{len(projectors)} by their names", f"say which, as {KEYS_HELP}")
        keyed = [name for name in self._keys.devices if name != PROJECTOR]
        known = [*self._cameras] or [_camera_name(device, n) for n, device in enumerate(devices)]
        if any(self._keys.devices.values()):
            own = not self._cameras or set(keyed) <= set(self._cameras)
            names = keyed if own else self._camera_names(known, len(keyed))
            return [(*names, *([PROJECTOR] if projectors else []))]
        if projectors:
            return [(*self._camera_names(known, count - 1), PROJECTOR)]
        if not self._cameras:
            self._refuse(
                "names that say which device is the projector", "; ".join(device.names for device in devices),
                f"say it, as {KEYS_HELP} (left=… right=… for two cameras), or import a capture with it: slrig import "
                "--calibration",
            )  # fmt: skip
        if count == len(self._cameras):
            return [tuple(known)]
        names = self._camera_names(known, count - 1)
        # The usual order is camera, projector; any device may be the projector.
        return [(*names[:n], PROJECTOR, *names[n:]) for n in reversed(range(count))]

    def _camera_names(self, known: Sequence[str], count: int) -> list[str]:
        if count > len(known):
            self._refuse(f"as many cameras as the capture has ({', '.join(known)})", f"{count}",
                         f"say which to use, as {KEYS_HELP}")  # fmt: skip
        return list(known[:count])

    def _readings(self, devices: Sequence[Device], roles: tuple[str, ...], poses: Sequence[Pose]) -> Iterator[Reading]:
        """Yield the calibrations that the devices in these roles have, one for each direction of the pose."""
        sizes = [self._size(role, device, roles) for role, device in zip(roles, devices, strict=True)]
        placed = self._place_devices(devices, poses)
        moved = [(role, pose) for role, pose in zip(roles, placed, strict=True) if pose is not None]
        start = next((role for role, pose in zip(roles, placed, strict=True) if pose is None), "world")
        is_given = bool(self._keys.pose) or self._keys.inverse
        for inverse in [self._keys.inverse] if is_given else [False, True]:
            built: dict[str, Pinhole] = {}
            words = []
            for role, device, size, pose in zip(roles, devices, sizes, placed, strict=True):
                lens = self._lens(device, size)
                put = pose.inverse() if pose is not None and inverse else pose
                rotation, translation = (np.eye(3), np.zeros(3)) if put is None else (put.rotation, put.translation)
                try:
                    built[role] = Pinhole(size, lens.matrix, lens.distortion, rotation, translation)
                except CalibrationError as cause:
                    raise CalibrationError(f"{self._path}: {device.names}: {cause}") from cause
                what = "the projector" if role == PROJECTOR else f"camera '{role}'"
                bare = "" if device.lens_name else ", without distortion, which the file lacks"
                words.append(f"{device.names}: {what}, {size}{bare}" + (f"; {lens.note}" if lens.note else ""))
            yield Reading(
                Calibration({role: each for role, each in built.items() if role != PROJECTOR}, built.get(PROJECTOR)),
                tuple(words),
                frozenset(role for role, device in zip(roles, devices, strict=True) if device.size is not None),
                "; ".join(pose.names for _, pose in moved),
                "; ".join(
                    f"{pose.names}: " + (f"x_{start} = R x_{role} + T" if inverse else f"x_{role} = R x_{start} + T")
                    for role, pose in moved
                ),
                is_given or (all(pose.is_stated for _, pose in moved) and placed[0] is None),
            )

    def _size(self, role: str, device: Device, roles: Sequence[str]) -> Size:
        """Return the extent of a device: as --keys, the file, or the capture states it. Raises CalibrationError."""
        given = self._keys.sizes or {}
        # Sizes of cameras have the capture's names, or come in their order.
        cameras = [name for name in self._keys.devices if name != PROJECTOR]
        place = [each for each in roles if each != PROJECTOR].index(role) if role != PROJECTOR else len(cameras)
        name = role if role in given or place >= len(cameras) else cameras[place]
        found = given.get(name) or device.size or (
            self._projector if role == PROJECTOR else self._cameras.get(role)
        )  # fmt: skip
        if found is None:
            self._refuse(
                "a calibration with the sizes of its images", f"none of {device.names}{self._program}",
                f"import a capture with it: slrig import --calibration; or say them, as {KEYS_HELP}",
            )  # fmt: skip
        return found

    def _lens(self, device: Device, size: Size) -> Lens:
        key = (device.matrix_name, size)
        if key not in self._lenses:
            name = f"{self._path}: {device.lens_name or device.matrix_name}"
            self._lenses[key] = as_lens(device.matrix, device.terms, size, name, equidistant=device.is_equidistant)
        return self._lenses[key]

    def _place_devices(self, devices: Sequence[Device], poses: Sequence[Pose]) -> list[Pose | None]:
        """Return the pose of each device, None for those at the origin. Raises CalibrationError: some are missing."""
        labels = [device.labels for device in devices]
        owners = [(_pose_owner(pose.labels, labels), pose) for pose in poses]
        free = [pose for owner, pose in owners if owner is None]
        if len(devices) == 2 and len(free) == 1:
            return [None, free[0]]
        own = [[pose for owner, pose in owners if owner == each] for each in labels]
        if (len(free) > 1 and len(devices) == 2) or any(len(each) > 1 for each in own):
            names = "; ".join(pose.names for pose in poses)
            self._refuse("one pose between the devices", names, f"say which, as {KEYS_HELP}")
        if sum(not each for each in own) > 1:
            of = "the pose of each device but one" if len(devices) > 2 else "the pose between the devices"
            self._refuse_numbers(
                f"{of}: a rotation (3 x 3, orthonormal, determinant 1, or a rotation vector) and a translation, or "
                "both as 3 x 4 or 4 x 4"
            )
        # A device at the origin needs none.
        return [None if not each or each[0].is_identity else each[0] for each in own]

    def _choose(self, readings: Sequence[Reading]) -> tuple[Reading, str]:
        """Return the reading that the capture agrees with, or the usual one if names state it; and how it was decided.
        Raises CalibrationError: the direction of the pose is open.
        """
        usual = readings[0]
        if len(readings) == 1:
            return usual, ""
        if self._capture is not None:
            first = self._capture.disagreement_px(usual.calibration)
            if first is not None and not (usual.is_stated and first <= _CONTRADICTS_PX):
                scores = [self._capture.disagreement_px(each.calibration) for each in readings[1:]]
                known = [(score, n) for n, score in enumerate(scores, 1) if score is not None]
                (best, place), (second, _) = sorted([(first, 0), *known])[:2]
                if best <= min(_MAX_AGREEING_PX, _AGREES * second):
                    otherwise = f"otherwise to {second:.2g} px" if np.isfinite(second) else "otherwise rays do not meet"
                    agreement = f"columns and rows of the images agree with it to {best:.2g} px (median), {otherwise}"
                    return readings[place], f"decided by the capture: {agreement}"
            if not usual.is_stated:
                shares = [self._capture.share_in_front(each.calibration) for each in readings]
                front = [n for n, share in enumerate(shares) if share is not None and share >= _IN_FRONT]
                behind = [n for n, share in enumerate(shares) if share is not None and share <= _BEHIND]
                if len(front) == 1 and len(behind) == len(shares) - 1:
                    return readings[front[0]], "decided by the capture: otherwise points are behind the devices"
        if not usual.is_stated:
            why = (
                "the capture does not decide it, which columns and rows together do"
                if self._capture is not None
                else "a capture with columns and rows decides it: slrig import --calibration"
            )
            pose = usual.poses.replace(", ", ",")
            self._refuse(
                "a pose whose direction is known", usual.poses, f"{why}. Say --keys 'pose={pose}' if x_projector = "
                f"R x_camera + T, as OpenCV has it, or --keys 'pose={pose},inverse' if x_camera = R x_projector + T",
            )  # fmt: skip
        centred = [each for each in readings if all(map(is_centred, each.calibration.cameras.values()))]
        if centred and usual not in centred:
            self._refuse(
                "the camera before the projector", f"{usual.words[0]}: not in the middle of its principal point, which "
                "that of the other device is", f"say which is which, as {KEYS_HELP}",
            )  # fmt: skip
        return usual, ""

    def _unit(self) -> LengthUnit | None:
        words = [text.lower() for path, text in self._texts.items() if "unit" in path[-1].lower()]
        names = [word for e in self._entries if e.words & TRANSLATION_WORDS for word in split_words(e.path[-1])]
        # A single letter, and cm, may be frames.
        words += [word for word in names if word not in ("m", "cm")]
        return next((_UNITS[word] for word in words if word in _UNITS), None)


def is_centred(device: Pinhole) -> bool:
    """Return True if the principal point is near the middle of the image."""
    sides = np.array([device.size.width_px, device.size.height_px])
    return bool(np.abs((device.matrix[:2, 2] + 0.5) / sides - 0.5).max() <= _MAX_OFF_CENTRE)


def _distinct(matrices: Sequence[tuple[Entry, FloatArray, bool]]) -> list[tuple[Entry, FloatArray, bool]]:
    """Leave out the same matrix again: transposed, or from its parts."""
    return [each for n, each in enumerate(matrices) if not any(np.allclose(each[1], b[1]) for b in matrices[:n])]


def _is_intrinsic(matrix: FloatArray) -> bool:
    fx, fy = matrix[0, 0], matrix[1, 1]
    zero = np.abs([matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1]).max()
    return bool(
        np.isfinite(matrix).all()
        and min(fx, fy) >= _MIN_FOCAL_PX
        and zero <= 1e-6
        and abs(matrix[0, 1]) <= _MAX_SKEW * fx
    )


def _nearest_rotation(matrix: FloatArray) -> FloatArray | None:
    """Return a rotation as it is if it is one, or the one nearest to rounded numbers; None for another matrix."""
    if not np.isfinite(matrix).all() or np.abs(matrix @ matrix.T - np.eye(3)).max() > _ROTATION_ERROR:
        return None
    if np.linalg.det(matrix) < 0:
        return None
    if np.allclose(matrix @ matrix.T, np.eye(3), atol=_EXACT_ROTATION):
        return matrix
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ v)


def _rotations(entry: Entry) -> Iterator[FloatArray]:
    """Yield the rotation of a matrix, or of a vector or a quaternion whose name says so."""
    if entry.values.size == 9 and (entry.values.shape == (3, 3) or entry.vector is not None):
        rotation = _nearest_rotation(entry.values.reshape(3, 3))
        if rotation is not None:
            yield rotation
    elif entry.values.size == 3 and entry.vector is not None and entry.words & ROTATION_WORDS:
        yield Rotation.from_rotvec(entry.values.ravel()).as_matrix()


def _says_from_to(name: str) -> tuple[str, str] | None:
    """Return the devices of a name such as cam2proj or left_to_right."""
    words = [word for word in split_words(name) if labels_of([word]) or word == "to"]
    for a, between, b in zip(words, words[1:], words[2:], strict=False):
        if between in ("2", "to") and a != b:
            return next(iter(labels_of([a]))), next(iter(labels_of([b])))
    return None


def _from_to(pose: Pose, entry: Entry) -> Pose:
    """Return the pose of the device that its name ends with, if it says so: cam2proj maps to the projector's axes."""
    said = _says_from_to(entry.path[-1])
    return pose if said is None else replace(pose, labels=frozenset({said[1]}), is_stated=True)


def _owner(labels: Labels, devices: Sequence[Labels]) -> Labels | None:
    """Return the labels of the device that an entry is of; None if it may be any's."""
    found = [each for each in devices if each and each <= labels]
    if len(found) > 1:
        # `proj_camera_matrix` is of the projector.
        found = [each for each in found if PROJECTOR in each] or found
        found = [max(found, key=len)]
    if found:
        return found[0]
    return frozenset() if frozenset() in devices else None


def _pose_owner(labels: Labels, devices: Sequence[Labels]) -> Labels | None:
    """Return the labels of the device that a pose is of; None if it is between devices."""
    found = [each for each in devices if each and each <= labels]
    return found[0] if len(found) == 1 else None


def _order(labels: Labels) -> tuple[int, str]:
    """Sort numbers by their value, left before right, others as the file has them."""
    number = min((each for each in labels if each.isdigit()), key=lambda each: (len(each), each), default="")
    return (len(number), number) if number else (0, "right" if "right" in labels else "")


def _names(entry: Entry) -> str:
    return ", ".join(entry.parts) or entry.name


def _camera_name(device: Device, number: int) -> str:
    word = next((each for each in ("left", "right") if each in device.labels), "")
    return word or f"cam{number}"
