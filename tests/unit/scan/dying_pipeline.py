"""Stands in for a pipeline that is killed while it warms its kernels."""

from __future__ import annotations

import os
import signal

from tests.unit.scan.fake_pipeline import LiveScan, reconstruct_bundle

__all__ = ["LiveScan", "reconstruct_bundle", "warm_kernels"]


def warm_kernels(_told: object) -> None:
    """End the process."""
    os.kill(os.getpid(), signal.SIGKILL)
