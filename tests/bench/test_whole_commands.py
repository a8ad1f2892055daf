"""What whole commands cost, from the shell to the prompt: CPU, wall, and peak memory.

    pytest tests/bench/test_whole_commands.py -s

Bundles are rendered without truth. Medians; goals that are missed fail the test after its table is printed.
"""

from __future__ import annotations

import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan
from tests.bench.test_pipeline_speed import RIG

RUNS = 5
MANY = 10


@dataclass(frozen=True)
class Cost:
    """Of one process and its children: CPU and wall seconds, and the most resident memory of one of them, MB."""

    cpu_s: float
    wall_s: float
    peak_mb: float


def scaled(text: str, table: str, factor: float) -> str:
    """A rig file with the pixels of one table's devices so many times as fine."""
    head, sep, rest = text.partition(table)
    part, end, after = rest.partition("\n[[") if table.startswith("[head.p") else (rest, "", "")

    def finer(found: re.Match[str]) -> str:
        values = [float(each) * factor for each in found[2].split(",")]
        shown = (f"{each:.0f}" if found[1] == "size_px" else f"{each:.3f}" for each in values)
        return f"{found[1]} = [{', '.join(shown)}]"

    return head + sep + re.sub(r"(size_px|focal_px|principal_px) = \[(.*?)\]", finer, part) + end + after


def rendered(folder: Path, text: str, plan: ScanPlan) -> Path:
    folder.mkdir(parents=True)
    (folder / "rig.toml").write_text(text.replace("samples_per_axis = 2", "samples_per_axis = 1"))
    with open_rig(read_rig(folder / "rig.toml")) as rig:
        capture_frames(rig, plan, folder / "bundle").finish()
    for truth in (*(folder / "bundle").glob("truth*"), folder / "bundle" / "visible_points.npy"):
        truth.unlink()
    return folder / "bundle"


@pytest.fixture(scope="module")
def half_a_million(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of half a million points; its code is of single columns, four frames more than it would need."""
    text = scaled(RIG, "[[head.camera]]", 0.77)
    plan = ScanPlan(patterns=PatternPlan(gray_cell_px=1))
    return rendered(tmp_path_factory.mktemp("half") / "scan", text, plan)


@pytest.fixture(scope="module")
def twelve_megapixels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """37 frames of 12.6 megapixels: a projector of 1920 x 1200 plays columns and rows."""
    text = scaled(scaled(RIG, "[[head.camera]]", 3.1), "[head.projector]", 1.5)
    return rendered(tmp_path_factory.mktemp("large") / "scan", text, ScanPlan(patterns=PatternPlan(rows=True)))


def cost_of(command: Sequence[str]) -> Cost:
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)  # noqa: S603 - our own
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.stderr is not None
    assert process.returncode == 0, process.stderr.read().decode()
    process.stderr.close()
    return Cost(used.ru_utime + used.ru_stime, time.perf_counter() - began, used.ru_maxrss / 1024)


def median(costs: Sequence[Cost]) -> Cost:
    values = [(each.cpu_s, each.wall_s, each.peak_mb) for each in costs]
    return Cost(*(statistics.median(column) for column in zip(*values, strict=True)))


def ours(output: Path, *bundles: Path) -> list[str]:
    return [sys.executable, "-m", "slrig.cli", "reconstruct", *map(str, bundles), "--output", str(output)]


def told(title: str, rows: Mapping[str, tuple[float, float | None]]) -> None:
    """Print the table; fail where a value is beyond its goal."""
    sys.stdout.write(f"\n{title}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n")
    for what, (value, goal) in rows.items():
        sys.stdout.write(f"{what:52} {value:9.2f}{'' if goal is None else f'   goal {goal:g}'}\n")
    sys.stdout.flush()
    missed = {what: value for what, (value, goal) in rows.items() if goal is not None and value > goal}
    assert not missed


def test_one_scan(half_a_million: Path, tmp_path: Path) -> None:
    command = ours(tmp_path / "out", half_a_million)
    cost_of(command)
    mine = median([cost_of(command) for _ in range(RUNS)])
    told(
        f"half a million points, medians of {RUNS}",
        {"CPU s": (mine.cpu_s, 3.0), "wall s": (mine.wall_s, 2.2), "peak MB": (mine.peak_mb, None)},
    )


def test_ten_scans_by_one_command(half_a_million: Path, tmp_path: Path) -> None:
    bundles = [tmp_path / f"scan-{number}" for number in range(MANY)]
    for each in bundles:
        each.symlink_to(half_a_million)
    cost_of(ours(tmp_path / "warm", bundles[0]))
    one = median([cost_of(ours(tmp_path / f"one-{number}", bundles[0])) for number in range(RUNS)])
    many = cost_of(ours(tmp_path / "many", *bundles))
    each_s = (many.cpu_s - one.cpu_s) / (MANY - 1)
    told(f"{MANY} scans of half a million points by one command", {"each after the first: CPU s": (each_s, 2.2)})


def test_a_large_sensor(twelve_megapixels: Path, tmp_path: Path) -> None:
    command = ours(tmp_path / "out", twelve_megapixels)
    cost_of(command)
    mine = median([cost_of(command) for _ in range(3)])
    told(
        "37 frames of 12.6 megapixels, 4 million points",
        {"CPU s": (mine.cpu_s, 12.0), "wall s": (mine.wall_s, None), "peak MB": (mine.peak_mb, 1536)},
    )
