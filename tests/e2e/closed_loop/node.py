"""A V4L2 camera that any program can open, with a sensor that sees a world."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Self, cast

from tests.contract.v4l2_bench import DEBIAN_PYTHON, ROOT, Faked, why_not
from tests.contract.v4l2_sensor import SensorService
from tests.e2e.closed_loop.output import WatchedOutput
from tests.e2e.closed_loop.world import World
from tests.npm import lacking

if TYPE_CHECKING:
    from tests.contract.stage import Stage


def require_umockdev() -> None:
    """Skip where a fake device cannot stand; fail instead where CI=true, which installs what it needs."""
    if why_not():
        lacking(why_not())


class VideoNode:
    """A fake kernel's /dev/video0, 8 bits of grey. A context manager.

    environment : what a program needs in its environment to find the device. `sensor.asked` : every exposure read.
    """

    def __init__(self, folder: Path, world: World | WatchedOutput) -> None:
        require_umockdev()
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "faults").mkdir()
        # Socket paths may have 107 characters, and those of test folders have more.
        self._short = tempfile.TemporaryDirectory(prefix="slrig-loop-")
        socket = Path(self._short.name) / "light"
        self.sensor = SensorService(socket, cast("Stage", world))
        size = world.format.size
        faked = Faked(formats={"GREY": [(size.width_px, size.height_px)]})
        config = folder / "device.json"
        config.write_text(json.dumps(faked.config(socket, folder / "faults")))
        self._server = subprocess.Popen(  # noqa: S603 - our own program
            ["umockdev-wrapper", str(DEBIAN_PYTHON), "-m", "tests.contract.v4l2_server", str(config)],  # noqa: S607
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        assert self._server.stdout is not None
        word, root = self._server.stdout.readline().split(maxsplit=1)
        assert word == "ready"
        loaded = ["libumockdev-preload.so.0", *filter(None, [os.environ.get("LD_PRELOAD")])]
        self.environment = {"UMOCKDEV_DIR": root.strip(), "LD_PRELOAD": ":".join(loaded)}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError, subprocess.TimeoutExpired):
            self._server.communicate(timeout=10)
        self._server.kill()
        self._server.wait(10)
        self.sensor.close()
        self._short.cleanup()
