"""Build a wheel with compiled kernels, for the Python that runs this, in whose environment slrig is installed.

    python config/deploy/wheel.py --output dist

Calls the kernels as scans, calibrations and models of the example rigs do, then compiles them for each level of the
processor that this machine has (x86-64-v3 and v2; on aarch64 its one), into `slrig/compiled`, where the checkout itself
uses them from then on. Takes some ten minutes. The same sources and libraries give the same bytes.
"""

from __future__ import annotations

import argparse
import importlib
import os
import pickle
import pkgutil
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COMPILED = ROOT / "slrig" / "compiled"
_SOURCES = ("slrig", "drivers", "simulated_rig", "pyproject.toml", "README.md", "LICENSE")
_EARLIEST = "315532800"
"""1980, the earliest time in a zip archive: that of all files, unless SOURCE_DATE_EPOCH is another one."""
_EXAMPLES = ("demo", "two_cameras", "rendered-groove")
_SCANS = (
    ["--rows"], ["--cross-lines"], ["--sequence", "phase"], ["--sequence", "robust"], ["--gray-only"],
    ["--exposure-s", "0.01", "--exposure-s", "0.03"], ["--file", "points-left.npz"],
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Call, compile, pack, and build."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="folder for the wheel; default dist")
    parser.add_argument("--level", action="append", help="one level of the processor alone; may be repeated")
    parser.add_argument("--usual", action="store_true", help="kernels of a usual scan alone, in a third of the time")
    chosen = parser.parse_args(arguments)
    shutil.rmtree(COMPILED, ignore_errors=True)
    COMPILED.mkdir()
    with tempfile.TemporaryDirectory(prefix="slrig-wheel-") as scratch:
        called = Path(scratch, "called")
        # numba orders names as its sets do, by their hashes.
        os.environ.update(NUMBA_CACHE_DIR=str(called), NUMBA_CPU_FEATURES="", PYTHONHASHSEED="0")
        call_kernels(Path(scratch), usual=chosen.usual)
        print(f"called by none of these: {', '.join(not_called()) or 'none'}", flush=True)  # noqa: T201 - a program
        wanted = chosen.level or levels()
        # Each in a process of its own, in which numba has compiled nothing yet.
        with ProcessPoolExecutor(2, get_context("spawn"), max_tasks_per_child=1) as processes:
            for told in processes.map(compile_kernels, repeat(called), wanted, repeat(COMPILED)):
                print(told, flush=True)  # noqa: T201 - a program
    print(build(chosen.output.resolve()))  # noqa: T201 - a program


def levels() -> list[str]:
    """Levels of which this machine can compile and run, lowest last."""
    from slrig.kernels import CPU_LEVELS, best_cpu_level

    best, known = best_cpu_level(), list(CPU_LEVELS)
    if best is None:
        sys.exit("This processor has no level that slrig knows; its kernels would run on it alone.")
    return known[known.index(best) :] if best in known else [best]


def call_kernels(scratch: Path, *, usual: bool) -> None:
    """Call kernels as scans do, unless `usual` the unusual ones, calibrations and models, too. numba's cache keeps what
    they were called with.
    """
    environment = {**os.environ, "SLRIG_MIN_FREE_BYTES": "0", "XDG_DATA_HOME": str(scratch / "data")}

    def run(*arguments: str | Path) -> None:
        words = " ".join(map(str, arguments))
        print(f"slrig {words[:100]}", flush=True)  # noqa: T201 - a program
        ended = subprocess.run(  # noqa: S603 - our own command
            [sys.executable, "-m", "slrig.cli", *arguments], env=environment, cwd=scratch, check=False,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        if ended.returncode:
            sys.exit(f"slrig {words} failed:\n{ended.stdout.decode(errors='replace')[-4000:]}")

    run("warm")
    for rig in _EXAMPLES[: 1 if usual else None]:
        run("demo", rig, "--output", "out")
    if usual:
        return
    for number, options in enumerate(_SCANS):
        run("scan", "--rig", "sphere", *options, "--output", f"scan{number}")
    run("model", "--rig", "turntable", "--shoot", "4", "--output", "model")
    run("calibrate", "run", "--rig", "rendered-calibration-small", "--scripted", "--data", "calibrated")
    # A scan with what a calibration is uncertain of: that of the board itself.
    (session,) = scratch.glob("calibrated/calibrations/*")
    solved = session / "solves" / "1" / "calibration.json"
    run("reconstruct", session / "poses" / "01" / "bundle", "--calibration", solved, "--output", "board")


def not_called() -> list[str]:
    """Names of the kernels that numba's cache does not hold."""
    for package in map(importlib.import_module, ("slrig", "simulated_rig", "drivers")):
        for each in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            with suppress(ImportError, SystemExit):
                importlib.import_module(each.name)
    from slrig.kernels import kernels_not_cached

    return kernels_not_cached()


def compile_kernels(called: Path, level: str, output: Path) -> str:
    """Compile for a level what the kernels in a cache were called with, write the archive, and tell what is in it.

    Sorted, and in this process alone: numba numbers the functions that it compiles, and machine code has the numbers.
    """
    with tempfile.TemporaryDirectory(prefix="slrig-wheel-") as cache:
        os.environ.update(NUMBA_CACHE_DIR=cache, NUMBA_CPU_NAME=level)
        from numba.core.callconv import CPUCallConv

        from slrig.kernels import rare_garbage_collection, shipped_archive_name

        # An error of a kernel would name the folder of its source, and that is another one elsewhere.
        CPUCallConv.build_excinfo_struct = lambda _, error, arguments, *__: (error, arguments, None)
        calls = {}
        for each in called.rglob("*.nbc"):
            _, described, _, signature, *_ = pickle.loads(each.read_bytes())  # noqa: S301 - our own
            calls[described.modname, described.qualname, str(signature.args)] = signature.args
        with rare_garbage_collection():
            for module, name, arguments in sorted(calls):
                getattr(importlib.import_module(module), name).compile(calls[module, name, arguments])
        path = output / shipped_archive_name()
        with zipfile.ZipFile(path, "w") as archive:
            for each in sorted(Path(cache).rglob("*.nbc"), key=lambda file: file.name):
                archive.writestr(zipfile.ZipInfo(each.name), each.read_bytes(), zipfile.ZIP_DEFLATED, 9)
    return f"{path.name}: {len(calls)} kernels, {path.stat().st_size / 1e6:.1f} MB"


def build(output: Path) -> Path:
    """Build the wheel from a copy, so that nothing of earlier builds gets into it, and no times and modes of files."""
    environment = {"SOURCE_DATE_EPOCH": _EARLIEST, **os.environ}
    os.umask(0o022)
    machine = platform.machine()
    tags = f"--python-tag cp{sys.version_info.major}{sys.version_info.minor} --plat-name manylinux_2_28_{machine}"
    with tempfile.TemporaryDirectory(prefix="slrig-wheel-") as scratch:
        for name in _SOURCES:
            source = ROOT / name
            if source.is_dir():
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(source, Path(scratch) / name, ignore=ignored, copy_function=shutil.copyfile)
            elif source.is_file():
                shutil.copyfile(source, Path(scratch) / name)
        command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(output), scratch]
        command.append(f"--config-settings=--build-option={tags}")
        subprocess.run(command, env=environment, check=True)  # noqa: S603 - our own
    return max(output.glob("slrig-*.whl"), key=lambda path: path.stat().st_mtime)


if __name__ == "__main__":
    main()
