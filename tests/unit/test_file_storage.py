"""OpenCV's FileStorage as others write it, and what is refused of it, with its line."""

from __future__ import annotations

import re
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from slrig.bundle.file_storage import read_file_storage
from slrig.errors import CalibrationError

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
def test_what_others_write_is_read(text: str, wanted: dict[str, object]) -> None:
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
    "dt of 65 pairs": (_matrix(dt='"' + "1d" * 65 + '"'), "d, f or i as dt of 'm'"),
    "dt of three channels": (_matrix(dt='"3d"'), "d, f or i as dt of 'm'"),
    "sparse": (_matrix(kind="opencv-sparse-matrix"), "found 'opencv-sparse-matrix' at line 3"),
    "too few numbers": (_matrix(data="1."), "expected 2 numbers as data of 'm', found 1 at line 3"),
    "a vast extent": (_matrix(rows="65536"), "expected 131072 numbers as data of 'm', found 2"),
    "a vaster extent": (_matrix(rows="9" * 18), "whole numbers from 1 as extent"),
    "no extent": (_matrix(rows="0", data=""), "whole numbers from 1 as extent"),
    "too many numbers": (_matrix(data="1," * 70_000), "at most 65536 numbers"),
    "a fraction in whole numbers": (_matrix(dt="i"), "numbers of the kind 'i'"),
    "a vast whole number": (_matrix(dt="i", data="1, 2147483648"), "numbers of the kind 'i'"),
    "words in a matrix": (_matrix(data="1., 0x10"), "numbers of the kind 'd'"),
    "a matrix without data": (HEAD + "m: !!opencv-matrix\n   rows: 1\n", "cols, data, dt, rows in 'm', found rows"),
    "deep YAML": (HEAD + "".join(" " * each + "a:\n" for each in range(1500)), "at most 8 maps in each other"),
    "deep sequences": (HEAD + "a: " + "[" * NESTED + "\n", "expected a sequence that ends in ]"),
    "deep flow maps": (HEAD + "a: " + "{a: " * NESTED + "\n", "expected a number, text or an opencv-matrix"),
    "deep XML": (_in_xml("<a>" * NESTED + "</a>" * NESTED), "at most 8 maps in each other"),
    "an anchor": (HEAD + "a: &x 1\nb: *x\n", "found '&x 1' at line 3"),
    "a block sequence": (HEAD + "a:\n   - 1\n", "found '   - 1' at line 4"),
    "a second document": (HEAD + "a: 1\n...\n---\nb: 2\n", "found '...' at line 4"),
    "a key twice": (HEAD + "a: 1\na: 2\n", "'a' twice at line 4"),
    "a long key": (HEAD + "a" * 65 + ": 1\n", "a key of at most 64"),
    "many keys": (HEAD + "".join(f"a{each}: 1\n" for each in range(4097)), "at most 4096 entries"),
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


@pytest.mark.parametrize("case", REFUSED)
def test_all_else_is_refused_with_its_line(case: str) -> None:
    text, words = REFUSED[case]
    before = time.process_time()
    with pytest.raises(CalibrationError, match=re.escape(words)) as caught:
        read_file_storage(text, PATH)
    assert time.process_time() - before < 1
    assert re.search(r"at line \d+; ", str(caught.value))
    assert len(str(caught.value)) < 400
