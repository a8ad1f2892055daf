"""The screen driver on Xorg's dummy outputs: the contract suite, and every pixel of every pattern."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers import screen
from slrig.conformance import CHECKS, Check, CheckOutcome, ConformanceRun
from slrig.model import Size
from tests.contract.screen_bench import bench_on, let_go, rig_options, sequence
from tests.contract.screen_server import DummyServer, OutputPixels

pytestmark = pytest.mark.slow

OUTPUTS = ("DUMMY0", "DUMMY1")
SHOWN = (("DUMMY0", Size(854, 480)), ("DUMMY1", Size(102, 77)))


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DummyServer]:
    with DummyServer(tmp_path_factory.mktemp("xorg")) as server, pytest.MonkeyPatch.context() as patch:
        patch.setenv("DISPLAY", server.display)
        patch.delenv("WAYLAND_DISPLAY", raising=False)
        yield server
        let_go(*OUTPUTS)


@pytest.mark.parametrize("backend", ["x11", "sdl"])
@pytest.mark.parametrize(("output", "size"), SHOWN, ids=str)
def test_every_pixel_of_every_pattern_is_on_its_output(
    server: DummyServer, backend: str, output: str, size: Size
) -> None:
    if backend == "sdl":
        pytest.importorskip("sdl2", reason="needs PySDL2: pip install 'slrig[screen]'")
    places = server.arrange(**dict.fromkeys(OUTPUTS, size))
    (other,) = set(OUTPUTS) - {output}
    ours, theirs = (OutputPixels(server.display, places[name], size) for name in (output, other))
    projector = screen.open_projector(rig_options(output, size, backend=backend, check_pixels=False), Path())
    try:
        shown = sequence(size)
        projector.load(shown)
        assert not ours.colours().any()
        before = theirs.colours()
        for index in range(len(shown)):
            projector.show(index)
            wanted = np.repeat(shown.image(index)[..., None], 3, axis=2)
            assert np.array_equal(ours.colours(), wanted), shown.patterns[index]
        assert np.array_equal(theirs.colours(), before)
        projector.blank()
        assert not ours.colours().any()
    finally:
        projector.close()
        ours.close()
        theirs.close()
        let_go(output)


@pytest.fixture(scope="module", params=["x11", "sdl"])
def examination(request: pytest.FixtureRequest, server: DummyServer) -> Iterator[ConformanceRun]:
    if request.param == "sdl":
        pytest.importorskip("sdl2", reason="needs PySDL2: pip install 'slrig[screen]'")
    with bench_on(server, "DUMMY1", backend=request.param).examination() as examination:
        yield examination


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_contract(examination: ConformanceRun, check: Check) -> None:
    result = examination.run_check(check)
    if result.outcome is CheckOutcome.NOT_APPLICABLE:
        pytest.skip(result.reason or "")
    assert result.outcome is CheckOutcome.PASSED, str(result.failure)
