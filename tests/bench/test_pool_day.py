"""A day of a hundred rigs and one pool, in virtual time (see `simulated_hall`), with failures at fixed times.

    pytest tests/bench/test_pool_day.py -s

SLRIG_POOL_WORKERS says how many workers, "4 6 8" unless it does, SLRIG_POOL_HOURS how long the shift is, 8. A scan
takes about 10 ms of CPU. Arrivals have the seed 23, the same for every size. At 02:00 every rig scans its master part
within 5 s; verifications and calibrations are the rig's own. From 06:00 on there are single scans, bursts of ten, and
models of eight views. Driven are slrig's own limits, tries and reconnection, and dask's own queue and stealing.
"""

from __future__ import annotations

import asyncio
import importlib
import logging
import os
import random
import re
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("distributed", reason="needs a pool's libraries: pip install 'slrig[pool]'")
pytest.importorskip("obstore", reason="needs a pool's libraries: pip install 'slrig[pool]'")

from slrig.compute import cluster
from slrig.compute.pooled import BEGIN_LIMIT_S
from tests.bench.plots import require_matplotlib
from tests.bench.simulated_hall import CALM_LOOK_S, LOOK_S, Hall, Lines, Scan, Store, Visit
from tests.bench.virtual_time import VirtualLoop, run_virtually

RIGS = 100
SIZES = [int(each) for each in (os.environ.get("SLRIG_POOL_WORKERS") or "4 6 8").split()]
HOUR_S = 3600.0
SHIFT_S = (6 * HOUR_S, (6 + float(os.environ.get("SLRIG_POOL_HOURS") or 8)) * HOUR_S)
BUSY = {6: 1.6, 7: 1.3, 10: 0.3}
"""How many times the usual work comes in an hour of the day: parts wait at the start, and there is a break."""

A_HOUR = {"single": 10.0, "burst": 0.6, "model": 0.4}
"""Visits of a rig: 19 scans an hour."""

LINES = Lines(rig=1e9 / 8, worker=1e9 / 8, store=10e9 / 8, rig_slowness=2.0)
"""Assumed: rigs and workers at 1 Gbit/s, the store at 10, and a rig of half a worker's speed."""


@dataclass(frozen=True)
class Size:
    """What scans of one size cost: CPU seconds, and bytes without the second way. share : of all scans."""

    share: float
    service_s: float
    bundle_bytes: float
    result_bytes: float


# November 2026, two cores at a load of 10 to 20: CPU and no wall. `PooledWorker`, `Host`, and moto's S3 server.
MEASURED = (
    Size(0.25, 2.0, 10.2e6, 19.2e6),  # vase: 0.21 million triangles
    Size(0.25, 2.8, 10.3e6, 46.8e6),  # terrace
    Size(0.25, 3.8, 12.9e6, 30.0e6),  # gauge: two cameras
    Size(0.25, 5.0, 15.3e6, 133.3e6),  # of test_pipeline_speed: 1.68 million triangles
)
CAPTURE_S, COMBINE_S = 2.5, 36.0
"""A capture of 30 to 70 frames at 30 a second, and the CPU of a model of eight views, which its rig computes."""


