"""Stands in for a pipeline that is killed while it warms its kernels."""

from __future__ import annotations

import os
import signal

from tests.unit.scan.fake_pipeline import frame_receiver

__all__ = ["frame_receiver", "warm_kernels"]


def warm_kernels(_told: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)
