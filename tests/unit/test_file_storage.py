"""OpenCV's FileStorage as others write it, and what is refused of it, with its line."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slrig.bundle import (
    check_calibration,
    read_bundle,
    read_calibration,
    read_opencv_calibration,
    write_bundle,
    write_calibration,
    write_opencv_calibration,
)
from slrig.bundle.file_storage import read_file_storage
from slrig.errors import CalibrationError
from slrig.model import Calibration, LightMap, Size
from tests.samples import CAMERA, PROJECTOR, pinhole, sample_calibration, sample_capture
from tests.strangers import solved_calibration

HEAD = "%YAML:1.0\n---\n"
PATH = Path("rig.yml")


def _in_xml(text: str) -> str:
    return f'<?xml version="1.0"?>\n<opencv_storage>\n{text}\n</opencv_storage>\n'


def _matrix(dt: str = "d", data: str = "1., 2.", rows: str = "1", kind: str = "opencv-matrix") -> str:
    return f"{HEAD}m: !!{kind}\n   rows: {rows}\n   cols: 2\n   dt: {dt}\n   data: [ {data} ]\n"


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (HEAD + "a: 1\nb: -2.5e-3 # why\nc: .Nan\nd: -.Inf\ne: 5.e-01\nf: 1.\n",
         {"a": 1, "b": -0.0025, "c": np.nan, "d": -np.inf, "e": 0.5, "f": 1.0}),
        ("\ufeff%YAML 1.2\r\n---\r\na:\r\n   b:\r\n      c: x y\r\n   d: 'it''s'\r\n...\r\n",
         {"a": {"b": {"c": "x y"}, "d": "it's"}}),
        (HEAD + '# of the bench\na: "q\\"\\\\ \\x41 # no comment"\nempty:\nlist: [ 1, x ]\n',
         {"a": 'q"\\ A # no comment', "empty": {}, "list": [1, "x"]}),
        (HEAD + 'a:\n- 1\n- b: 2\n  c: [ [ 1., "], {" ], { "x": 1, \'y\' : [ 2,\n  3 ], z:w } ]\n-\n   - x\n'
         "d: !!binary |\n  AA=\ns: !!opencv-sparse-matrix\n   rows: 1\n",
         {"a": [1, {"b": 2, "c": [[1.0, "], {"], {"x": 1, "y": [2, 3], "z": "w"}]}, ["x"]], "d": "AA=",
          "s": {"rows": 1}}),
        # No `---`, deeper indentation, and closed on a line of its own: what scripts for Matlab write.
        ("%YAML:1.0\n    m: !!opencv-matrix\n        rows: 1\n        cols: 2\n        dt: f\n"
         "        data: [ 0.5, \n            0.25]\n", {"m": [[0.5, 0.25]]}),
        (_in_xml('<a>1</a><!-- why --><b>"x &lt;&#65;&quot;"</b>\n<c><d>-1e-3</d></c><e>1 2</e>'),
         {"a": 1, "b": 'x <A"', "c": {"d": -0.001}, "e": [1, 2]}),
        (_in_xml('<m type_id="opencv-matrix"><rows>2</rows><cols>1</cols><dt>i</dt><data>\n 7 -8</data></m>'),
         {"m": [[7], [-8]]}),
        # An array of one dimension, as OpenCV 5 writes it.
        (HEAD + "m: !!opencv-nd-matrix\n   sizes: [ 2 ]\n   dt: d\n   data: [ 1., 2. ]\n", {"m": [1, 2]}),
        (_in_xml('<m type_id="opencv-nd-matrix"><sizes>\n 1</sizes><dt>d</dt><data>\n 7.</data></m>'), {"m": [7]}),
    ],
)  # fmt: skip
def test_files_of_other_programs_are_read(text: str, wanted: dict[str, object]) -> None:
    found = read_file_storage(text, PATH)
    assert list(found) == list(wanted)
    for key, value in wanted.items():
        np.testing.assert_equal(np.asarray(found[key]).tolist() if "m" in wanted else found[key], value)


def test_single_precision_is_that_of_opencv() -> None:
    storage = cv2.FileStorage(".yml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    numbers = np.random.default_rng(1).normal(size=(5, 7)).astype(np.float32)
    storage.write("m", numbers)
    np.testing.assert_array_equal(np.asarray(read_file_storage(storage.releaseAndGetString(), PATH)["m"]), numbers)


NESTED = 40_000
REFUSED = {
    "nd-matrix of 64 sizes": (
        f"{HEAD}m: !!opencv-nd-matrix\n   sizes: [ {', '.join(['1'] * 64)} ]\n   dt: d\n   data: [ 1. ]\n",
        "extent of 'm'",
    ),
    "dt of 65 pairs": (_matrix(dt='"' + "1d" * 65 + '"'), "i, f or d as dt of 'm'"),
    "dt of three channels": (_matrix(dt='"3d"'), "expected 6 numbers as data of 'm', found 2"),
    "too few numbers": (_matrix(data="1."), "expected 2 numbers as data of 'm', found 1 at line 3"),
    "a vast extent": (_matrix(rows="65536"), "expected 131072 numbers as data of 'm', found 2"),
    "a vaster extent": (_matrix(rows="9" * 18), "whole numbers from 0 as extent"),
    "no extent": (_matrix(rows="-1", data=""), "whole numbers from 0 as extent"),
    "too many numbers": (_matrix(data="1," * 70_000), "at most 65536 numbers"),
    "a fraction in whole numbers": (_matrix(dt="i"), "numbers of the kind 'i'"),
    "a vast whole number": (_matrix(dt="i", data="1, 2147483648"), "numbers of the kind 'i'"),
    "words in a matrix": (_matrix(data="1., 0x10"), "numbers of the kind 'd'"),
    "a matrix without data": (HEAD + "m: !!opencv-matrix\n   rows: 1\n", "cols, data, dt, rows in 'm', found rows"),
    "deep YAML": (HEAD + "".join(" " * each + "a:\n" for each in range(1500)), "at most 16 maps and"),
    "deep sequences": (HEAD + "a: " + "[" * NESTED + "\n", "at most 16 maps and"),
    "deep flow maps": (HEAD + "a: " + "{a: " * NESTED + "\n", "at most 16 maps and"),
    "deep dashes": (HEAD + "a:\n  " + "- " * NESTED + "1\n", "at most 16 maps and"),
    "an open sequence": (HEAD + "a: [ 1,\n   { x:1 }\nb: 2\n", "expected a sequence that ends"),
    "brackets that cross": (HEAD + "a: [ { x:1 ] }\n", "brackets that close as they open"),
    "deep XML": (_in_xml("<a>" * NESTED + "</a>" * NESTED), "at most 16 maps and"),
    "an anchor": (HEAD + "a: &x 1\nb: *x\n", "found '&x 1' at line 3"),
    "a second document": (HEAD + "a: 1\n...\n---\nb: 2\n", "found '...' at line 4"),
    "a key twice": (HEAD + "a: 1\na: 2\n", "'a' twice at line 4"),
    "a long key": (HEAD + "a" * 65 + ": 1\n", "a key of at most 64"),
    "many keys": (HEAD + "".join(f"a{each}: 1\n" for each in range(65_537)), "at most 65536 entries"),
    "uneven indentation": (HEAD + "a:\n   b: 1\n  c: 2\n", "column 3 at line 5"),
    "a tab": (HEAD + "a:\n\tb: 1\n", "indented with spaces"),
    "an open quote": (HEAD + 'a: "x\n', "found '\"x' at line 3"),
    "NUL": (HEAD + "a: x\0y\n", r"control character '\x00' at line 3"),
    "another version": ("%YAML 2.0\n---\na: 1\n", "%YAML:1.0 or"),
    "laughs": (
        '<?xml version="1.0"?>\n<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>\n'
        "<opencv_storage><a>&b;</a></opencv_storage>",
        "found a document type, an entity or an instruction at line 2",
    ),
    "an unknown entity": (_in_xml("<a>&b;</a>"), "undefined entity at line 3"),
    "a NUL of XML": (_in_xml("<a>&#0;</a>"), "expected sound XML"),
    "cut XML": (_in_xml("<a><b>1</b></a>")[:-12], "expected sound XML"),
    "other XML": ("<svg></svg>", "expected <opencv_storage>, found 'svg'"),
    "text beside elements": (_in_xml("<a>x<b>1</b></a>"), "both in one element"),
    "text behind elements": (_in_xml("<a><b>1</b>x</a>"), "both in one element"),
    "an attribute": (_in_xml('<a href="x">1</a>'), "no attribute but type_id"),
    "an empty matrix of XML": (_in_xml('<a type_id="opencv-matrix"></a>'), "an opencv-matrix with rows"),
    "other encodings": ('<?xml version="1.0" encoding="no-such"?><opencv_storage>\n<</opencv_storage>', "sound XML"),
}


@pytest.mark.parametrize("ending", [".yml", ".xml"])
def test_all_that_opencv_writes_is_read(ending: str) -> None:
    storage = cv2.FileStorage(ending, cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    points = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    storage.write("empty", np.zeros((0, 0)))
    storage.write("points", points)
    storage.write("bytes", np.array([[1, 255]], dtype=np.uint8))
    storage.write("texts", ["a", "b c"])
    for kind in (cv2.FileNode_SEQ, cv2.FileNode_SEQ | cv2.FileNode_FLOW):
        storage.startWriteStruct(f"sequence{kind}", kind)
        storage.write("", 1)
        storage.startWriteStruct("", cv2.FileNode_MAP | (kind & cv2.FileNode_FLOW))
        storage.write("x", 1.5)
        storage.write("name", "b c")
        storage.endWriteStruct()
        storage.startWriteStruct("", kind)
        storage.write("", 7)
        storage.endWriteStruct()
        storage.endWriteStruct()
    storage.startWriteStruct("none", cv2.FileNode_SEQ)
    storage.endWriteStruct()
    storage.writeComment("why", append=False)
    storage.write("last", np.eye(2))
    found = read_file_storage(storage.releaseAndGetString(), PATH)
    items = [1, {"x": 1.5, "name": "b c"}, 7 if ending == ".xml" else [7]]
    wanted = {"empty": np.zeros((0, 0)), "points": points, "bytes": np.array([[1, 255]]), "texts": ["a", "b c"]}
    wanted |= {f"sequence{kind}": items for kind in (cv2.FileNode_SEQ, cv2.FileNode_SEQ | cv2.FileNode_FLOW)}
    np.testing.assert_equal(found, wanted | {"none": [] if ending == ".yml" else {}, "last": np.eye(2)})


@pytest.mark.parametrize("case", REFUSED)
def test_all_else_is_refused_with_its_line(case: str) -> None:
    text, words = REFUSED[case]
    before = time.process_time()
    with pytest.raises(CalibrationError, match=re.escape(words)) as caught:
        read_file_storage(text, PATH)
    assert time.process_time() - before < 1
    assert re.search(r"at line \d+; ", str(caught.value))
    assert len(str(caught.value)) < 400


# ---- calibration.json and OpenCV FileStorage: every fault is told with its place, nothing is guessed


Edit = Callable[[dict[str, Any]], object]
DEVICE = (
    "{name}:\n   image_width: 40\n   image_height: 30\n"
    "   camera_matrix: !!opencv-matrix\n      rows: 3\n      cols: 3\n      dt: d\n"
    "      data: [ 50., 0., 20., 0., 50., 15., 0., 0., 1. ]\n"
    "   distortion_coefficients: !!opencv-matrix\n      rows: 1\n      cols: {terms}\n      dt: d\n"
    "      data: [ {distortion} ]\n"
    "   rotation: !!opencv-matrix\n      rows: 3\n      cols: 3\n      dt: d\n"
    "      data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]\n"
    "   translation_mm: !!opencv-matrix\n      rows: 3\n      cols: 1\n      dt: d\n      data: [ 0., 0., 500. ]\n"
)


def _yaml(*distortion: float, name: str = "left") -> str:
    terms = ", ".join(f"{value}" if np.isfinite(value) else ".Nan" for value in distortion)
    return "%YAML:1.0\n---\n" + DEVICE.format(name=name, terms=len(distortion), distortion=terms)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_calibration(tmp_path / "calibration.json", sample_calibration())
    return tmp_path / "calibration.json"


MIRROR = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda data: data["projector"].update(rotatoin=[]), ("projector.rotatoin: unknown key", "mean 'rotation'?")),
        (lambda data: data["cameras"]["left"].pop("matrix"), ("cameras.left.matrix: missing",)),
        (lambda data: data["cameras"]["left"]["distortion"].pop(), ("cameras.left.distortion", "at least 5 items")),
        (lambda data: data["projector"]["matrix"].__setitem__(1, ["nan", 1, 0]), ("matrix[1][0]", "found 'nan'")),
        (lambda data: data["projector"]["matrix"].__setitem__(1, [None, 1, 0]), ("matrix[1][0]", "found None")),
        (
            lambda data: data["cameras"]["right"].update(rotation=MIRROR),
            ("cameras.right.rotation: expected an orthonormal right-handed", "determinant -1"),
        ),
        (
            lambda data: data["projector"].update(matrix=[[0, 0, 0], [0, 1, 0], [0, 0, 1]]),
            ("projector.matrix: expected", "positive fx and fy"),
        ),
        (lambda data: data.update(cameras={}), ("cameras", "at least 1 item")),
        (lambda data: data.update(format="slrig-bundle"), ("format", "'slrig-calibration'")),
    ],
)
def test_a_bad_calibration_is_refused_with_the_place_of_its_fault(
    path: Path, change: Edit, parts: tuple[str, ...]
) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(CalibrationError) as caught:
        read_calibration(path)
    assert all(part in str(caught.value) for part in (str(path), *parts))


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999"])
def test_a_number_that_is_not_finite_is_refused(path: Path, number: str) -> None:
    path.write_text(path.read_text().replace("500.0", number, 1))
    with pytest.raises(CalibrationError, match=r"(?s)calibration\.json.*(found (NaN|Infinity)|finite number)"):
        read_calibration(path)


def test_a_cut_or_missing_calibration_is_refused(path: Path) -> None:
    text = path.read_text()
    path.write_text(text[: len(text) // 2])
    with pytest.raises(CalibrationError, match="expected JSON, found a fault at line"):
        read_calibration(path)
    with pytest.raises(CalibrationError, match=r"none\.json: no such file"):
        read_calibration(path.with_name("none.json"))


def test_every_device_of_another_size_is_named() -> None:
    with pytest.raises(CalibrationError) as caught:
        check_calibration(sample_calibration(), Size(5, 6), {"left": Size(7, 8), "right": CAMERA}, "here")
    assert str(caught.value).splitlines()[1:] == [
        "  cameras.left: expected 7 x 8 as the camera's frames are, found 40 x 30",
        "  projector: expected 5 x 6 as the projector is, found 32 x 24",
    ]


@pytest.mark.parametrize("ending", ["yml", "yaml", "xml"])
def test_opencv_reads_our_exports(tmp_path: Path, ending: str) -> None:
    calibration = solved_calibration()
    write_opencv_calibration(tmp_path / f"rig.{ending}", calibration)
    storage = cv2.FileStorage(str(tmp_path / f"rig.{ending}"), cv2.FileStorage_READ)
    for name, camera in calibration.cameras.items():
        np.testing.assert_array_equal(storage.getNode(name).getNode("camera_matrix").mat(), camera.matrix)
        np.testing.assert_array_equal(storage.getNode(name).getNode("rotation").mat(), camera.rotation)
        assert storage.getNode(name).getNode("image_width").real() == camera.size.width_px
    assert len(storage.getNode("solved").getNode("covariance").mat()) % 15 == 0
    storage.release()


def test_distortion_terms_that_are_missing_or_higher_are_zero(tmp_path: Path) -> None:
    for terms, fifth in (((0.1, 0.2, 0.3, 0.4), 0.0), ((0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0), 0.5)):
        (tmp_path / "rig.yml").write_text(_yaml(*terms))
        calibration = read_opencv_calibration(tmp_path / "rig.yml")
        np.testing.assert_array_equal(calibration.cameras["left"].distortion, [*terms[:4], fifth])
        assert calibration.projector is None
    (tmp_path / "rig.yml").write_text(_yaml(0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.7, 0.0))
    with pytest.raises(CalibrationError, match=r"at most k3 as distortion of 'left', found .*0\.7"):
        read_opencv_calibration(tmp_path / "rig.yml")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", r"rig\.yml: expected"),
        ("some words", r"rig\.yml: expected"),
        ("%YAML:1.0\n---\n[ 1, 2", r"rig\.yml: expected"),
        ("%YAML:1.0\n---\nname: bench\n", "'name', found no image_width"),
        (_yaml(0.1, 0.2), "k1, k2, p1, p2"),
        (_yaml(0.1, float("nan"), 0, 0, 0), r"left\.distortion: every number must be finite"),
        (_yaml(0, 0, 0, 0, name="projector"), "one map per device, found projector"),
        (_yaml(0, 0, 0, 0).replace("image_width: 40", "image_width: 40.5"), "whole numbers as extent of 'left'"),
        (_yaml(0, 0, 0, 0).replace("image_width: 40", "image_width: 0"), "whole numbers as extent of 'left'"),
        (_yaml(0, 0, 0, 0) + "   skew: 1\n", "unknown key skew"),
        (_yaml(0, 0, 0, 0).replace("image_width: 40", "width: 40"), "found no image_width, the unknown key width"),
    ],
)
@pytest.mark.usefixtures("capfd")
def test_a_bad_opencv_file_is_refused(tmp_path: Path, text: str, part: str) -> None:
    (tmp_path / "rig.yml").write_text(text)
    with pytest.raises(CalibrationError, match=part):
        read_calibration(tmp_path / "rig.yml")


@pytest.mark.parametrize(("name", "file"), [("projector", "rig.yml"), ("0left", "rig.yml"), ("left", "rig.json")])
def test_names_that_opencv_cannot_hold_are_refused(tmp_path: Path, name: str, file: str) -> None:
    with pytest.raises(CalibrationError, match=r"rig.*expected"):
        write_opencv_calibration(tmp_path / file, Calibration({name: pinhole()}, None))
    assert list(tmp_path.iterdir()) == []


def light_map(*middles: float) -> LightMap:
    """Light of so much in the middle of each channel, e times as much at the right end."""
    coefficients = np.zeros((len(middles), 5, 5))
    coefficients[:, 0, 0], coefficients[:, 1, 0] = np.log(middles), 1
    return LightMap(coefficients, np.array([[0.0, 0.0], [PROJECTOR.width_px - 1.0, PROJECTOR.height_px - 1.0]]))


def test_the_projectors_light_travels_with_the_calibration_and_with_every_bundle(tmp_path: Path) -> None:
    sent = replace(sample_calibration(), light=light_map(1.0, 2.0, 0.5))
    write_calibration(tmp_path / "calibration.json", sent)
    write_bundle(tmp_path / "bundle", sample_capture(), calibration=read_calibration(tmp_path / "calibration.json"))
    found = read_bundle(tmp_path / "bundle").calibration
    assert found is not None
    assert found.light is not None
    np.testing.assert_array_equal(found.light.coefficients, light_map(1.0, 2.0, 0.5).coefficients)
    np.testing.assert_array_equal(found.light.covered_px, light_map(1.0).covered_px)
    # What is known of its devices is the same calibration.
    assert found.solve_id == sample_calibration().solve_id
    write_calibration(tmp_path / "older.json", sample_calibration())
    assert "light" not in json.loads((tmp_path / "older.json").read_text())
    assert read_calibration(tmp_path / "older.json").light is None


def test_a_light_map_of_another_form_is_refused_with_its_place(path: Path) -> None:
    data = json.loads(path.read_text())
    data["light"] = {"coefficients": [[[0.0] * 4] * 5], "covered_px": [[0, 0]]}
    path.write_text(json.dumps(data))
    with pytest.raises(CalibrationError) as told:
        read_calibration(path)
    assert "light.coefficients" in str(told.value)
    assert "light.covered_px" in str(told.value)


def test_light_is_given_in_the_wanted_channels_and_within_the_measured_area() -> None:
    end, middle_row = PROJECTOR.width_px - 1.0, (PROJECTOR.height_px - 1) / 2
    places = np.array([[end / 2, middle_row], [end, 0.0], [2 * end, middle_row]])
    whole = light_map(1.0, 2.0, 0.6).light(places, PROJECTOR, 3)
    np.testing.assert_allclose(whole, np.outer([1, math.e, math.e], [1.0, 2.0, 0.6]))
    np.testing.assert_allclose(
        light_map(1.0, 2.0, 0.6).light(places, PROJECTOR, 1), [[1.2], [1.2 * math.e], [1.2 * math.e]]
    )
    assert light_map(1.5).light(places, PROJECTOR, 3).shape == (3, 1)


@pytest.mark.parametrize("ending", ["yml", "yaml", "xml"])
def test_by_way_of_opencv_it_is_the_same_as_json(tmp_path: Path, ending: str) -> None:
    write_calibration(tmp_path / "a.json", solved_calibration())
    write_opencv_calibration(tmp_path / f"b.{ending}", read_calibration(tmp_path / "a.json"))
    write_calibration(tmp_path / "c.json", read_calibration(tmp_path / f"b.{ending}"))
    # FileStorage writes a negative zero as zero.
    found, before = ((tmp_path / name).read_text().replace("-0.0,", "0.0,") for name in ("c.json", "a.json"))
    assert found == before


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("solved_at:", "solved_on:", "no solved_at, the unknown key solved_on; leave the whole map out"),
        ("expected_error_mm: 0.0071", "expected_error_mm: -0.0071", "expected_error_mm of 0 or more, found -0.0"),
        (
            "expected_error_mm: 0.00711",
            'expected_error_mm: "x" # 0.00711',
            "numbers as expected_error_mm and scale_sigma",
        ),
        ("id: a1b2", "id: [ 1 ]", "text as id and solved_at"),
    ],
)
def test_a_fault_of_the_map_solved_is_reported_with_its_place(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "bench.yml"
    write_opencv_calibration(path, solved_calibration())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(CalibrationError) as caught:
        read_opencv_calibration(path)
    assert str(path) in str(caught.value)
    assert words in str(caught.value)


def test_a_covariance_for_other_devices_is_refused(tmp_path: Path) -> None:
    calibration = solved_calibration()
    write_opencv_calibration(tmp_path / "bench.xml", calibration)
    storage = cv2.FileStorage(str(tmp_path / "bench.xml"), cv2.FILE_STORAGE_READ)
    covariance = storage.getNode("solved").getNode("covariance").mat()
    storage.release()
    assert covariance is not None
    fewer = Calibration(dict(list(calibration.cameras.items())[:1]), None, None)
    solved = calibration.solved
    assert solved is not None
    object.__setattr__(fewer, "solved", solved)
    write_opencv_calibration(tmp_path / "fewer.yml", fewer)
    with pytest.raises(CalibrationError, match=r"solved\.covariance: expected 15 rows for each of 1 devices"):
        read_opencv_calibration(tmp_path / "fewer.yml")


def test_a_camera_cannot_have_its_name(tmp_path: Path) -> None:
    calibration = sample_calibration()
    named = Calibration({"solved": next(iter(calibration.cameras.values()))}, None)
    with pytest.raises(CalibrationError, match="are not 'projector' or 'solved', found 'solved'"):
        write_opencv_calibration(tmp_path / "bench.yml", named)