def visits(rng: random.Random) -> Iterator[Visit]:
    """What one rig is asked for on a day."""
    size = rng.choices(MEASURED, [each.share for each in MEASURED])[0]

    def scans(count: int) -> Sequence[Scan]:
        return [
            Scan(
                f"{rng.getrandbits(64):x}", size.service_s * rng.lognormvariate(0.0, 0.2),
                int(size.bundle_bytes), int(size.result_bytes),
            )
            for _ in range(count)
        ]  # fmt: skip

    yield Visit(2 * HOUR_S + rng.uniform(0.0, 5.0), scans(1), CAPTURE_S)
    asked_s = SHIFT_S[0]
    while True:
        busy = BUSY.get(int(asked_s // HOUR_S), 1.0)
        asked_s += rng.expovariate(busy * sum(A_HOUR.values()) / HOUR_S)
        if asked_s > SHIFT_S[1]:
            return
        kind = rng.choices(list(A_HOUR), list(A_HOUR.values()))[0]
        if kind == "single":
            yield Visit(asked_s, scans(1), CAPTURE_S)
        elif kind == "burst":
            yield Visit(asked_s, scans(10), CAPTURE_S, pause_s=5.0)
        else:
            yield Visit(asked_s, scans(8), CAPTURE_S, pause_s=2.0, combine_s=LINES.rig_slowness * COMBINE_S)


async def failures(hall: Hall) -> None:
    """What goes wrong, and when, in shares of the shift."""
    loop = asyncio.get_running_loop()

    async def until(share: float, late_s: float = 0.0) -> None:
        await asyncio.sleep(SHIFT_S[0] + share * (SHIFT_S[1] - SHIFT_S[0]) + late_s - loop.time())

    async def scheduler_gone(share: float, gone_s: float) -> None:
        await until(share, -CALM_LOOK_S)
        cluster.LOOK_S = LOOK_S
        await until(share)
        assert hall.scheduler is not None
        await hall.scheduler.close()
        await until(share, gone_s)
        await hall.serve()
        await until(share, gone_s + CALM_LOOK_S)
        cluster.LOOK_S = CALM_LOOK_S

    for number, share in enumerate((0.1, 0.15, 0.2, 0.25)):
        await until(share)
        hall.rests_s[number % len(hall.members)] = 60.0
        await hall.kill(number % len(hall.members))
    await scheduler_gone(0.35, 3.0)
    await scheduler_gone(0.45, 120.0)
    await until(0.65, -CALM_LOOK_S)
    cluster.LOOK_S = LOOK_S
    await until(0.65)
    for rig in hall.rigs[:10]:
        rig.cluster.cut = True
    await until(0.65, 300.0)
    for rig in hall.rigs[:10]:
        rig.cluster.cut = False
    await until(0.65, 300.0 + CALM_LOOK_S)
    cluster.LOOK_S = CALM_LOOK_S
    await until(0.8)
    hall.store.slowness = 50.0
    await until(0.8, 300.0)
    hall.store.slowness = 1.0


def day(workers: int, *, well: bool = False) -> tuple[Hall, Mapping[str, Any]]:
    """A day with so many workers, and its figures. well : nothing fails."""
    rng = random.Random(23)
    asked = [list(visits(rng)) for _ in range(RIGS)]
    hall = Hall(Store(LINES), {scan.key: scan for each in asked for visit in each for scan in visit.scans})
    loop = VirtualLoop(1.9 * HOUR_S)

    async def life() -> None:
        await hall.open(RIGS, workers, patch)
        cluster.LOOK_S = CALM_LOOK_S
        wrong = asyncio.create_task(failures(hall) if not well else asyncio.sleep(0.0))
        await asyncio.gather(*(rig.live(each) for rig, each in zip(hall.rigs, asked, strict=True)), wrong)
        await asyncio.sleep(60.0)
        assert hall.scheduler is not None
        assert not hall.scheduler.tasks, "the scheduler keeps what nobody waits for"
        await hall.close()

    with pytest.MonkeyPatch.context() as patch:
        run_virtually(life(), loop, patch)
    assert all(scan.ended_s > 0 for scan in hall.scans.values())
    assert not hall.store.held
    assert not any(rig.cluster._told for rig in hall.rigs)
    return hall, figures(hall, workers)


def figures(hall: Hall, workers: int) -> Mapping[str, Any]:
    """Of a day that is over; seconds."""
    scans = list(hall.scans.values())
    waited = np.array([scan.begun_s - scan.captured_s for scan in scans])
    taken = np.array([scan.ended_s - scan.captured_s for scan in scans])
    steps = sorted([(scan.captured_s, 1) for scan in scans] + [(scan.begun_s, -1) for scan in scans])
    night = [scan.ended_s - 2 * HOUR_S for scan in scans if scan.captured_s < SHIFT_S[0]]
    return {
        "workers": workers,
        "scans": len(scans),
        "busy": hall.busy_s / workers / (SHIFT_S[1] - SHIFT_S[0]),
        "wait 50 95 99 max": [round(float(each), 1) for each in np.percentile(waited, [50, 95, 99, 100])],
        "end 50 95 99 max": [round(float(each), 1) for each in np.percentile(taken, [50, 95, 99, 100])],
        "by pool": sum(scan.where == "pool" for scan in scans) / len(scans),
        "by rigs": Counter(because(scan.where) for scan in scans if scan.where != "pool"),
        "queue": int(np.max(np.cumsum([step for _, step in steps]))),
        "night s": round(max(night)),
        "store GB": hall.store.carried / 1e9,
        "bundles held": hall.store.most_held,
    }


def because(where: str) -> str:
    """A cause without its numbers and names."""
    return re.sub(r"the pool inproc\S+|\d+ s|\(.*\)", "", where).strip()


def test_a_day_of_a_hundred_rigs(tmp_path: Path) -> None:
    require_matplotlib()
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    rows = []
    for workers in SIZES:
        for well in (True, False):
            began_s = time.process_time()
            row = day(workers, well=well)[1]
            rows.append(row)
            sys.stdout.write(f"\n{'well' if well else 'with failures'}, {time.process_time() - began_s:.0f} s of CPU\n")
            sys.stdout.write("".join(f"  {name:18} {value}\n" for name, value in row.items()))
    draw(tmp_path / "pool-day.png", rows[::2], rows[1::2])
    # Of what comes in one minute at night, rigs compute what cannot begin in time.
    assert rows[-2]["by pool"] > 0.98
    assert rows[-1]["by pool"] > 0.85


def draw(path: Path, well: Sequence[Mapping[str, Any]], failing: Sequence[Mapping[str, Any]]) -> None:
    """Waiting and the share of the rigs, against the workers."""
    pyplot: Any = importlib.import_module("matplotlib.figure")
    figure = pyplot.Figure(figsize=(9, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for rows, style in ((well, "-"), (failing, ":")):
        sizes = [row["workers"] for row in rows]
        for index, name in enumerate(("50 %", "95 %", "99 %")):
            waited = [row["wait 50 95 99 max"][index] for row in rows]
            left.plot(sizes, waited, f"o{style}", color=f"C{index}", label=name if rows is well else None)
        right.plot(
            sizes,
            [100 * (1 - row["by pool"]) for row in rows],
            f"o{style}",
            color="C3",
            label="by rigs, %" if rows is well else None,
        )
        right.plot(
            sizes,
            [100 * row["busy"] for row in rows],
            f"o{style}",
            color="C0",
            label="workers busy, %" if rows is well else None,
        )
    left.axhline(BEGIN_LIMIT_S, color="black", linewidth=0.8)
    left.set(
        xlabel="workers",
        ylabel="waiting, s",
        yscale="symlog",
        ylim=(0.0, 400.0),
        title="solid: well, dotted: with failures",
    )
    right.set(xlabel="workers")
    left.legend()
    right.legend()
    figure.savefig(path)
    sys.stdout.write(f"drawn: {path}\n")
