"""The turntable of a rig on disk, DATA/turntable/turntable.json: its axis, which every model improves, its planes, and
the plot of how the axis moved.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from uuid import UUID

import numpy as np
import structlog
from markupsafe import Markup

from slrig.bundle import (
    AxisSource,
    ChangeEntry,
    TurntableRecord,
    encode_turntable,
    read_turntable,
    sync_folder,
    write_file,
)
from slrig.disk import storage_errors
from slrig.errors import ConfigError, StorageError
from slrig.jobs.job import Job, Outcome
from slrig.jobs.records import utc_now
from slrig.model import (
    AXIS_SPAN_MM,
    MAX_AXIS_SIGMAS,
    AxisUpdate,
    MeasuredAxis,
    RotationAxis,
    TurntablePlane,
    update_axis,
)
from slrig.reports.page import (
    END,
    GAP,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    PANEL,
    TOP,
    Panel,
    nothing_yet,
    shape,
    times,
    trend,
)

_FILE = "turntable.json"
_log = structlog.get_logger(__name__)


class TurntableState(StrEnum):
    """unknown : there is no axis. known : there is. moved : the last model turned about another one."""

    UNKNOWN = "unknown"
    KNOWN = "known"
    MOVED = "moved"


def state_of(record: TurntableRecord, own: RotationAxis | None) -> tuple[TurntableState, str]:
    """The state of a turntable, and what to do about it; empty where nothing is to be done. own : the axis that the rig
    knows by itself.
    """
    if record.axis is None and own is None:
        return TurntableState.UNKNOWN, (
            "put a board on the turntable and shoot it at six angles (POST /rig/turntable/shoot)"
        )
    if record.history and not record.history[-1].taken:
        last = record.history[-1]
        return TurntableState.MOVED, (
            f"model {last.of} turned about an axis that is {last.moved_mm:.3f} mm and {last.moved_deg:.3f}° from the "
            f"one on record, {last.sigmas:.0f} deviations where {MAX_AXIS_SIGMAS:g} are allowed: were the turntable "
            f"or the "
            "cameras moved, or is the rig newly calibrated? Then calibrate the axis again (POST /rig/turntable/axis) "
            "and "
            "scan the empty turntable (POST /rig/turntable/planes); else scan the object again"
        )
    return TurntableState.KNOWN, ""


def with_axis(
    record: TurntableRecord, axis: MeasuredAxis, *, source: AxisSource, of: str, at: datetime | None = None
) -> TurntableRecord:
    """The record with an axis in place of any other, and with how far it has moved."""
    apart = None if record.axis is None else update_axis(record.axis, axis)
    return replace(record, axis=axis, history=(*record.history, _change(axis, source, of, at, apart, taken=True)))


class TurntableStore:
    """The turntable of a data folder. One process uses it, from any thread. root : its own folder in there,
    DATA/turntable.

    All methods raise StorageError: the disk refused, or the file is damaged. A damaged one is never
    overwritten: it has to be deleted first.
    """

    def __init__(self, root: Path) -> None:
        self._path = root / _FILE
        self._lock = threading.RLock()

    def record(self) -> TurntableRecord:
        """The record; an empty one where there is no file."""
        if not self._path.exists():
            return TurntableRecord()
        try:
            return read_turntable(self._path)
        except ConfigError as error:
            message = (
                f"The record of the turntable is damaged, and is left as it is. {error}\nBring {self._path} back from "
                f"a "
                "backup, or delete it (DELETE /rig/turntable) and calibrate the turntable again."
            )
            raise StorageError(message) from error

    def axis(self) -> MeasuredAxis | None:
        """The axis on record; None where none is."""
        return self.record().axis

    def planes(self) -> Sequence[TurntablePlane]:
        """Those that views are cut by."""
        return self.record().planes

    def put_axis(
        self, axis: MeasuredAxis, *, source: AxisSource, of: str, at: datetime | None = None
    ) -> TurntableRecord:
        """Put an axis on record in place of any other. of : what it was found by, by its id."""
        with self._lock:
            return self.replace(with_axis(self.record(), axis, source=source, of=of, at=at))

    def put_planes(self, planes: Sequence[TurntablePlane]) -> TurntableRecord:
        """Put planes on record in place of all others."""
        with self._lock:
            return self.replace(replace(self.record(), planes=tuple(planes)))

    def captured(self, job: Job, job_id: UUID) -> None:
        """See `slrig.jobs.job.Group`."""

    def ended(self, job: Job, job_id: UUID, outcome: Outcome | None) -> Outcome:  # noqa: ARG002 - as it is called
        """See `slrig.jobs.job.Group`: the axis that was measured is the one on record."""
        if outcome is None or outcome.summary is None:
            return outcome or Outcome()
        found = outcome.summary["axis"]
        axis = MeasuredAxis(*(np.array(found[name]) for name in ("point_mm", "direction", "covariance")))
        self.put_axis(axis, source=AxisSource.BOARD, of=str(job_id))
        return outcome

    def note(self, axis: MeasuredAxis, *, of: str, at: datetime | None = None) -> AxisUpdate | None:
        """Improve the axis on record by one that a model was found to turn about; None where none is on record.

        An axis that is too far from it (`MOST_SIGMAS`) is not taken, only reported.
        """
        with self._lock:
            record = self.record()
            if record.axis is None:
                return None
            found = update_axis(record.axis, axis)
            change = _change(axis, AxisSource.MODEL, of, at, found, taken=found.agrees)
            self.replace(replace(record, axis=found.axis, history=(*record.history, change)))
        if not found.agrees:
            _log.warning("the turntable was moved?", model=of, moved_mm=found.moved_mm, sigmas=found.sigmas)
        return found

    def replace(self, record: TurntableRecord) -> TurntableRecord:
        """Put a whole record in place of the one there is, unless that is damaged."""
        with self._lock:
            self.record()
            with storage_errors(self._path):
                self._path.parent.mkdir(exist_ok=True)
            write_file(self._path, encode_turntable(record))
            return record

    def delete(self) -> None:
        """Delete the turntable file. Idempotent."""
        with self._lock, storage_errors(self._path), suppress(FileNotFoundError):
            self._path.unlink()
            sync_folder(self._path.parent)


def _change(
    axis: MeasuredAxis, source: AxisSource, of: str, at: datetime | None, apart: AxisUpdate | None, *, taken: bool
) -> ChangeEntry:
    return ChangeEntry(
        at=at or utc_now(),
        source=source,
        of=of,
        point_mm=axis.point_mm.tolist(),
        direction=axis.direction.tolist(),
        point_sigma_mm=axis.point_sigma_mm,
        direction_sigma_deg=float(np.rad2deg(axis.direction_sigma_rad)),
        moved_mm=None if apart is None else apart.moved_mm,
        moved_deg=None if apart is None else apart.moved_deg,
        sigmas=None if apart is None else apart.sigmas,
        taken=taken,
    )


_HEIGHT = 470.0
_COLOURS = {AxisSource.BOARD: GREY, AxisSource.DOCUMENT: GREY, AxisSource.MODEL: GREEN}


def turntable_svg(history: Sequence[ChangeEntry], /) -> Markup:
    """The picture of all axes that were found, from old to new. With none it says so."""
    if not history:
        return nothing_yet("No axis was found yet. POST /rig/turntable/axis calibrates one.")
    moments = [each.at for each in history]
    apart = [_apart(history[0], each) for each in history]
    second = TOP + PANEL + GAP
    turns = [each.direction_sigma_deg for each in history]
    ends = [each.point_sigma_mm + AXIS_SPAN_MM * np.deg2rad(each.direction_sigma_deg) for each in history]
    parts = _panel(
        history, f"From the first axis, up to {AXIS_SPAN_MM:g} mm along it, mm", TOP, [mm for mm, _ in apart], ends
    )
    parts += _panel(history, "Its direction from the first one's, °", second, [deg for _, deg in apart], turns)
    for number, (colour, label) in enumerate(((GREY, "board"), (GREEN, "model"), (ORANGE, "not taken"))):
        x = END - 190 + 64 * number
        parts += [shape("circle", cx=x, cy=TOP - 16, r=3.2, fill=colour), shape("text", label, x=x + 8, y=TOP - 12)]
    title = f"the axis of the turntable as it was found {len(history)} times, now {apart[-1][0]:.3g} mm from the first"
    return trend(title, _HEIGHT, [*parts, *times(moments, second + PANEL)])


def _panel(
    history: Sequence[ChangeEntry], title: str, top: float, values: Sequence[float], sigmas: Sequence[float]
) -> list[Markup]:
    most = max(value + sigma for value, sigma in zip(values, sigmas, strict=True))
    panel = Panel([each.at for each in history], top, most, title)
    taken = [value if each.taken else None for value, each in zip(values, history, strict=True)]
    panel.line(taken, PALE, of=[""] * len(taken))
    for each, value, sigma in zip(history, values, sigmas, strict=True):
        colour = _COLOURS[each.source] if each.taken else ORANGE
        text = f"{each.source} {each.of}: {value:.4g} ± {sigma:.2g}" + ("" if each.taken else ", not taken")
        panel.bar(each.at, value, sigma, colour)
        panel.dot(each.at, value, colour, text)
    return panel.parts


def _apart(first: ChangeEntry, later: ChangeEntry) -> tuple[float, float]:
    """Largest distance of two axes, mm, up to 50 mm either way of the later one's point, and their angle, °."""
    way, other = np.array(first.direction), np.array(later.direction)
    ends = [np.array(later.point_mm) + s * other - np.array(first.point_mm) for s in (-AXIS_SPAN_MM, AXIS_SPAN_MM)]
    sine = min(float(np.linalg.norm(np.cross(way, other))), 1.0)
    return max(float(np.linalg.norm(np.cross(way, end))) for end in ends), float(np.rad2deg(np.arcsin(sine)))
