"""Kernels prepared ahead: all that a usual scan needs, and the production pipeline has what the worker looks up."""

from __future__ import annotations

import importlib
import subprocess
from pathlib import Path

import pytest
from numba import config

from slrig.errors import StorageError
from slrig.kernels import KernelCount, count_prepared, report_compilations
from slrig.scan import preparation
from slrig.scan import reconstruct as pipeline
from slrig.scan.job import PIPELINE
from slrig.scan.plan import ReconstructionPlan
from slrig.scan.preparation import prepare_kernels


def test_the_production_pipeline_has_all_that_the_worker_looks_up() -> None:
    loaded = importlib.import_module(PIPELINE)
    assert all(callable(each) for each in (loaded.reconstruct_into, loaded.warm_kernels, loaded.LiveScan))


def test_every_kernel_of_a_usual_scan_is_prepared() -> None:
    told: list[KernelCount] = []
    pipeline.warm_kernels(told.append)
    done, total = count_prepared()
    # Those that only some scans need are marked so at their definition.
    assert done == total > 40
    assert all(each.total == total for each in told)


@pytest.mark.slow
@pytest.mark.shared
def test_a_recorded_scan_compiles_nothing_more(shared: Path, tmp_path: Path) -> None:
    pipeline.warm_kernels(lambda _: None)
    late: list[str] = []
    plan = ReconstructionPlan()
    with report_compilations(late.append):
        pipeline.reconstruct_bundle(shared / "bundles" / "terrace", tmp_path / "out", plan=plan)
    # The truth beside this bundle is compared with by a search tree, which scans do without.
    of_truth = {"boxes", "box_gap", "box_entry", "squared_distances", "ray_hits", "nearest_on_triangle"}
    assert not {name for name in late if "<locals>" not in name} - of_truth - {"segment_gap", "ray_meets_triangle"}


def test_a_disk_that_refuses_the_made_up_scan_keeps_nobody_from_scanning(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        message = "no space left"
        raise StorageError(message)

    monkeypatch.setattr(preparation, "write_bundle", refuse)
    prepare_kernels(pipeline.reconstruct_bundle, lambda _: None)


def test_a_second_process_compiles_only_where_a_core_is_idle(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[list[str]] = []

    class Begun:
        def __init__(self, command: list[str], **_: object) -> None:
            begun.append(command)

        def kill(self) -> None:
            begun.append(["kill"])

        def wait(self) -> None:
            begun.append(["wait"])

        communicate = wait

    monkeypatch.setattr(subprocess, "Popen", Begun)
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", 2)
    monkeypatch.setattr(preparation, "_has_idle_core", lambda: False)
    with preparation._MeshingCompiler() as beside:
        beside.start()
        assert begun == []
        # The rig that was being rendered is open now.
        monkeypatch.setattr(preparation, "_has_idle_core", lambda: True)
        beside.start()
        beside.start()
        assert len(begun) == 1
        beside.join()
    assert [each[0] for each in begun[1:]] == ["wait", "kill", "wait"]
    begun.clear()
    with preparation._MeshingCompiler() as beside:
        beside.join()
        beside.start()
    assert begun == []


def test_a_busy_machine_has_no_idle_core(monkeypatch: pytest.MonkeyPatch) -> None:
    # At least this thread runs.
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", 1)
    assert not preparation._has_idle_core() or not Path("/proc/loadavg").exists()
    monkeypatch.setattr(config, "NUMBA_NUM_THREADS", 10**6)
    assert preparation._has_idle_core()
