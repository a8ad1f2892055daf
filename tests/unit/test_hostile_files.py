"""Files that lie or burst, at every door: each is refused in the reader's words or read, at little cost."""

from __future__ import annotations

import re
import resource
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import trimesh

from drivers.v4l2.formats import CorruptFrameError, _decode_jpeg
from slrig.bundle import MAX_CAMERA_PX, read_page_formats, read_truth, read_with_colour
from slrig.bundle.sidecars import SURFACE_FILE, VISIBLE_POINTS_FILE
from slrig.calibrate.store import _read_reading
from slrig.errors import SlrigError
from slrig.importers.documents import read_document
from slrig.importers.images import list_images
from slrig.model import CameraFormat, Size
from tests.core import parametrize_core
from tests.hostile_files import HEIGHT, KINDS, WIDTH, hostile_files

MEMORY = Path("/proc/self/status")
MAX_GROWTH_BYTES = 2**26
MAX_CPU_S = 2.0
_ADDRESS_SPACE_BYTES = 2**30
_SIZE = Size(WIDTH, HEIGHT)
_SURFACE = trimesh.creation.box().export(file_type="ply")


def read_frame(path: Path) -> None:
    for bits in (8, 16):
        try:
            read_with_colour(path, (0,), CameraFormat(_SIZE, bits), colour_pages=(0,))
        except SlrigError:
            if bits == 16:
                raise


def import_images(path: Path) -> None:
    images, _ = list_images(path)
    for image in images[:5]:
        form = image.read_format()
        if form.size.width_px * form.size.height_px <= MAX_CAMERA_PX:
            image.read(form, coloured=True)


def read_camera(path: Path) -> None:
    _decode_jpeg(np.frombuffer(path.read_bytes(), np.uint8), _SIZE, "GRAY")


def truth_with(name: str) -> Callable[[Path], None]:
    """Read the truth of a bundle that has a file as this one."""

    def read(path: Path) -> None:
        folder = path.parent / "bundle"
        folder.mkdir(exist_ok=True)
        (folder / SURFACE_FILE).write_bytes(_SURFACE)
        np.save(folder / VISIBLE_POINTS_FILE, np.zeros((3, 3)))
        shutil.copy(path, folder / name)
        try:
            read_truth(folder)
        finally:
            shutil.rmtree(folder)

    return read


DOORS: dict[str, tuple[Callable[[Path], object], ...]] = {
    **dict.fromkeys((".png", ".bmp", ".tif"), (read_frame, read_page_formats, import_images)),
    ".jpg": (read_frame, read_page_formats, import_images, read_camera),
    **dict.fromkeys(
        (".npy", ".npz"),
        (import_images, read_document, truth_with(VISIBLE_POINTS_FILE), truth_with("truth-left.npz"), _read_reading),
    ),
    ".mat": (read_document,),
    ".ply": (truth_with(SURFACE_FILE),),
}


def memory_bytes(figure: str) -> int:
    found = re.search(rf"^{figure}:\s+(\d+) kB", MEMORY.read_text(), re.MULTILINE)
    assert found is not None
    return 1024 * int(found[1])


@contextmanager
def at_little_cost(what: str) -> Iterator[None]:
    """Fail where the block takes much memory or time, or asks for more than a machine of 1 GB more has."""
    (MEMORY.parent / "clear_refs").write_text("5")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes("VmSize") + _ADDRESS_SPACE_BYTES, before[1]))
    held_bytes, begun_s = memory_bytes("VmRSS"), time.thread_time()
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert memory_bytes("VmHWM") - held_bytes < MAX_GROWTH_BYTES, what
    assert time.thread_time() - begun_s < MAX_CPU_S, what


@pytest.mark.skipif(not MEMORY.exists(), reason="needs Linux, which tells what memory was taken")
@parametrize_core(("mutations", "every"), [(20, 4), (500 - sum(map(len, KINDS.values())), 1)])
def test_files_that_lie_or_burst_are_refused_in_words_at_little_cost(
    tmp_path: Path, mutations: int, every: int
) -> None:
    for kind, ending, data in islice(hostile_files(mutations), None, None, every):
        path = tmp_path / f"file{ending}"
        path.write_bytes(data)
        for read in DOORS[ending]:
            with at_little_cost(f"{kind} at {read}"), suppress(SlrigError, CorruptFrameError):
                read(path)
