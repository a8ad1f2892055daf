"""The service's interface, an operation each, in namespaces; what each parameter means is in /openapi.json.

What is not given, or None, is as the service has it by default.
"""

# mypy: disable-error-code="empty-body"

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack

from slrig.client.core import Core, Json, W
from slrig.client.errors import RefusedError
from slrig.client.events import Event
from slrig.client.operations import Operation, Remote, endpoint, entry, stream

if TYPE_CHECKING:
    from slrig.client.core import Picture

IfBusy = Literal["reject", "queue"]
Position = int | str


class ScanOptions(TypedDict, total=False):
    """What a scan may be asked for. exposure_s, exposures_s, every_s in seconds; turned_by "table" or "hand"."""

    label: str | None
    preset: str | None
    exposure_s: float | None
    exposures_s: Sequence[float] | None
    exposure_factors: Sequence[float] | None
    patterns: Mapping[str, Any] | None
    reconstruction: Mapping[str, Any] | None
    colour: bool | None
    coloured_light: bool | None
    turn_deg: float | None
    turned_by: str | None
    if_busy: IfBusy | None
    repeat: int | None
    every_s: float | None


def _told(self: object) -> Json: ...
def _done(self: object) -> None: ...
def _text(self: object) -> str: ...
def _listed(self: object, *, limit: int | None = None) -> Json: ...
def _plotted(self: object, *, limit: int | None = None) -> str: ...
def _told_of_pose(self: object, which: str, number: int, /) -> Json: ...
def _done_to_pose(self: object, which: str, number: int, /) -> None: ...


def paged(self: object, *, cursor: int | None = None, limit: int | None = None) -> Json:
    """The shape of an operation that returns a page of a list."""


def told_of(self: object, which: str, /) -> Json:
    """The shape of one that returns what it is told of."""


def done_to(self: object, which: str, /) -> None:
    """The shape of one that returns nothing."""


def file_of(self: object, which: str, name: str, /) -> bytes:
    """The shape of one that returns a file, by its name."""


class Scans(Remote[W]):
    """Scans on record."""

    @endpoint("POST /scan", once=True)
    def start(self, **options: Unpack[ScanOptions]) -> Json:
        """Start a scan, and return it as it is on record; `Client.start_scan` returns one to follow."""

    @endpoint("POST /exposure")
    def exposure(
        self,
        *,
        budget_s: float | None = None,
        preset: str | None = None,
        patterns: Mapping[str, Any] | None = None,
        coloured_light: bool | None = None,
    ) -> Json:
        """Look at the object, and propose exposures: `scan` of the answer is what `start` takes. budget_s : seconds."""

    list = entry(
        "GET /scan", paged, "A page of scans from new to old: `scans`, and `next`, the path of the page after it."
    )
    look = entry("GET /scan/{scan_id}", told_of, "A scan: its state, how far it is, and where its files are.")
    delete = entry("DELETE /scan/{scan_id}", done_to, "Delete a finished scan with all its files.")
    cancel = entry("POST /scan/{scan_id}/cancel", told_of, "Ask a scan to stop between two frames.")
    pin = entry("PUT /scan/{scan_id}/pin", told_of, "Keep a scan, whatever the settings say of old ones.")
    unpin = entry("DELETE /scan/{scan_id}/pin", told_of, "Let a scan be removed when it is old.")
    series = entry("GET /scan/series/{series_id}", told_of, "The scans of a series.")
    cancel_series = entry("POST /scan/series/{series_id}/cancel", told_of, "Ask all scans of a series to stop.")
    file = entry("GET /scan/{scan_id}/{name}", file_of, "A file of a scan, by its name.")

    @stream("GET /scan/{scan_id}/events", Core.follow)
    def follow(self, scan_id: str) -> Event:
        """What happens to a scan until it is over, from its beginning."""


class Presets(Remote[W]):
    """Options of scans by name."""

    list = entry("GET /preset", _told, "The presets: shipped, of the rig file, and kept by the service.")
    look = entry("GET /preset/{name}", told_of, "A preset as a document, which another service takes as it is.")
    delete = entry("DELETE /preset/{name}", done_to, "Delete a preset that was put.")

    @endpoint("PUT /preset/{name}", content="document")
    def put(self, name: str, document: Mapping[str, Any] | str | bytes) -> Json:
        """Keep a preset by this name."""


class RigState(Remote[W]):
    """The rig, and what is plugged in."""

    look = entry(
        "GET /rig", _told, "The rig: its devices, positions, calibration in use, who holds it, and how many scans wait."
    )
    devices = entry(
        "GET /device",
        _told,
        "The drivers that are installed, the devices that are plugged in, and the libraries that are missing.",
    )
    examinations = entry(
        "GET /rig/examinations", _told, "What `slrig doctor` and `slrig conform` found last on this rig."
    )

    @stream("GET /preview/{camera}", Core.pictures)
    def pictures(self, camera: str, *, light: Literal["off", "white"] = "off", marks: bool = False) -> Picture:
        """What a camera sees while nobody scans, picture by picture."""


