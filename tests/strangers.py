"""Files as strangers send them: good calibrations, frames and bundles, and what becomes of them when they are harmed.

All of it is made from a seed, so that a file that does harm can be made again.
"""

from __future__ import annotations

import json
import random
import tempfile
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import tifffile

from slrig.bundle import write_bundle, write_calibration, write_opencv_calibration
from slrig.model import Calibration, SolveRecord
from tests.samples import CAMERA, sample_calibration, sample_capture

TOKENS = (
    *(b"!!opencv-matrix", b"!!opencv-nd-matrix", b"!!opencv-sparse-matrix", b"sizes: [ 1, 1 ]", b'dt: "65d"', b"dt: u"),
    *(b"%YAML:1.0\n---\n", b"---\n", b"...\n", b"&a ", b"*a", b"- ", b"{ a:1 }", b"[ ", b"]", b"{}", b'"', b"'", b"# "),
    *(b"<!DOCTYPE a>", b"<![CDATA[", b"&lt;", b"&x;", b"&#0;", b"<_>", b"</_>", b"<!--", b"-->", b'type_id="str"'),
    *(b"1e999", b"-1", b"0", b"9" * 40, b"1e308", b".Nan", b".Inf", b"NaN", b"null", b"true", b"0x10", b"4294967295"),
    *(b"\0", b"\t", b"\n", b"\r", b"\xff", b"\xef\xbb\xbf", b"\x1b[2J", b"\xed\xa0\x80", b"\\ud800", b"a" * 5000),
    *(b"solved", b"projector", b"..", b"/", b"2026-11-22", b"yesterday"),
)


def solved_calibration(seed: int = 0) -> Calibration:
    """A calibration that states its error."""
    calibration = sample_calibration()
    count = 15 * (len(calibration.cameras) + (calibration.projector is not None))
    root = np.random.default_rng(seed).normal(size=(count, count)) * np.geomspace(1e-8, 1e2, count)[:, None]
    box = np.array([[-60.5, -40, 400], [60, 40.25, 520]])
    return replace(calibration, solved=SolveRecord("a1b2", "2026-11-22T06:12:49+00:00", root @ root.T, box, 0.00712))


def good_calibrations() -> list[tuple[str, bytes]]:
    """Ending and text of sound calibrations, with and without what they say of their error."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for calibration in (sample_calibration(), solved_calibration()):
            for ending in (".json", ".yml", ".xml"):
                path = Path(folder) / f"rig{ending}"
                write = write_calibration if ending == ".json" else write_opencv_calibration
                write(path, calibration)
                found.append((ending, path.read_bytes()))
    return found


def good_frames() -> list[bytes]:
    """Sound frames of the sample's camera, of each kind that is read."""
    with tempfile.TemporaryDirectory() as folder:
        image = np.random.default_rng(3).integers(0, 256, CAMERA.shape, dtype=np.uint8)
        colour = np.dstack([image, image[::-1], image])
        jpeg = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
        encoded = [cv2.imencode(ending, each, options)[1].tobytes() for ending, each, options in (
            (".png", image, []), (".png", colour, []), (".bmp", image, []), (".bmp", colour, []),
            (".jpg", image, []), (".jpg", colour, jpeg), (".tif", image, []),
        )]  # fmt: skip
        path = Path(folder) / "frame.tif"
        for writing in ({"bigtiff": True}, {"byteorder": ">"}):
            for packing in ({}, {"compression": "zlib", "predictor": True}):
                with tifffile.TiffWriter(path, **writing) as tiff:
                    for _ in range(3):
                        tiff.write(image, photometric="minisblack", contiguous=False, **packing)
                encoded.append(path.read_bytes())
    return encoded


def good_bundle(folder: Path) -> Path:
    """A sound bundle of ten frames, written into `folder`."""
    write_bundle(folder / "scan", sample_capture(), sample_calibration())
    return folder / "scan"


def harmed(data: bytes, others: Sequence[bytes], chance: random.Random) -> bytes:
    """The file with one to four faults: bits, cuts, repeats, swapped and strange words, parts of other files."""
    found = bytearray(data)
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        place = chance.randrange(len(found) + 1)
        end = min(len(found), place + chance.choice((1, 1, 4, 30, 400)))
        match chance.randrange(9):
            case 0 if found:
                found[place % len(found)] ^= 1 << chance.randrange(8)
            case 1:
                del found[place:]
            case 2:
                del found[place:end]
            case 3:
                found[place:place] = found[place:end] * chance.choice((1, 1, 2, 300))
            case 4:
                found[place:end] = chance.choice(TOKENS)
            case 5:
                words = bytes(found).split(b" ")
                one, other = chance.randrange(len(words)), chance.randrange(len(words))
                words[one], words[other] = words[other], words[one]
                found = bytearray(b" ".join(words))
            case 6:
                other_file = chance.choice(others)
                start = chance.randrange(len(other_file))
                found[place:end] = other_file[start : start + chance.choice((8, 100, len(other_file)))]
            case 7:
                found[place:end] = chance.randbytes(end - place)
            case 8:
                # Numbers of headers, in both orders.
                number = chance.choice((0, 1, 0x7F, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF))
                width = chance.choice((1, 2, 4))
                found[place : place + width] = (number & (1 << 8 * width) - 1).to_bytes(
                    width, chance.choice(("little", "big"))
                )
    return bytes(found)


def harmed_calibrations(count: int, seed: int) -> list[tuple[str, bytes]]:
    """As many calibrations that were harmed, with their endings."""
    chance, good = random.Random(seed), good_calibrations()
    texts = [text for _, text in good]
    chosen = [chance.choice(good) for _ in range(count)]
    return [(ending, harmed(text, texts, chance)) for ending, text in chosen]


def harm_bundle(folder: Path, frames: Sequence[bytes], seed: int) -> str:
    """Harm a frame of a bundle, or one time in four its bundle.json; returns which file, to be put back after."""
    chance = random.Random(seed)
    description = folder / "bundle.json"
    if chance.random() < 0.25:
        description.write_bytes(harmed(description.read_bytes(), frames, chance))
        return "bundle.json"
    data = harmed(chance.choice(frames), frames, chance)
    if data.startswith(b"\x89PNG") and chance.random() < 0.7:
        data = with_checksums(data)
    name = json.loads(description.read_text())["frames"][0]["file"]
    (folder / name).write_bytes(data)
    return str(name)


def with_checksums(data: bytes) -> bytes:
    """A harmed PNG with its checksums made right again, so that it is not refused for these alone."""
    found, place = bytearray(data), 8
    while place + 12 <= len(found):
        end = place + 8 + int.from_bytes(found[place : place + 4], "big")
        if end + 4 > len(found):
            break
        found[end : end + 4] = zlib.crc32(found[place + 4 : end]).to_bytes(4, "big")
        place = end + 4
    return bytes(found)
