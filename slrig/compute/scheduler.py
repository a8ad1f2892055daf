"""The scheduler of a pool: gives the orders of rigs to workers, one at a time each, and what these say back to rigs. It
reads no more of an order than for whom it is.
"""

from __future__ import annotations

import asyncio
import shutil
import socket
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import structlog

from slrig.compute.certificates import make_certificates
from slrig.compute.link import (
    CONNECT_S,
    LINE_BYTES,
    POOL_FAULT,
    Hello,
    Link,
    Message,
    PoolError,
    PoolRequest,
    PoolResponse,
    Progress,
    Refused,
    Versions,
    Withdrawal,
    Workers,
    run_until_stopped,
)
from slrig.compute.security import MEMBER, PoolAddress, require_private
from slrig.disk import storage_errors
from slrig.errors import ServiceError
from slrig.failure import JobFailure

_log = structlog.get_logger(__name__)


@dataclass(slots=True)
class Given:
    """An order of a rig. rig : None once it is no longer wanted."""

    order: PoolRequest
    rig: Link | None


class Scheduler:
    """Gives orders of rigs to workers; for one event loop. `heard` and `gone` are its only events."""

    def __init__(self) -> None:
        self._rigs: set[Link] = set()
        self._workers: dict[Link, Versions] = {}
        self._waiting: list[Given] = []
        self._doing: dict[Link, Given] = {}

    async def attend(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a member with a checked certificate until it is gone."""
        link = Link(reader, writer)
        try:
            await link.hear(partial(self.heard, link))
        except asyncio.CancelledError:
            pass  # the scheduler ends; Python 3.11 would report this as an error
        except OSError as error:
            _log.info("a member was lost", cause=type(error).__name__)
        except PoolError as error:
            _log.warning("a member is refused", address=writer.get_extra_info("peername"), cause=str(error))
            link.send(Refused(cause=str(error)))
        finally:
            self.gone(link)
            link.close()

    def heard(self, link: Link, message: Message) -> None:
        """Act on what a member says. Raises PoolError: it is none of its business."""
        match message:
            case Hello(versions=None):
                self._rigs.add(link)
                link.send(self._roster())
            case Hello(versions=versions) if versions is not None:
                self._workers[link] = versions
                self._inform_rigs()
            case PoolRequest() if link in self._rigs:
                self._waiting.append(Given(message, link))
            case Withdrawal(job=job) if link in self._rigs:
                self._withdraw(lambda given: given.rig is link and given.order.job == job)
            case Progress(job=job) | PoolResponse(job=job) if link in self._workers:
                given = self._doing.get(link)
                if given is not None and given.order.job == job:
                    if given.rig is not None:
                        given.rig.send(message)
                    if isinstance(message, PoolResponse):
                        del self._doing[link]
            case _:
                cause = f"a {type(message).__name__} has no place here: each says first whether it is a worker or a rig"
                raise PoolError(cause)
        self._give()

    def gone(self, link: Link) -> None:
        """Handle the loss of a member: inform the rig that it worked for, and withdraw its own orders."""
        self._rigs.discard(link)
        self._withdraw(lambda given: given.rig is link)
        if self._workers.pop(link, None) is None:
            return
        given = self._doing.pop(link, None)
        if given is not None and given.rig is not None:
            # It knows what is to be done: it gives the order again, or computes by itself.
            given.rig.send(PoolResponse(job=given.order.job, fault=JobFailure(POOL_FAULT, "its worker was lost")))
        self._inform_rigs()
        self._give()

    def _withdraw(self, unwanted: Callable[[Given], bool]) -> None:
        self._waiting = [given for given in self._waiting if not unwanted(given)]
        for worker, given in self._doing.items():
            if unwanted(given):
                given.rig = None
                worker.send(Withdrawal(job=given.order.job))

    def _give(self) -> None:
        """Give each free worker the first order that it can do."""
        for worker, versions in self._workers.items():
            if worker in self._doing:
                continue
            given = next((each for each in self._waiting if each.order.versions == versions), None)
            if given is not None:
                self._waiting.remove(given)
                self._doing[worker] = given
                worker.send(given.order)

    def _roster(self) -> Workers:
        found = {tuple(versions.items()): versions for versions in self._workers.values()}
        return Workers(versions=list(found.values()))

    def _inform_rigs(self) -> None:
        roster = self._roster()
        for rig in self._rigs:
            rig.send(roster)


def serve_scheduler(address: PoolAddress, *, say: Callable[[str], None]) -> None:
    """Be the scheduler of a pool until SIGTERM or Ctrl-C. Where no certificates are named, new ones are made for the
    members of this user on this machine. Raises ServiceError: it cannot listen there; ConfigError; StorageError.
    """

    async def life() -> None:
        try:
            family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
            listening = socket.create_server((address.host, address.port), family=family)
        except OSError as error:
            message = f"The pool's scheduler cannot listen at {address}: {error}. Choose another host or port."
            raise ServiceError(message) from error
        found = replace(address, port=listening.getsockname()[1])
        if found.certificates is None:
            _renew(found.own_folder)
        scheduler = Scheduler()
        server = await asyncio.start_server(
            scheduler.attend, sock=listening, limit=LINE_BYTES, ssl=found.tls(listens=True),
            ssl_handshake_timeout=CONNECT_S, ssl_shutdown_timeout=CONNECT_S,
        )  # fmt: skip
        try:
            say(f"the pool's scheduler is at {found}. Ctrl-C stops it.")
            await asyncio.Event().wait()
        finally:
            server.close()

    run_until_stopped(life)


def _renew(folder: Path) -> None:
    """Make new certificates in a folder that only this user can read. Raises ConfigError, StorageError."""
    with storage_errors(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        require_private(folder)
        for each in folder.iterdir():
            shutil.rmtree(each) if each.is_dir() else each.unlink()
    make_certificates(folder, (MEMBER,))