class Calibrations(Remote[W]):
    """Calibrations: a session of poses, a solve, and its use."""

    @endpoint("POST /calibration")
    def open(
        self,
        *,
        board: Mapping[str, Any] | None = None,
        label: str | None = None,
        patterns: Mapping[str, Any] | None = None,
        projector: bool | None = None,
    ) -> Json:
        """A new session."""

    list = entry("GET /calibration", _listed, "Calibrations, newest first, and the active one.")

    @endpoint("POST /calibration/import", query=("label",), content="document")
    def submit(self, document: Mapping[str, Any] | str | bytes, *, label: str | None = None) -> Json:
        """Give a calibration that was found elsewhere: slrig's as a dict or JSON, OpenCV's YAML or XML as text."""

    @endpoint("GET /calibration/board.pdf")
    def board(
        self,
        *,
        kind: Literal["charuco", "chessboard", "circles"] | None = None,
        columns: int | None = None,
        rows: int | None = None,
        square_mm: float | None = None,
        marker_mm: float | None = None,
        dictionary: str | None = None,
        page: str | None = None,
    ) -> bytes:
        """A board to print, as PDF."""

    @endpoint("GET /calibration/compare")
    def compare(self, first: str, second: str) -> Json:
        """What the second of two calibrations says otherwise than the first."""

    look = entry(
        "GET /calibration/{calibration_id}",
        told_of,
        "A calibration: its poses, what they cover, what to do next, and its solve.",
    )
    delete = entry("DELETE /calibration/{calibration_id}", done_to, "Delete a calibration.")

    @endpoint("POST /calibration/{calibration_id}/pose", once=True)
    def shoot(
        self,
        calibration_id: str,
        *,
        position: Position | None = None,
        exposure_s: float | None = None,
        if_busy: IfBusy | None = None,
    ) -> Json:
        """Shoot a pose where the board is held, or at a position of the positioner."""

    @endpoint("POST /calibration/{calibration_id}/script", once=True)
    def script(
        self,
        calibration_id: str,
        *,
        positions: Sequence[Position] | None = None,
        exposure_s: float | None = None,
        if_busy: IfBusy | None = None,
    ) -> Json:
        """Shoot poses of the positioner one after the other, all unless some are named."""

    pose = entry("GET /calibration/{calibration_id}/pose/{number}", _told_of_pose, "A pose, and what was found of it.")
    drop_pose = entry("DELETE /calibration/{calibration_id}/pose/{number}", _done_to_pose, "Take a pose out.")
    cancel_pose = entry(
        "POST /calibration/{calibration_id}/pose/{number}/cancel", _told_of_pose, "Ask a pose to end early."
    )

    @endpoint("POST /calibration/{calibration_id}/solve")
    def solve(self, calibration_id: str, *, board_shape: Literal["auto", "flat", "bowed"] | None = None) -> Json:
        """Solve from all accepted poses."""

    activate = entry("POST /calibration/{calibration_id}/activate", told_of, "Have scans use it from now on.")
    deactivate = entry("POST /calibration/{calibration_id}/deactivate", told_of, "Have scans use the rig's own again.")
    file = entry(
        "GET /calibration/{calibration_id}/{name}",
        file_of,
        "calibration.json, calibration.yml or calibration.xml (OpenCV's), or report.html.",
    )

    @endpoint("GET /calibration/{calibration_id}/pose/{number}/picture.png")
    def pose_picture(self, calibration_id: str, number: int, *, camera: str | None = None) -> Picture:
        """A pose as a camera saw it, with the corners that were found."""

    @endpoint("GET /calibration/{calibration_id}/coverage.png")
    def coverage(self, calibration_id: str, *, device: str | None = None) -> Picture:
        """What of a device's picture the poses cover."""

    @stream("GET /calibration/{calibration_id}/events", Core.follow)
    def follow(self, calibration_id: str) -> Event:
        """What happens to a calibration while something is under way, from its beginning."""


class RigHealth(Remote[W]):
    """Whether the calibration in use still holds."""

    look = entry("GET /rig/health", _told, "The verdict, its reasons, and what to do.")

    @endpoint("GET /rig/health/history")
    def history(self, *, limit: int | None = None, since: str | None = None) -> Json:
        """Verifications, newest first. since : ISO 8601, with its offset from UTC."""

    plot = entry("GET /rig/health.svg", _plotted, "The newest verifications over time, as SVG.")

    @endpoint("POST /rig/verification", once=True)
    def verify(
        self,
        *,
        board: Mapping[str, Any] | None = None,
        position: int | None = None,
        exposure_s: float | None = None,
        if_busy: IfBusy | None = None,
    ) -> Json:
        """Shoot the board, and judge the calibration in use by it."""

    verification = entry(
        "GET /rig/verification/{verification_id}",
        told_of,
        "A verification: its state, and what was found, or why nothing was.",
    )
    cancel = entry("POST /rig/verification/{verification_id}/cancel", told_of, "Ask a verification to end early.")

    @stream("GET /rig/verification/{verification_id}/events", Core.follow)
    def follow(self, verification_id: str) -> Event:
        """What happens to a verification until it is over, from its beginning."""


