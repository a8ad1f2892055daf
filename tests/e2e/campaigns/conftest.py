"""Faulty rigs, and services on them that the tests of a file share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from slrig.client import Client
from tests.e2e.conftest import ServiceProcess, scanned
from tests.e2e.faulty_rig.service import Desk, serve

HASTY_S = 2.0


@dataclass(frozen=True, slots=True)
class Stand:
    """A running service that has done one scan, the desk of its rig, and a client."""

    desk: Desk
    service: ServiceProcess
    client: Client


@pytest.fixture(scope="module")
def stands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Stand]]:
    """One service for each kind of trigger, started by its first test."""
    made: dict[str, Stand] = {}
    with ExitStack() as leaving:

        def stand(trigger: str) -> Stand:
            if trigger not in made:
                desk = leaving.enter_context(Desk())
                # "hasty" : as by software, with limits that a test can wait for.
                hasty = trigger == "hasty"
                way, call_s = ("software", HASTY_S) if hasty else (trigger, 0.0)
                service = serve(tmp_path_factory.mktemp(trigger), desk, way, call_s=call_s)
                leaving.callback(service.kill)
                made[trigger] = Stand(desk, service, leaving.enter_context(service.client()))
                assert scanned(made[trigger].client)["state"] == "succeeded", service.log.read_text()
            made[trigger].desk.lift()
            made[trigger].desk.forget()
            return made[trigger]

        yield stand


@pytest.fixture
def stand(stands: Callable[[str], Stand]) -> Iterator[Stand]:
    yield stands("software")
    stands("software")


@pytest.fixture
def desk() -> Iterator[Desk]:
    with Desk() as desk:
        yield desk


@pytest.fixture
def serve_again(tmp_path: Path, desk: Desk) -> Iterator[Callable[..., ServiceProcess]]:
    with ExitStack() as leaving:

        def served(**settings: Any) -> ServiceProcess:
            service = serve(tmp_path, desk, **settings)
            leaving.callback(service.kill)
            return service

        yield served
