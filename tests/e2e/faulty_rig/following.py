"""Somebody who follows a scan while the service ends."""

from __future__ import annotations

import threading
from typing import Any

from slrig.client import Client
from slrig.client.events import StateChange
from slrig.errors import ServiceError
from tests.e2e.conftest import KEY, ServiceProcess
from tests.e2e.faulty_rig.desk import WAIT_S


class Follower:
    """Follows a scan by one event stream, on a thread of its own, and does not connect again. `states` : as told."""

    def __init__(self, service: ServiceProcess, scan: dict[str, Any]) -> None:
        self._url = service.url
        self._scan = scan
        self.states: list[str] = []
        self._began = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()
        assert self._began.wait(WAIT_S)

    def last(self) -> str:
        """The last state that it was told of, once its stream has ended."""
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()
        return self.states[-1]

    def _follow(self) -> None:
        with Client(self._url, KEY, pause=_give_up) as client:
            try:
                for event in client.follow(self._scan["links"]["events"]):
                    if isinstance(event, StateChange):
                        self.states.append(event.state)
                    self._began.set()
            except ServiceError:
                # The stream broke off, or there is nothing more to connect to.
                return


def _give_up(_: float) -> None:
    message = "the stream broke off"
    raise ServiceError(message)
