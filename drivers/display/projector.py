"""A projector on a display output: options, the output's interface, pixels, the time of full light, and the projector.

A display receives a picture row by row, over one refresh period T, from the instant b of the flip on. So its last row
arrives at b + T, and is lit `latency_s` later, the display's own delay. A flip exchanges frame buffers in the gap
between two pictures: b is its time stamp. A copy into the frame buffer that is being scanned out may come after the
scan-out has passed some of the rows; these come one T later: b lies between the stamp and the stamp + T.
"""

from __future__ import annotations

import queue
import struct
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from slrig.bundle import Strict
from slrig.devices import DisplayedPattern, ProjectorInfo, ProjectorState, SystemClock
from slrig.errors import DeviceError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import Pattern, PatternSequence, Pixels, Primary, Size

_HEADER = bytes.fromhex("00ffffffffffff00")
_DESCRIPTORS = (54, 72, 90, 108)
_NAME, _SERIAL = 0xFC, 0xFF


@dataclass(frozen=True, slots=True)
class Edid:
    """A display's maker (three letters), model name and serial number; name and serial may be empty."""

    maker: str
    name: str
    serial: str

    def __str__(self) -> str:
        return " ".join(part for part in (self.maker, self.name) if part)


def parse_edid(block: bytes) -> Edid | None:
    """Parse an EDID; return None if it is damaged or of another kind.

    >>> parse_edid(b"") is None
    True
    """
    base = block[:128]
    if len(base) < 128 or base[:8] != _HEADER or sum(base) % 256:
        return None
    (packed,) = struct.unpack_from(">H", base, 8)
    maker = "".join(chr(64 + (packed >> shift & 31)) for shift in (10, 5, 0))
    texts = {
        base[at + 3]: base[at + 5 : at + 18].split(b"\n")[0].decode("latin-1").strip()
        for at in _DESCRIPTORS
        if base[at : at + 3] == b"\x00\x00\x00"
    }
    (number,) = struct.unpack_from("<I", base, 12)
    return Edid(maker, texts.get(_NAME, ""), texts.get(_SERIAL, "") or (str(number) if number else ""))


Extent = Annotated[int, Field(ge=1, le=65_535)]
Seconds = Annotated[float, Field(ge=0, le=5)]
Result = TypeVar("Result")

UNMEASURED_LATENCY_S = 0.05
"""Latency of a display whose latency was not measured, ± as much: usual projectors are not later."""

STAMP_ERROR_NS = 500_000
"""Error of time stamps of flips: drivers without a precise one use that of the interrupt."""

MAX_QUEUED_FRAMES = 2
"""Pictures that a library may queue although it was set to wait for the refresh (double and triple buffering)."""

_OPEN_TIMEOUT_S = 30.0
_LOAD_TIMEOUT_S = 60.0
_SHOW_TIMEOUT_S = 5.0
_BLANK_TIMEOUT_S = 2.0
_USUAL_WAIT = 2.0
"""Refreshes from show to the end of a picture's scan-out: half a one to wait, one or one and a half to be shown."""

_PRIMARY_PIXELS = {"red": 0x010000, "green": 0x000100, "blue": 0x000001}


class DisplayOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[projector]` table that all drivers of display outputs take."""

    output: Annotated[str, Field(min_length=1, max_length=100, json_schema_extra={"takes": "device"})]
    """The connector, as `slrig devices` names it."""

    native_px: Annotated[tuple[Extent, Extent], Field(strict=False)] | None = None
    """[width, height] of the projector's own raster (its data sheet's "native resolution"), where its EDID prefers
    another size, or none."""

    monitor: Annotated[str, Field(min_length=1)] | None = None
    """The display that must be at that connector, as `slrig devices` names it; else any display."""

    latency_s: Seconds | None = None
    """Measured delay of the display, from the signal of a picture's last row to its light. Without it, 0.05 s, ± as
    much."""

    latency_error_s: Seconds | None = None
    """± variation of the latency; else half a refresh."""

    check_pixels: bool = True
    """True to read one picture of each sequence back from the frame buffer and compare it."""

    dark_after_s: Annotated[float, Field(ge=0, le=86_400)] = 600.0
    """How long the output is kept black after the process that opened it has ended, even by a crash."""

    @property
    def native(self) -> Size | None:
        """The projector's own raster, if the rig file states it."""
        return None if self.native_px is None else Size(*self.native_px)


def rgb_pixels(levels: Pixels, pattern: Pattern | None = None) -> NDArray[np.uint32]:
    """Convert grey levels, (H, W) uint8, to pixels, (H, W) uint32, 0x00RRGGBB, in the colour of a `Primary`.

    >>> [hex(word) for word in rgb_pixels(np.array([[0, 255, 7]], np.uint8))[0]]
    ['0x0', '0xffffff', '0x70707']
    """
    factor = _PRIMARY_PIXELS[pattern.colour] if isinstance(pattern, Primary) else 0x010101
    return np.asarray(levels.astype("<u4") * np.uint32(factor))


def require_equal_pixels(output: str, wanted: NDArray[np.uint32], found: NDArray[np.uint32], remedy: str) -> None:
    """Compare a frame buffer with the pixels drawn into it, both (H, W) as of `rgb_pixels`.

    Raises
    ------
    UnsupportedByDeviceError
        They differ. States how many pixels differ, and where.
    """
    wrong = np.argwhere(found != wanted)
    if len(wrong):
        row, column = (int(place) for place in wrong[0])
        message = (
            f"output {output}: {len(wrong)} of {wanted.size} pixels are not the pattern's: at (row {row}, column "
            f"{column}) #{int(wanted[row, column]):06x} was shown, the frame buffer has "
            f"#{int(found[row, column]):06x}; {remedy}"
        )
        raise UnsupportedByDeviceError(message)


@dataclass(frozen=True, slots=True)
class ScanoutStart:
    """A picture's scan-out began between these instants, CLOCK_MONOTONIC, ns."""

    from_ns: int
    until_ns: int


def start_of_flip(stamp_ns: int) -> ScanoutStart:
    """Return the start of scan-out of a picture that was flipped to at this instant."""
    return ScanoutStart(stamp_ns, stamp_ns)


def start_of_copy(stamp_ns: int, refresh_s: float) -> ScanoutStart:
    """Return the start of scan-out of a picture copied into the frame buffer at the refresh of this instant."""
    return ScanoutStart(stamp_ns, stamp_ns + round(refresh_s * 1e9))


def start_of_queued(requested_ns: int, returned_ns: int, refresh_s: float) -> ScanoutStart:
    """Return the start of scan-out of a picture of which only the times of the call are known."""
    return ScanoutStart(requested_ns, returned_ns + round(MAX_QUEUED_FRAMES * refresh_s * 1e9))


def full_light_time(
    start: ScanoutStart, *, refresh_s: float, latency_s: float, latency_error_s: float
) -> tuple[int, int]:
    """Return the instant from which a picture lights the whole scene, and its error: (t_visible_ns, t_err_ns).

    >>> full_light_time(start_of_flip(10**9), refresh_s=0.02, latency_s=0.03, latency_error_s=0.001)
    (1050000000, 1500000)
    """
    middle_ns = (start.from_ns + start.until_ns) // 2
    half_ns = -(-(start.until_ns - start.from_ns) // 2)
    return (
        middle_ns + round((refresh_s + latency_s) * 1e9),
        half_ns + STAMP_ERROR_NS + round(latency_error_s * 1e9),
    )


class PatternOutput(Protocol):
    """An output that shows patterns. One thread uses it, except for `cover`; it is black after opening."""

    @property
    def size(self) -> Size:
        """Pixels of a picture."""
        ...

    @property
    def refresh_s(self) -> float:
        """One refresh period."""
        ...

    @property
    def model(self) -> str:
        """Description of the connected display."""
        ...

    @property
    def serial(self) -> str:
        """Serial number of the display, else the output's name."""
        ...

    def load(self, sequence: PatternSequence) -> None:
        """Take patterns, after checking that the output still shows them unchanged."""
        ...

    def show(self, index: int | None) -> ScanoutStart:
        """Show a pattern, None for black."""
        ...

    def compare(self, levels: Pixels) -> None:
        """Raise unless the frame buffer, where it can be read, holds this picture, (H, W) uint8."""
        ...

    def cover(self) -> bool:
        """Make the output black by other means than `show`, from any thread; return True if that was done."""
        ...

    def close(self) -> None:
        """Leave the output black, as far as possible."""
        ...


class WorkerThread:
    """A thread that runs jobs one after the other, for libraries that require one thread. Ends with the process."""

    def __init__(self, name: str) -> None:
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        self._name = name
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def run(self, job: Callable[[], Result], *, timeout_s: float) -> Result:
        """Run a job on the thread; return its result or raise its exception.

        Raises
        ------
        DeviceError
            It did not end in time. It may end later.
        """
        done: Future[Result] = Future()
        self._jobs.put((job, done))
        try:
            return done.result(timeout_s)
        except TimeoutError:
            if done.cancel() or not done.done():
                message = (
                    f"{self._name} did not answer in {timeout_s:g} s: the graphics driver hangs; see the kernel's log "
                    "(dmesg)"
                )
                raise DeviceError(message) from None
            return done.result()

    def end(self, *, timeout_s: float) -> None:
        """End the thread after the jobs that it has."""
        self._jobs.put(None)
        self._thread.join(timeout_s)

    def _work(self) -> None:
        while (item := self._jobs.get()) is not None:
            job, done = item
            if not done.set_running_or_notify_cancel():
                continue
            try:
                done.set_result(job())
            except BaseException as error:  # noqa: BLE001 - raised where the job was given
                done.set_exception(error)


class DisplayProjector:
    """Implements `slrig.devices.Projector` on one output of this computer.

    open_output : opens the output, black; called on the thread that uses it.

    One thread uses the output; `blank` and `close` work from any other, and where that thread hangs in a graphics
    driver, another process makes the output black.

    Raises
    ------
    DeviceError
        As `open_output`, or it did not end in time.
    """

    def __init__(self, options: DisplayOptions, open_output: Callable[[], PatternOutput]) -> None:
        self._options = options
        self._thread = WorkerThread(f"output {options.output}")
        try:
            self._output: PatternOutput = self._thread.run(open_output, timeout_s=_OPEN_TIMEOUT_S)
        except BaseException:
            self._thread.end(timeout_s=0)
            raise
        output = self._output
        self.refresh_s = output.refresh_s
        measured = options.latency_s is not None
        self._latency_s = options.latency_s if options.latency_s is not None else UNMEASURED_LATENCY_S
        usual_error_s = self.refresh_s / 2 if measured else UNMEASURED_LATENCY_S
        self._latency_error_s = usual_error_s if options.latency_error_s is None else options.latency_error_s
        self._info = ProjectorInfo(
            name=options.output,
            model=output.model,
            serial=output.serial,
            size=output.size,
            plays=False,
            latency_s=self._latency_s + self._latency_error_s + _USUAL_WAIT * self.refresh_s,
            refresh_s=self.refresh_s,
            lights=True,
        )
        self._state = ProjectorState(f"the projector on output {options.output}")
        self._compare_next = False
        self._blanked = threading.Event()

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`."""
        return self._info

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. Checks the output again, which may have been changed since it was opened."""
        self._state.require_open()
        self._state.loaded = None
        self._state.require_size(sequence, self._info.size)
        self.blank()
        self._blank_on_failure(lambda: self._thread.run(lambda: self._output.load(sequence), timeout_s=_LOAD_TIMEOUT_S))
        self._state.loaded = sequence
        self._compare_next = self._options.check_pixels

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`. Black if it fails."""
        sequence = self._state.require_pattern(index)
        return self._blank_on_failure(lambda: self._show(sequence, index))

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. A display has no trigger wire."""
        self._state.refuse_to_play(exposure_s, period_s)

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`. From any thread.

        Raises
        ------
        DeviceError
            The output does not turn black, and cannot be covered.
        """
        if self._state.closed.is_set():
            return
        self._blanked.set()
        try:
            start = self._thread.run(lambda: self._output.show(None), timeout_s=_BLANK_TIMEOUT_S)
        except DeviceError:
            if not self._output.cover():
                raise
        else:
            # The previous picture stays until the black one is scanned out.
            t_visible_ns, t_err_ns = self._full_light_time(start)
            SystemClock().wait_until(t_visible_ns + t_err_ns, self._state.closed)

    def close(self) -> None:
        """See `Projector`. From any thread. The output stays black, `dark_after_s` beyond this process's end."""
        if self._state.closed.is_set():
            return
        self._blanked.set()
        self._state.closed.set()
        self._state.loaded = None
        # The output may be in any state; steps that fail are not needed.
        with suppress(DeviceError):
            self._thread.run(lambda: self._output.show(None), timeout_s=_BLANK_TIMEOUT_S)
        self._output.cover()
        with suppress(DeviceError):
            self._thread.run(self._output.close, timeout_s=_BLANK_TIMEOUT_S)
        self._thread.end(timeout_s=_BLANK_TIMEOUT_S)

    def _show(self, sequence: PatternSequence, index: int) -> DisplayedPattern:
        self._blanked.clear()
        start = self._thread.run(lambda: self._output.show(index), timeout_s=_SHOW_TIMEOUT_S)
        t_visible_ns, t_err_ns = self._full_light_time(start)
        is_grey = not isinstance(sequence.patterns[index], Primary)
        if self._compare_next and is_grey and not self._blanked.is_set():
            self._thread.run(lambda: self._output.compare(sequence.image(index)), timeout_s=_SHOW_TIMEOUT_S)
            self._compare_next = False
        if self._blanked.is_set():
            message = f"pattern {index} was blanked from outside before its light was there; show it again"
            raise DeviceStateError(message)
        return DisplayedPattern(index, t_visible_ns, t_err_ns)

    def _full_light_time(self, start: ScanoutStart) -> tuple[int, int]:
        return full_light_time(
            start, refresh_s=self.refresh_s, latency_s=self._latency_s, latency_error_s=self._latency_error_s
        )

    def _blank_on_failure(self, attempt: Callable[[], Result]) -> Result:
        try:
            return attempt()
        except BaseException:
            with suppress(DeviceError):
                self.blank()
            raise
