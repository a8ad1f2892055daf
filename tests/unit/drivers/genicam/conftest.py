"""A fake GigE Vision camera for the tests of this folder; skipped with a reason where Aravis is not installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest

from drivers.genicam import GenicamCamera, open_camera
from slrig.devices import CameraSettings
from tests.contract.genicam_bench import FakeGigE, Fate, require_aravis, scene, table
from tests.contract.genicam_peer import PIXEL_FORMATS
from tests.contract.stage import Stage
from tests.unit.drivers.genicam.encoding import encoded

EXPOSURE_S = 0.005


@pytest.fixture(scope="session")
def _peer() -> Iterator[FakeGigE]:
    require_aravis()
    packed = {name: partial(encoded, name=name) for name in PIXEL_FORMATS}
    peer = FakeGigE(Stage(scene()), kind="sfnc", packed=packed)
    yield peer
    peer.stop()


@pytest.fixture
def peer(_peer: FakeGigE) -> FakeGigE:
    """The camera, running and faultless, before a dark stage."""
    _peer.stage = Stage(scene())
    _peer.fate = Fate
    _peer.exposures.clear()
    _peer.start()
    return _peer


@pytest.fixture
def opened(peer: FakeGigE) -> Iterator[Callable[..., GenicamCamera]]:
    """Opens the driver's camera with options, set to 5 ms; closes it after the test."""
    with ExitStack() as closing:

        def call(**options: object) -> GenicamCamera:
            peer.start()
            camera = open_camera("left", table(**options), Path())
            assert isinstance(camera, GenicamCamera)
            closing.callback(camera.close)
            camera.configure(CameraSettings(EXPOSURE_S))
            return camera

        yield call
