"""Build a wheel with compiled kernels, for the Python that runs this, in whose environment slrig is installed.

    python config/deploy/wheel.py --output dist

Compiles the kernels of the example rigs for each level of the processor that this machine has (x86-64-v3 and v2; on
aarch64 its one), into `slrig/compiled`, where the checkout itself uses them from then on. Takes some ten minutes.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COMPILED = ROOT / "slrig" / "compiled"
_SOURCES = ("slrig", "drivers", "simulated_rig", "pyproject.toml", "README.md", "LICENSE")
_EXAMPLES = ("demo", "two_cameras", "rendered-groove")
"""Rigs that are scanned. The kernels that no command here calls are listed at the end."""
_SCANS = (["--rows"], ["--cross-lines"], ["--sequence", "phase"], ["--sequence", "robust"])
_SMALLER = (
    ("samples_per_axis = 2", "samples_per_axis = 1"),
    ("count = 20", "count = 8"),
    ("[1280, 800]", "[320, 200]"),
    ("[1560.0, 1561.4]", "[390.0, 390.4]"),
    ("[637.2, 905.6]", "[159.3, 226.4]"),
    ("[1280, 1024]", "[560, 448]"),
    ("[1900.0, 1901.9]", "[1064.0, 1065.0]"),
    ("[643.7, 505.9]", "[281.6, 221.3]"),
)
_UNCALLED = """
import importlib, pkgutil, drivers, simulated_rig, slrig
for package in (slrig, simulated_rig, drivers):
    for each in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        try:
            importlib.import_module(each.name)
        except (ImportError, SystemExit):
            pass
from slrig.kernels import kernels_not_cached
print(*kernels_not_cached(), sep=chr(10))
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Compile, pack, and build."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="folder for the wheel; default dist")
    parser.add_argument("--level", action="append", help="one level of the processor alone; may be repeated")
    chosen = parser.parse_args(arguments)
    shutil.rmtree(COMPILED, ignore_errors=True)
    COMPILED.mkdir()
    for level in chosen.level or levels():
        with tempfile.TemporaryDirectory(prefix="slrig-wheel-") as scratch:
            pack(compiled_for(level, Path(scratch)), level)
    print(build(chosen.output.resolve()))  # noqa: T201 - a program


def levels() -> list[str]:
    """Levels of which this machine can compile and run, lowest last."""
    from slrig.kernels import CPU_LEVELS, best_cpu_level

    best, known = best_cpu_level(), list(CPU_LEVELS)
    if best is None:
        sys.exit("This processor has no level that slrig knows; its kernels would run on it alone.")
    return known[known.index(best) :] if best in known else [best]


def compiled_for(level: str, scratch: Path) -> Path:
    """Call kernels as scans, calibrations and models do; return the folder of what numba kept."""
    cache = scratch / "cache"
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(cache),
        "NUMBA_CPU_NAME": level,
        "NUMBA_CPU_FEATURES": "",
        "PYTHONHASHSEED": "0",
        "SLRIG_MIN_FREE_BYTES": "0",
        "XDG_DATA_HOME": str(scratch / "data"),
    }
    slrig = [sys.executable, "-m", "slrig.cli"]
    commands = [
        [*slrig, "warm"],
        [sys.executable, "-c", "from slrig.calibrate.job import warm; warm()"],
    ]
    commands += [[*slrig, "demo", name, "--output", "out"] for name in _EXAMPLES]
    commands += [[*slrig, "scan", "--rig", "sphere", *each, "--output", f"scan{each[-1]}"] for each in _SCANS]
    commands += [[*slrig, "model", "--rig", "turntable", "--shoot", "4", "--output", "model"]]
    small = str(small_calibration(scratch))
    commands.append([*slrig, "calibrate", "run", "--rig", small, "--scripted", "--activate"])
    for command in [*commands, [sys.executable, "-c", _UNCALLED]]:
        print(f"{level}: {' '.join(command[1:])[:120]}", flush=True)  # noqa: T201 - a program
        ended = subprocess.run(  # noqa: S603 - our own commands
            command, env=environment, cwd=scratch, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        if ended.returncode:
            sys.exit(f"{' '.join(command)} failed:\n{ended.stdout.decode(errors='replace')[-4000:]}")
    print(f"not compiled: {', '.join(ended.stdout.decode().split())}")  # noqa: T201 - a program
    return cache


def small_calibration(folder: Path) -> Path:
    """The rig file of a rendered calibration that takes seconds: kernels do not depend on the size of images."""
    from slrig.examples import copy_example

    rig = folder / "calibration.toml"
    copy_example("rendered-calibration", rig)
    text = rig.read_text(encoding="utf-8")
    for old, new in _SMALLER:
        if old not in text:
            sys.exit(f"rendered-calibration: expected {old}, which is to be replaced by {new}")
        text = text.replace(old, new)
    rig.write_text(text, encoding="utf-8")
    return rig


def pack(cache: Path, level: str) -> None:
    """Write the archive of a level: the same bytes for the same kernels."""
    code = "import slrig.kernels as kernels; print(kernels.shipped_archive_name())"
    environment = {**os.environ, "NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": ""}
    name = subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True)  # noqa: S603 - our own
    path = COMPILED / name.stdout.strip()
    files = {file.name: file for file in cache.rglob("*.nbc")}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for each in sorted(files):
            archive.writestr(zipfile.ZipInfo(each), files[each].read_bytes(), zipfile.ZIP_DEFLATED, 9)
    print(f"{path.name}: {len(files)} kernels, {path.stat().st_size / 1e6:.1f} MB")  # noqa: T201 - a program


def build(output: Path) -> Path:
    """Build the wheel from a copy, so that nothing of earlier builds gets into it."""
    machine = platform.machine()
    tags = f"--python-tag cp{sys.version_info.major}{sys.version_info.minor} --plat-name manylinux_2_28_{machine}"
    with tempfile.TemporaryDirectory(prefix="slrig-wheel-") as scratch:
        for name in _SOURCES:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, Path(scratch) / name, ignore=shutil.ignore_patterns("__pycache__"))
            elif source.is_file():
                shutil.copy2(source, Path(scratch) / name)
        command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(output), scratch]
        subprocess.run([*command, f"--config-settings=--build-option={tags}"], check=True)  # noqa: S603 - our own
    return max(output.glob("slrig-*.whl"), key=lambda path: path.stat().st_mtime)


if __name__ == "__main__":
    main()
