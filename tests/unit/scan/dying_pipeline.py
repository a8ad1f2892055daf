"""Stands in for a pipeline that is killed while it warms its kernels."""

from __future__ import annotations

import os
import signal


def warm_kernels() -> None:
    """End the process."""
    os.kill(os.getpid(), signal.SIGKILL)
