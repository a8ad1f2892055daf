"""F3D, which reads GLB through VTK, on a virtual display."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.npm import lacking

SIZE_PX = (480, 360)
_LIMIT_S = 120.0


def f3d_picture(model: Path, folder: Path, *options: str) -> NDArray[np.uint8]:
    """(H, W, 4) uint8, blue, green, red, opacity: the model as F3D shows it by itself, but for `options`."""
    missing = [name for name in ("f3d", "xvfb-run") if shutil.which(name) is None]
    if missing:
        lacking(f"needs {' and '.join(missing)}, to show a GLB: apt install f3d xvfb xauth")
    folder.mkdir(parents=True, exist_ok=True)
    result = subprocess.run(  # noqa: S603 - a viewer from the system's own packages
        [  # noqa: S607 - wherever the system has them
            "xvfb-run", "--auto-servernum", "f3d", str(model), f"--output={folder / 'picture.png'}", "--no-background",
            f"--resolution={SIZE_PX[0]},{SIZE_PX[1]}", *options,
        ],
        # A home without settings: F3D's own defaults.
        env={**os.environ, "HOME": str(folder), "LIBGL_ALWAYS_SOFTWARE": "1"},
        capture_output=True, text=True, timeout=_LIMIT_S, check=False,
    )  # fmt: skip
    found = cv2.imread(str(folder / "picture.png"), cv2.IMREAD_UNCHANGED)
    assert found is not None, result.stdout + result.stderr
    assert found.shape == (SIZE_PX[1], SIZE_PX[0], 4)
    return np.asarray(found, dtype=np.uint8)
