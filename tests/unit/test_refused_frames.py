"""Frames that were refused lie beside a bundle and not in it; a capture that was cut short leaves what it has."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from slrig.bundle import BundleWriter, read_bundle
from slrig.bundle.refused import Refused, read_refused
from slrig.errors import BundleError, ScanEvidenceError
from slrig.model import Black, CameraFormat, Shot, Size, White

FORMATS = {"left": CameraFormat(Size(64, 48), 8), "right": CameraFormat(Size(64, 48), 8)}


def shot(pattern: int, camera: str = "left", *, level: int = 0, time_s: float = 0.0) -> Shot:
    return Shot(pattern, camera, np.full((48, 64), level, np.uint8), 0.01, time_s)


def writer(folder: Path) -> BundleWriter:
    return BundleWriter(folder, Size(64, 40), (White(), Black(), White()), FORMATS)


def listed(folder: Path) -> list[tuple[int, str, int]]:
    return [(each.pattern, each.camera, int(each.image[0, 0])) for each in read_bundle(folder).capture.shots]


def test_a_frame_that_was_shot_again_takes_the_place_of_the_first(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    with writer(folder) as bundle:
        bundle.add(shot(0, level=10))
        bundle.add(shot(1, level=11, time_s=0.1))
        bundle.refuse(Refused(1, "left", 1, "it equals pattern 0", delivered=True))
        bundle.add(shot(2, level=12))
        bundle.add(shot(1, level=21, time_s=0.3))
    assert listed(folder) == [(0, "left", 10), (1, "left", 21), (2, "left", 12)]
    (entry,) = json.loads((folder / "refused" / "refused.json").read_text())["frames"]
    assert entry == {
        "pattern": 1, "camera": "left", "attempt": 1, "cause": "it equals pattern 0", "file": "refused/000.png",
        "exposure_s": 0.01, "time_s": 0.1,
    }  # fmt: skip
    image = cv2.imread(str(folder / entry["file"]), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image[0, 0] == 11
    assert read_refused(folder) == (Refused(1, "left", 1, "it equals pattern 0"),)


def test_a_frame_that_failed_first_keeps_its_place(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    with writer(folder) as bundle:
        bundle.refuse(Refused(0, "left", 1, "damaged", shot(0, level=99)))
        bundle.refuse(Refused(0, "right", 1, "no frame came"))
        bundle.add(shot(1, level=11))
        bundle.add(shot(0, "right", level=20))
        bundle.add(shot(0, level=10))
    assert listed(folder) == [(0, "left", 10), (0, "right", 20), (1, "left", 11)]
    entries = json.loads((folder / "refused" / "refused.json").read_text())["frames"]
    assert [each.get("file") for each in entries] == ["refused/000.png", None]
    assert [path.name for path in sorted((folder / "refused").iterdir())] == ["000.png", "refused.json"]


def test_only_what_is_taken_back_is_taken_back(tmp_path: Path) -> None:
    # The same pattern at two exposures, as a bracket has it: a frame that did not come leaves the other one alone.
    folder = tmp_path / "bundle"
    with writer(folder) as bundle:
        bundle.add(shot(0, level=10))
        bundle.refuse(Refused(0, "left", 1, "no frame came"))
        bundle.add(shot(0, level=40))
    assert listed(folder) == [(0, "left", 10), (0, "left", 40)]


def test_a_bundle_without_refused_frames_has_no_such_folder(tmp_path: Path) -> None:
    with writer(tmp_path / "bundle") as bundle:
        bundle.add(shot(0))
    assert not (tmp_path / "bundle" / "refused").exists()
    assert read_refused(tmp_path / "bundle") == ()


def cut_short(folder: Path, *, keep: bool, taken: bool = True) -> None:
    with writer(folder) as bundle:
        if taken:
            bundle.add(shot(0, level=10))
            bundle.add(shot(1, level=11))
        bundle.refuse(Refused(1, "left", 1, "stale", delivered=taken))
        if keep:
            bundle.keep("pattern 1 failed 3 times")
        message = "pattern 1 failed 3 times"
        raise ScanEvidenceError(message)


def test_a_capture_that_was_cut_short_keeps_its_frames_on_request(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    with pytest.raises(ScanEvidenceError):
        cut_short(folder, keep=True)
    assert listed(folder) == [(0, "left", 10)]
    assert json.loads((folder / "refused" / "refused.json").read_text())["ended"] == "pattern 1 failed 3 times"
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


def test_a_capture_that_failed_at_its_first_frame_leaves_the_cause(tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    with pytest.raises(ScanEvidenceError):
        cut_short(folder, keep=True, taken=False)
    with pytest.raises(BundleError, match="a folder without it"):
        read_bundle(folder)
    assert [each.cause for each in read_refused(folder)] == ["stale"]


def test_other_errors_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(ScanEvidenceError):
        cut_short(tmp_path / "bundle", keep=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"format": "slrig-refused", "version": 2, "frames": []}', "version"),
        ('{"format": "slrig-refused", "frames": [{"pattern": -1}]}', "pattern"),
        ("[", "expected JSON"),
    ],
)
def test_a_list_that_slrig_did_not_write_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "refused").mkdir()
    (tmp_path / "refused" / "refused.json").write_text(text)
    with pytest.raises(BundleError, match=words):
        read_refused(tmp_path)
