"""`python -m tests.bench.field fetch` gets the captures, `python -m tests.bench.field` makes the table of them.

--captures FOLDER: where they are. --opencv-python FILE: a Python with opencv-contrib-python-headless. --only WORD:
captures with that word. --write: put the table into the README. --check: fail where that one is 5 % off.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from tests.bench.field import methods
from tests.bench.field.measures import Figures, figures
from tests.bench.field.recipes import CAPTURES, DIGEST, fetch, make_bundle, make_reference

README = Path(__file__).parent / "README.md"
BEGIN, END = "<!-- table -->", "<!-- end of table -->"
METHODS = {
    "slrig": "slrig",
    "gray": "Gray code per pixel",
    "phase": "phase per pixel",
    "opencv": "OpenCV's `GrayCodePattern`",
}
HEAD = (
    "| capture | method | points | covered | rms, mm | 95 %, mm | gross | within σ | CPU, s |\n"
    "|---|---|--:|--:|--:|--:|--:|--:|--:|"
)
TOLERANCE = 0.05
"""Of all figures but CPU, between two runs."""


def row(capture: str, method: str, found: Figures, cpu_s: float) -> str:
    """A line of the table."""
    sigma = "states none" if found.within_sigma is None else f"{found.within_sigma:.1%}"
    return (
        f"| {capture} | {METHODS[method]} | {found.points} | {found.covered:.1%} | {found.rms_mm:.3f} | "
        f"{found.p95_mm:.3f} | {found.gross:.2%} | {sigma} | {cpu_s:.1f} |"
    )


def rows(captures: Path, only: str, opencv_python: str) -> Iterator[str]:
    """Every capture by every method that reads it, each in a process of its own."""
    for name, recipe in CAPTURES.items():
        if only not in name:
            continue
        with TemporaryDirectory() as folder:
            bundle = make_bundle(captures, recipe, Path(folder))
            reference, camera = make_reference(captures, recipe, bundle)
            mask, output = Path(folder, "mask.npy"), Path(folder, "points.npz")
            np.save(mask, reference.lit)
            for method in recipe["methods"]:
                python = opencv_python if method == "opencv" else sys.executable
                words = map(str, (python, methods.__file__, bundle, method, recipe["axis"], mask, output))
                one_thread = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
                ran = subprocess.run(list(words), check=False, env=one_thread)  # noqa: S603 - our own
                if ran.returncode == methods.LACKS_MODULE:
                    yield f"| {name} | {METHODS[method]} | not installed |" + " |" * 6
                    continue
                ran.check_returncode()
                made = np.load(output)
                found = figures(made["points"], made.get("sigma_mm"), reference, camera)
                yield row(name, method, found, float(made["cpu_s"]))


def agree(line: str, other: str) -> bool:
    """Whether two lines say the same within 5 %, or a unit of the last digit; but for CPU."""
    return all(map(_close, line.split(" | ")[:-1], other.split(" | ")[:-1]))


def _close(one: str, two: str) -> bool:
    try:
        a, b = (float(each.rstrip("%")) for each in (one, two))
    except ValueError:
        return one == two
    return bool(abs(a - b) <= max(TOLERANCE * abs(b), 1.01 * 10 ** -len(one.rstrip("%").partition(".")[2])))


def main() -> int:
    """Fetch, or make the table and say where it differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=["fetch"])
    parser.add_argument("--captures", type=Path, default=Path.home() / ".cache" / "slrig-field")
    parser.add_argument("--opencv-python", default=sys.executable)
    parser.add_argument("--only", default="")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    if options.what:
        fetch(options.captures)
        return 0
    made = (
        f"Made {datetime.now(UTC):%Y-%m-%d} of recipes {DIGEST} by slrig {version('slrig')}, NumPy {np.__version__}, "
        f"OpenCV {cv2.__version__}, Python {platform.python_version()}:"
    )
    print(f"{made}\n\n{HEAD}", flush=True)  # noqa: T201
    lines = []
    for line in rows(options.captures, options.only, options.opencv_python):
        lines.append(line)
        print(line, flush=True)  # noqa: T201
    before, _, rest = README.read_text().partition(BEGIN)
    table, _, after = rest.partition(END)
    if options.write:
        README.write_text("\n".join([before + BEGIN, made, "", HEAD, *lines, END]) + after)
    if not options.check:
        return 0
    known = [line for line in table.splitlines() if line.startswith("| ") and options.only in line.split(" | ")[0]]
    off = [f"{one}\n{two}" for one, two in zip(lines, known[not options.only :], strict=True) if not agree(one, two)]
    print("\n".join([f"{len(off)} of {len(lines)} rows differ by more than 5 %", *off]))  # noqa: T201
    return int(bool(off))


if __name__ == "__main__":
    sys.exit(main())
