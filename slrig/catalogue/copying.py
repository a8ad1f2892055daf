"""What a service tells the catalogue, on a thread of its own: every job that ended, in order, and how its rig is.

The rig's own record is the truth, and no part of it waits for the catalogue.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import structlog

from slrig.catalogue.fleet import BEAT_S, STOPPED, Fleet
from slrig.catalogue.store import Catalogue
from slrig.errors import CatalogueError, StorageError
from slrig.jobs.copies import Copies

BATCH = 200
"""Jobs in one transaction, some hundred kB."""

FIRST_WAIT_S = 1.0
LONGEST_WAIT_S = 30.0
"""Between tries. A thousand rigs whose catalogue is away then ask it thirty times a second."""

_END_S = 1.0

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Copying:
    """How the copying goes. fault : why not, None while it does. waiting, oldest_s : jobs that are not copied, and how
    long the oldest has waited.
    """

    fault: str | None
    waiting: int
    oldest_s: float


class Copier:
    """Tells the catalogue. Nothing waits for it, but `close`, for a second at most.

    standing : gives how the rig is, by the columns of its row but for `seen_at` and `uncopied`. clock : seconds that
    only grow.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        copies: Copies,
        standing: Callable[[], Mapping[str, Any]],
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._catalogue = catalogue
        self._copies = copies
        self._standing = standing
        self._clock = clock
        self._opened = False
        self._fault: str | None = "It was not reached yet"
        self._failures = 0
        self._beat_at_s = -float("inf")
        self._told_uncopied = 0
        self._left = threading.Event()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="slrig-catalogue", daemon=True)

    def start(self) -> None:
        """Begin to copy."""
        self._thread.start()

    def close(self) -> None:
        """Say that the rig is stopped, and copy no more, if that goes quickly. Idempotent."""
        self._ending.set()
        self._copies.news.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)
        self._left.set()

    def status(self) -> Copying:
        """How it goes. Raises StorageError."""
        return Copying(self._fault, *self._copies.waiting())

    def fleet(self) -> Fleet:
        """Every rig of the catalogue. Asks nothing of one that is away: raises CatalogueError at once."""
        if self._fault is not None:
            message = f"{self._fault}. This rig scans on, and tries again by itself."
            raise CatalogueError(message)
        with suppress(CatalogueError):
            return self._catalogue.fleet()
        # The connection may be older than the last start of the database, which says nothing of that.
        self._catalogue.close()
        try:
            return self._catalogue.fleet()
        except CatalogueError as error:
            # Nobody else is to wait for it before it was reached again.
            self._fault = str(error).rstrip(".")
            self._copies.news.set()
            raise

    def step(self) -> float:
        """Copy what waits, and say how the rig is, if that is due. Returns the seconds until it is due again.

        Raises CatalogueError; StorageError, if the rig's own records refuse.
        """
        if not self._opened:
            self._catalogue.open()
            self._copy_what_it_lacks()
            self._opened = True
        # In the order in which they ended: a copy that was not noted as taken comes again, and makes no second row.
        while not self._left.is_set() and (copies := self._copies.oldest(BATCH)):
            self._catalogue.copy([each.job for each in copies])
            if self._left.is_set():
                break
            self._copies.taken(copies)
            self._say_how_it_is()
        self._say_how_it_is()
        return self._beat_at_s + BEAT_S - self._clock()

    def _say_how_it_is(self, **other: Any) -> None:
        """If that is due, or the backlog that was told last is gone."""
        uncopied, _ = self._copies.waiting()
        if other or self._clock() >= self._beat_at_s + BEAT_S or (self._told_uncopied and not uncopied):
            self._catalogue.see({**self._standing(), "uncopied": uncopied, **other})
            self._beat_at_s, self._told_uncopied = self._clock(), uncopied

    def _copy_what_it_lacks(self) -> None:
        """Bring up what ended before there was this catalogue, or what it lost: it may be an older backup of itself."""
        ended = self._copies.ended()
        for begin in range(0, len(ended), BATCH):
            if self._left.is_set():
                return
            some = ended[begin : begin + BATCH]
            lacking = set(some) - self._catalogue.known(some)
            if lacking and (jobs := self._copies.of(lacking)):
                self._catalogue.copy(jobs)

    def _run(self) -> None:
        while True:
            self._copies.news.clear()
            wait_s = self._tried()
            if self._ending.is_set():
                break
            (self._copies.news if self._fault is None else self._ending).wait(wait_s)
            if self._ending.is_set():
                break
        if self._fault is None:
            with suppress(CatalogueError, StorageError):
                self.step()
                self._say_how_it_is(state=STOPPED, words="")
        self._catalogue.close()

    def _tried(self) -> float:
        try:
            wait_s = self.step()
        except Exception as error:  # noqa: BLE001 - whatever it was, the next try may go well
            known = isinstance(error, (CatalogueError, StorageError))
            fault = str(error).rstrip(".") if known else f"The catalogue cannot be used: {type(error).__name__}"
            wait_s = min(FIRST_WAIT_S * 2.0 ** min(self._failures, 30), LONGEST_WAIT_S)
            self._failures += 1
            if fault != self._fault:
                _log.warning("the catalogue is not told of this rig", cause=fault, exc_info=not known)
            self._fault, self._opened = fault, False
            self._catalogue.close()
            return wait_s
        if self._fault is not None:
            _log.info("the catalogue is told of this rig", catalogue=self._catalogue.address)
        self._fault, self._failures = None, 0
        return wait_s
