"""Stands in for a pipeline whose kernels take long to prepare, or that is killed meanwhile."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path

from slrig.kernels import KernelCount
from tests.unit.scan.fake_pipeline import LiveScan, reconstruct_into

__all__ = ["LiveScan", "reconstruct_into", "warm_kernels"]


def warm_kernels(told: Callable[[KernelCount], None]) -> None:
    told(KernelCount(41, 118))
    if "PREPARING_GATE" not in os.environ:
        os.kill(os.getpid(), signal.SIGKILL)
    while not Path(os.environ["PREPARING_GATE"]).exists():
        threading.Event().wait(0.01)
    told(KernelCount(42, 118))
