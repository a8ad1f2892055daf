"""A bundle written beside the capture: in order, whole or not at all, and never holding more than it may."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from slrig.bundle import BundleWriter, read_bundle
from slrig.bundle.refused import Refused
from slrig.errors import BundleError, StorageError
from slrig.model import Black, CameraFormat, Shot, Size, White
from slrig.scan.acquisition import Recorder
from tests.unit.scan.fakes import WAIT_S

FORMATS = {"cam0": CameraFormat(Size(64, 48), 8)}
SHOTS = tuple(Shot(index, "cam0", np.full((48, 64), 10 * index, np.uint8)) for index in range(2))


class Slow(BundleWriter):
    """Writes when it is let; tells when it has begun."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, Size(64, 40), (White(), Black()), FORMATS)
        self.gate = threading.Event()
        self.begun = threading.Event()
        self.error: Exception | None = None
        self.written_by: set[str] = set()

    def add(self, shot: Shot) -> None:
        self.begun.set()
        assert self.gate.wait(WAIT_S)
        self.written_by.add(threading.current_thread().name)
        if self.error is not None:
            raise self.error
        super().add(shot)


def test_frames_are_written_in_order_by_a_thread_of_its_own(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")
    with writer, Recorder(writer) as recorder:
        for shot in SHOTS:
            recorder.add(shot)
        recorder.refuse(Refused(0, "cam0", 1, "it was stale", delivered=True))
        recorder.add(SHOTS[0])
        # All of this while the disk did nothing.
        writer.gate.set()
    assert writer.written_by == {"slrig-recorder"}
    shots = read_bundle(tmp_path / "bundle").capture.shots
    assert [(shot.pattern, int(shot.image[0, 0])) for shot in shots] == [(0, 0), (1, 10)]


def test_a_disk_that_is_too_slow_holds_the_capture_up(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")
    third_waits = threading.Event()
    done = threading.Event()

    def capture() -> None:
        with writer, Recorder(writer, most_bytes=2 * SHOTS[0].image.nbytes) as recorder:
            recorder.add(SHOTS[0])
            assert writer.begun.wait(WAIT_S)
            recorder.add(SHOTS[1])
            third_waits.set()
            recorder.add(SHOTS[1])
        done.set()

    thread = threading.Thread(target=capture, daemon=True)
    thread.start()
    assert third_waits.wait(WAIT_S)
    assert not done.is_set()
    writer.gate.set()
    assert done.wait(WAIT_S)
    thread.join()
    assert len(read_bundle(tmp_path / "bundle").capture.shots) == 3


def test_a_frame_larger_than_the_queue_is_written_all_the_same(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")
    writer.gate.set()
    with writer, Recorder(writer, most_bytes=1) as recorder:
        for shot in SHOTS:
            recorder.add(shot)
    assert len(read_bundle(tmp_path / "bundle").capture.shots) == 2


def test_what_the_disk_refuses_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")
    writer.error = StorageError("the disk is full")
    writer.gate.set()

    def capture() -> None:
        with writer, Recorder(writer) as recorder:
            recorder.add(SHOTS[0])
            recorder.finish()

    with pytest.raises(StorageError, match="the disk is full"):
        capture()
    assert list(tmp_path.iterdir()) == []


def test_what_the_disk_refuses_ends_a_capture_that_goes_on(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")
    writer.error = StorageError("the disk is full")
    writer.gate.set()

    def capture() -> None:
        with writer, Recorder(writer, most_bytes=1) as recorder:
            while True:
                recorder.add(SHOTS[0])

    with pytest.raises(StorageError, match="the disk is full"):
        capture()
    assert list(tmp_path.iterdir()) == []


def test_a_frame_that_is_no_frame_of_the_bundle_is_told(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")
    writer.gate.set()

    def capture() -> None:
        with writer, Recorder(writer) as recorder:
            recorder.add(Shot(7, "cam0", SHOTS[0].image))

    with pytest.raises(BundleError, match="pattern 7"):
        capture()
    assert list(tmp_path.iterdir()) == []


def test_a_capture_that_fails_writes_no_more_and_leaves_nothing(tmp_path: Path) -> None:
    writer = Slow(tmp_path / "bundle")

    def capture() -> None:
        with writer, Recorder(writer) as recorder:
            for shot in SHOTS:
                recorder.add(shot)
            assert writer.begun.wait(WAIT_S)
            threading.Timer(0, writer.gate.set).start()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        capture()
    assert list(tmp_path.iterdir()) == []
    assert not any(thread.name == "slrig-recorder" for thread in threading.enumerate())
