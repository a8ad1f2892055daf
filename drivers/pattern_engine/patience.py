"""Waiting for a controller: it acknowledges a command at once, and may report the effect later.

How long TI's own and other public programs for the DLPC350 wait:

    answer       at most 2 s (TI's dlpc350_usb.cpp, `DLPC350_USB_Read`).
    mode         set only if it differs, then read every 100 ms, 5 to 10 times (`SetDLPC350InPatternMode` of TI's
                 program; `setToPatternMode` of an earlier src/projector/ProjectorLC4500.cpp in
                 github.com/jakobwilm/slstudio). A change of the DLPC900 takes 0.3 s, and the mode before is read until
                 then (DLPU018 table 2-97).
    stop         0x1A24 is read until it is 0, and the stop repeated every 100 ms, 5 to 10 times (`PatSeqCtrlStop` of
                 TI's program; `setToVideoMode` of the same file).
    validation   first read after 110 ms, then every 10 ms (lcr4500.cpp of TI's DLP SDK, `CreateSendStartSequenceLut`).
    start        10 ms after the validation (same function).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from slrig.devices import Clock

PATIENCE_S = 1.0
"""Longest time until a register reads as it was set. It costs nothing where the first answer agrees."""
_ASK_AGAIN_NS = 5_000_000
Answer = TypeVar("Answer")


def ask_until(
    clock: Clock, ask: Callable[[], Answer], is_good: Callable[[Answer], bool], within_s: float = PATIENCE_S
) -> Answer:
    """Ask until an answer is good or the time is over. Return the last answer, good or not."""
    until_ns = clock.now_ns() + round(within_s * 1e9)
    while not is_good(answer := ask()) and (now_ns := clock.now_ns()) < until_ns:
        clock.wait_until(min(now_ns + _ASK_AGAIN_NS, until_ns), threading.Event())
    return answer
