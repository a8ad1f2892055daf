"""The client is light: what it loads, and what that takes."""

from __future__ import annotations

import json
import subprocess
import sys
from statistics import median

HEAVY = {
    "numba",
    "numpy",
    "cv2",
    "scipy",
    "fastapi",
    "starlette",
    "pydantic",
    "trimesh",
    "sqlalchemy",
    "PIL",
    "asyncio",
}
MOST_S = 0.3
_TOLD = """
import sys, time
begun_s = time.process_time()
import slrig.client
taken_s = time.process_time() - begun_s
import json
loaded = {name.partition(".")[0] for name in sys.modules}
own = {name for name in sys.modules if name.startswith("slrig.")}
print(json.dumps([taken_s, sorted(loaded), sorted(own)]))
"""


def test_the_client_loads_neither_mathematics_nor_the_service() -> None:
    taken: list[float] = []
    for _ in range(3):
        told = subprocess.run([sys.executable, "-c", _TOLD], capture_output=True, text=True, check=True)  # noqa: S603
        taken_s, loaded, own = json.loads(told.stdout)
        taken.append(taken_s)
    assert HEAVY & set(loaded) == set()
    rooms = {name.split(".")[1] for name in own}
    assert rooms == {"client", "disk", "errors", "printable"}
    assert median(taken) <= MOST_S
