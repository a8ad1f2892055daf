"""What a catalogue says of rigs: frozen values, the same for whoever asks, and however."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

BEAT_S = 20.0
"""How often a rig says how it is."""

SEEN_S = 3 * BEAT_S
"""Until when that is believed: one beat may be late, and one be lost."""

STOPPED, UNSEEN = "stopped", "unseen"


@dataclass(frozen=True, slots=True)
class LastScan:
    """The scan of a rig that ended last. error : why it failed, where it did."""

    id: str
    label: str | None
    state: str
    finished_at: datetime
    error: str | None


@dataclass(frozen=True, slots=True)
class RigStanding:
    """A rig of the fleet. seen_s : how long ago it was seen, by the catalogue's clock. state : ready, busy, opening,
    fault; stopped, where its service ended in good order; unseen, where it was not seen for a minute. What it does, its
    backlog and its health are None or empty then: nobody knows. words : what it does, or why it cannot. waiting : for
    the rig. computing : scans that are reconstructed, or wait for that. uncopied : ended jobs that are still to be
    copied. verified_at : when its calibration was verified last. scans_of_day : that ended within 24 hours.
    """

    name: str
    host: str
    version: str
    started_at: datetime
    seen_at: datetime
    seen_s: float
    state: str
    words: str
    waiting: int | None
    computing: int | None
    uncopied: int | None
    health: str | None
    health_message: str
    verified_at: datetime | None
    last_scan: LastScan | None
    scans_of_day: int
    failed_of_day: int


@dataclass(frozen=True, slots=True)
class Fleet:
    """The rigs that have a catalogue in common, by their names."""

    catalogue: str
    rigs: tuple[RigStanding, ...]
