"""Stands in for a pipeline whose kernels take long to prepare: as long as a file is not there."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

from slrig.kernels import Prepared
from tests.unit.scan.fake_pipeline import frame_receiver, reconstruct_into

__all__ = ["frame_receiver", "reconstruct_into", "warm_kernels"]


def warm_kernels(told: Callable[[Prepared], None]) -> None:
    told(Prepared(41, 118))
    gate = Path(os.environ["PREPARING_GATE"])
    while not gate.exists():
        threading.Event().wait(0.01)
    told(Prepared(42, 118))
