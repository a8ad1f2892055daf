"""A driver is somebody else's code: what it raises or returns, at any call, ends one scan in words and nothing else.

The words name the device and the step, and do not blame slrig. `/readyz` tells what is. The next scan has a right mesh.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest
import trimesh

from slrig.errors import ServiceError
from tests.e2e.campaigns.conftest import Stand
from tests.e2e.campaigns.test_faults import BROKEN, MIDDLE
from tests.e2e.conftest import ended, scanned
from tests.e2e.faulty_rig.driver import CAMERA_NAME, PLAYER, TABLE
from tests.e2e.faulty_rig.foreign import RAISED
from tests.e2e.faulty_rig.service import Step
from tests.e2e.schedules import awaited

pytestmark = pytest.mark.slow

WALL_MM = 500.0


@dataclass(frozen=True, slots=True)
class Case:
    """A kind of fault at a call. harmless : the scan succeeds all the same. step : what the words call the call."""

    device: str
    name: str
    kind: str
    number: int = -1
    harmless: bool = False
    step: str = ""

    def __str__(self) -> str:
        return f"{self.device}-{self.name}-{self.kind}".replace(" ", "_")

    @property
    def words(self) -> tuple[str, str]:
        return self.device, self.step or self.name


CALLS = {
    CAMERA_NAME: ("open", "info", "configure", "arm", "trigger", "read", "disarm", "close"),
    PLAYER: ("open", "info", "load", "show", "blank", "close"),
    TABLE: ("open", "poses", "turn", "close"),
}
AFTERWARDS = {"disarm", "close"}
"""Calls that come when all frames are there."""

OPENING = {"open", "info", "poses", "close"}
"""Calls of a rig that is opened; it is closed before by another fault."""

AT_EVERY_CALL = ("SystemExit", "KeyboardInterrupt", "VendorError", "wordless", "half character")


def raised() -> Iterator[Case]:
    for device, names in CALLS.items():
        for name in names:
            for kind in RAISED if (device, name) == (CAMERA_NAME, "read") else AT_EVERY_CALL:
                number = MIDDLE if name in {"read", "show"} else -1
                yield Case(device, name, kind, number, name in AFTERWARDS, "info" if name == "poses" else "")


def returned() -> Iterator[Case]:
    harmless = {"turned memory", "every second sample", "half a character"}
    # Of these a single one may come of a bad cable.
    evidence = {"a cut image", "a huge image", "times of 1970", "the same number"}
    kinds = {
        (CAMERA_NAME, "read"): (
            "nothing", "a number", "a generator", "a cut image", "a huge image", "an empty image", "wide samples",
            "a list for an image", "turned memory", "every second sample", "NaN for a time", "an endless time",
            "2^70 ns", "an end before the start", "-5 ns of error", "text for a time", "times of another clock",
            "times of 1970", "another camera's name", "a name of bytes", "-5 dropped", "2^40 dropped",
            "the same number", "NaN for an exposure", "text for an exposure", "an endless gain",
        ),
        (CAMERA_NAME, "configure"): ("nothing", "a dict", "NaN s", "0 s", "text for a gain"),
        (CAMERA_NAME, "info"): (
            "nothing", "no format", "no triggers", "NaN for a range", "endless limits", "a serial of a number",
            "half a character",
        ),
        (CAMERA_NAME, "open"): ("nothing", "a number"),
        (PLAYER, "open"): ("nothing", "a generator"),
        (PLAYER, "info"): ("nothing", "no size", "NaN for a delay", "endless limits", "half a character"),
        (PLAYER, "show"): ("nothing", "another pattern", "light in 10 000 s", "NaN for the light", "an endless error"),
        (TABLE, "open"): ("nothing",),
        (TABLE, "poses"): ("nothing", "a number", "NaN for an angle"),
    }  # fmt: skip
    for (device, name), each in kinds.items():
        for kind in each:
            number, step = (MIDDLE if name == "show" else -1), ("pattern" if kind in evidence else "")
            yield Case(device, name, kind, number, kind in harmless, step)


CASES = (*raised(), *returned())
assert len(CASES) >= 52


@pytest.mark.parametrize("case", CASES, ids=str)
def test_foreign_code_ends_its_scan_in_words_and_nothing_else(stand: Stand, case: Case) -> None:
    desk, client = stand.desk, stand.client
    desk.fault(Step(case.device, case.name, case.number), case.kind)
    if case.name in OPENING:
        # The rig is closed after this one, and opened again.
        desk.fault(*BROKEN)
        assert scanned(client)["state"] == "failed"
        desk.fault(BROKEN[0], "go")
    record = scanned(client, **({"turn_deg": 30.0} if case.device == TABLE else {}))
    told_the_truth(stand)
    check(record, case)
    desk.lift()
    again = scanned(client)
    assert again["state"] == "succeeded", again
    awaited(lambda: not faults(stand), "readiness")
    right_mesh(stand, again)


def check(record: dict[str, Any], case: Case) -> None:
    if case.harmless:
        assert record["state"] == "succeeded", record
        return
    assert record["state"] == "failed", record
    detail = record["error"]["detail"]
    assert [word for word in case.words if word not in detail] == [], detail
    assert "slrig met" not in detail
    assert record["error"]["type"] != "/problems/unexpected"
    assert len(detail) < 3000
    assert detail.isprintable() or "\n" in detail, detail


def told_the_truth(stand: Stand) -> None:
    """`/readyz` and `GET /rig` agree, once the rig is not being opened."""
    awaited(lambda: (checks(stand)["rig"] == "ok") == stand.client.get("/rig")["open"], "the truth")


def checks(stand: Stand) -> dict[str, str]:
    found: dict[str, str] = stand.client.system.readiness()["checks"]
    return found


def faults(stand: Stand) -> dict[str, str]:
    """Why the service cannot scan, by `/readyz`."""
    return {name: found for name, found in checks(stand).items() if found != "ok"}


def right_mesh(stand: Stand, record: dict[str, Any]) -> None:
    data = stand.client.scans.file(record["id"], "mesh.ply")
    mesh = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    depths_mm = -mesh.vertices[:, 2]
    assert len(depths_mm) > 1000
    assert abs(depths_mm - WALL_MM).max() < 5.0


HANGING = [
    Step(CAMERA_NAME, "configure"), Step(CAMERA_NAME, "arm"), Step(CAMERA_NAME, "trigger"),
    Step(CAMERA_NAME, "read", MIDDLE), Step(CAMERA_NAME, "disarm"),
    Step(PLAYER, "load"), Step(PLAYER, "show", MIDDLE), Step(PLAYER, "blank"),
]  # fmt: skip


@pytest.mark.parametrize("step", HANGING, ids=str)
def test_a_call_that_hangs_ends_its_scan_in_words_and_the_next_goes_on(
    stands: Callable[[str], Stand], step: Step
) -> None:
    stand = stands("hasty")
    with stand.desk.held(step) as hold:
        scan = stand.client.scans.start()
        hold.until_reached()
        record = ended(stand.client, scan)
        assert record["state"] == "failed", record
        for words in (step.device, f"not come back from {step.name}", "restart the service"):
            assert words in record["error"]["detail"]
        assert "not come back" in checks(stand)["rig"]
        with pytest.raises(ServiceError, match="not come back"):
            stand.client.scans.start(if_busy="queue")
    assert stand.desk.came(PLAYER, "open")
    again = scanned(stand.client)
    assert again["state"] == "succeeded", again
    awaited(lambda: not faults(stand), "readiness")
    right_mesh(stand, again)