class Acceptance(Remote[W]):
    """Acceptance tests, position by position."""

    @endpoint("POST /acceptance", once=True)
    def open(
        self,
        *,
        artefacts: Mapping[str, Any] | None = None,
        volume_mm: Sequence[Sequence[float]] | None = None,
        wanted_mm: float | None = None,
        limits: Mapping[str, Any] | None = None,
        repeats: int | None = None,
        exposure_s: float | None = None,
        notes: str | None = None,
    ) -> Json:
        """A new test of the rig as it is calibrated now."""

    list = entry("GET /acceptance", _listed, "Tests, newest first.")
    look = entry(
        "GET /acceptance/{test_id}", told_of, "A test: what to do next, what was measured, and what was decided."
    )
    delete = entry("DELETE /acceptance/{test_id}", done_to, "Delete a test with all its files.")

    @endpoint("POST /acceptance/{test_id}/position", once=True)
    def measure(self, test_id: str, *, scripted: bool | None = None, if_busy: IfBusy | None = None) -> Json:
        """Measure the next position; by script, all that are left."""

    cancel = entry("POST /acceptance/{test_id}/cancel", told_of, "End a test early.")
    file = entry("GET /acceptance/{test_id}/{name}", file_of, "report.html or report.json.")


class Schedules(Remote[W]):
    """Work for the rig at set times."""

    list = entry("GET /schedule", _told, "Every schedule, oldest first.")

    @endpoint("POST /schedule")
    def add(
        self,
        cron: str,
        task: Literal["verification", "calibration", "acceptance"],
        *,
        time_zone: str | None = None,
        options: Mapping[str, Any] | None = None,
        label: str | None = None,
        grace_s: float | None = None,
        retry_s: float | None = None,
        catch_up: bool | None = None,
        enabled: bool | None = None,
    ) -> Json:
        """Have a task done by the clock: "30 6 * * mon-fri" is 06:30 on working days."""

    look = entry("GET /schedule/{schedule_id}", told_of, "A schedule, with its next due times.")
    remove = entry("DELETE /schedule/{schedule_id}", done_to, "Forget a schedule and its runs.")

    @endpoint("GET /schedule/{schedule_id}/runs")
    def runs(self, schedule_id: str, *, cursor: int | None = None, limit: int | None = None) -> Json:
        """A page of what became of its due times, from new to old."""

    run = entry("POST /schedule/{schedule_id}/run", told_of, "Do it now.")
    pause = entry("POST /schedule/{schedule_id}/pause", told_of, "Let nothing become due until it is resumed.")
    resume = entry("POST /schedule/{schedule_id}/resume", told_of, "Go on after a pause.")
    cancel = entry("POST /schedule/{schedule_id}/cancel", told_of, "Have the run under way end early.")


class System(Remote[W]):
    """The service itself."""

    alive = entry("GET /livez", _told, "Whether it runs.")
    ready = entry(
        "GET /readyz", _told, "Whether it can scan. A RefusedError tells what is not ready; `readiness` returns it."
    )

    @Operation
    async def readiness(self) -> Json:
        """The `checks` of `ready`, each "ok" or what it lacks, and those `pending`, that get there by themselves."""
        try:
            found: Json = await self.core.content("Json", "GET", "/readyz")
        except RefusedError as error:
            if "checks" not in error.problem:
                raise
            found = error.problem
        return {"checks": dict(found["checks"]), "pending": list(found.get("pending", ()))}

    metrics = entry("GET /metrics", _text, "Figures for Prometheus.")
    fleet = entry("GET /fleet", _told, "The rigs that share a catalogue: how each is, its last scan, its backlog.")
    audit = entry("GET /audit", paged, "A page of who did what, from new to old.")
    explain = entry("GET /problems/{name}", told_of, "What a kind of problem means.")
    session = entry("GET /session", _told, "Whom the service takes this client for.")
    open_session = entry("POST /session", _told, "Log in by a cookie, as a browser does.")
    close_session = entry("DELETE /session", _done, "Log out.")

    @stream("GET /events", Core.follow_all)
    def follow(self, *, after: int | None = None) -> Event:
        """What happens to all jobs from now on; after=0 begins with the oldest event on record."""

    @endpoint("GET /session/link")
    def follow_link(self, token: str) -> None:
        """Log in by the link that `slrig serve` printed."""
