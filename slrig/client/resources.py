"""The service's requests, grouped by what they are about: one plain method for each. Answers are dicts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict, Unpack

from slrig.client.connection import Event, Json, Progress, Resource, document_body, given, path
from slrig.client.errors import ExaminationFailedError, ModelFailedError, RefusedError

if TYPE_CHECKING:
    from slrig.client.connection import Picture

IfBusy: TypeAlias = Literal["reject", "queue"]
ProgressCallback: TypeAlias = Callable[[str, float, str], object]
"""Called with the stage of a job, 0 to 1 of the whole, and a detail."""
Position: TypeAlias = int | str
Poses: TypeAlias = Literal["turntable", "markers", "unknown"] | Sequence[Sequence[Sequence[float]]]
"""Source of the poses of a model's scans; or the poses themselves, 4 x 4 each, in mm."""


class ScanFields(TypedDict, total=False):
    """The options of a scan, as `Client.scan` explains them."""

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
    robot_pose: Sequence[Sequence[float]] | None
    if_busy: IfBusy | None
    repeat: int | None
    every_s: float | None


class Scans(Resource):
    """Scans on record."""

    def start(self, **options: Unpack[ScanFields]) -> Json:
        """Start a scan, and return its record; `Client.start_scan` returns a job to follow."""
        return self._connection.json("POST", "/scan", once=True, json=given(**options))

    def exposure(
        self,
        *,
        budget_s: float | None = None,
        preset: str | None = None,
        patterns: Mapping[str, Any] | None = None,
        coloured_light: bool | None = None,
    ) -> Json:
        """Take test pictures of the object, and propose exposures: `scan` of the answer holds options for `start`.

        budget_s : for all exposures of a scan together, seconds.
        """
        options = given(budget_s=budget_s, preset=preset, patterns=patterns, coloured_light=coloured_light)
        return self._connection.json("POST", "/exposure", json=options)

    def list(
        self,
        *,
        name: str | None = None,
        state: str | Sequence[str] | None = None,
        since: str | None = None,
        until: str | None = None,
        rig: str | None = None,
        preset: str | None = None,
        cursor: int | None = None,
        limit: int | None = None,
    ) -> Json:
        """A page of scans from new to old: `scans`, and `next`, the path of the page after it.

        name : part of the name, upper or lower case, or the start of the id. state : one of these. since, until :
        when they were created, ISO 8601 with the offset from UTC; the latter is excluded. rig, preset : by their names.
        """
        filters = given(name=name, state=state, since=since, until=until, rig=rig, preset=preset)
        return self._connection.json("GET", "/scan", params={**filters, **given(cursor=cursor, limit=limit)})

    def files(self, scan_ids: Sequence[str], file: str | None = None) -> bytes:
        """A zip of one file of each of several scans, 50 at most. file : its name; "mesh.ply" by default."""
        return self._connection.send("GET", "/scan/files.zip", params=given(scan=scan_ids, file=file)).content

    def rename(self, scan_id: str, label: str | None) -> Json:
        """Give a scan another name; None takes it away."""
        return self._connection.json("PATCH", path("/scan/{}", scan_id), json={"label": label})

    def get(self, scan_id: str) -> Json:
        """A scan: its state, its progress, and the links of its files."""
        return self._connection.json("GET", path("/scan/{}", scan_id))

    def delete(self, scan_id: str) -> None:
        """Delete a finished scan with all its files."""
        self._connection.send("DELETE", path("/scan/{}", scan_id))

    def cancel(self, scan_id: str) -> Json:
        """Stop a scan between two frames."""
        return self._connection.json("POST", path("/scan/{}/cancel", scan_id))

    def reconstruct(self, scan_id: str, *, uncalibrated: Mapping[str, Any] | None = None) -> Json:
        """Make mesh and files of a finished scan again from its bundle; `Client.job` follows it. uncalibrated : other
        guesses of a rig without a calibration, such as {"baseline_mm": 180}.
        """
        options = given(uncalibrated=uncalibrated)
        return self._connection.json("POST", path("/scan/{}/reconstruct", scan_id), json=options)

    def pin(self, scan_id: str) -> Json:
        """Keep a scan, even where the settings delete old ones."""
        return self._connection.json("PUT", path("/scan/{}/pin", scan_id))

    def unpin(self, scan_id: str) -> Json:
        """Allow the settings to delete a scan once it is old."""
        return self._connection.json("DELETE", path("/scan/{}/pin", scan_id))

    def series(self, series_id: str) -> Json:
        """The scans of a series."""
        return self._connection.json("GET", path("/scan/series/{}", series_id))

    def cancel_series(self, series_id: str) -> Json:
        """Stop all scans of a series."""
        return self._connection.json("POST", path("/scan/series/{}/cancel", series_id))

    def file(self, scan_id: str, name: str) -> bytes:
        """A file of a scan, by its name."""
        return self._connection.send("GET", path("/scan/{}/{}", scan_id, name)).content

    def follow(self, scan_id: str) -> Iterator[Event]:
        """The events of a scan, from the first to the last, as they happen."""
        return self._connection.follow(path("/scan/{}/events", scan_id))


class Models(Resource):
    """Models: several scans of one object, combined into one mesh."""

    def start(
        self,
        scans: Sequence[str],
        *,
        poses: Poses | None = None,
        dictionary: str | None = None,
        angles_deg: Sequence[float] | None = None,
        axis: Mapping[str, Any] | None = None,
        start_error_mm: float | None = None,
        voxel_mm: float | None = None,
        cut: bool | None = None,
        label: str | None = None,
    ) -> Json:
        """Combine scans into one mesh, and return the model's record; `wait` returns it once the model is done."""
        options = given(
            scans=scans,
            poses=poses,
            dictionary=dictionary,
            angles_deg=angles_deg,
            axis=axis,
            start_error_mm=start_error_mm,
            voxel_mm=voxel_mm,
            cut=cut,
            label=label,
        )
        return self._connection.json("POST", "/model", once=True, json=options)

    def shoot(
        self,
        *,
        views: int | None = None,
        scan: Mapping[str, Any] | None = None,
        manual: bool | None = None,
        poses: Poses | None = None,
        dictionary: str | None = None,
        axis: Mapping[str, Any] | None = None,
        start_error_mm: float | None = None,
        voxel_mm: float | None = None,
        cut: bool | None = None,
        label: str | None = None,
        if_busy: IfBusy | None = None,
    ) -> Json:
        """Scan an object from all sides, and combine the views into one mesh. scan : options as of `Scans.start`."""
        options = given(
            views=views,
            scan=scan,
            manual=manual,
            poses=poses,
            dictionary=dictionary,
            axis=axis,
            start_error_mm=start_error_mm,
            voxel_mm=voxel_mm,
            cut=cut,
            label=label,
            if_busy=if_busy,
        )
        return self._connection.json("POST", "/model/shoot", once=True, json=options)

    def view(self, model_id: str, *, again: bool | None = None, if_busy: IfBusy | None = None) -> Json:
        """Scan the next view of a manually turned object; or repeat the last view."""
        options = given(again=again, if_busy=if_busy)
        return self._connection.json("POST", path("/model/{}/view", model_id), once=True, json=options)

    def combine(self, model_id: str) -> Json:
        """Combine the views of a manually turned object."""
        return self._connection.json("POST", path("/model/{}/combine", model_id))

    def list(self, *, cursor: int | None = None, limit: int | None = None) -> Json:
        """A page of models from new to old: `models`, and `next`."""
        return self._connection.json("GET", "/model", params=given(cursor=cursor, limit=limit))

    def get(self, model_id: str) -> Json:
        """A model: its state, its progress, and the links of its files."""
        return self._connection.json("GET", path("/model/{}", model_id))

    def rename(self, model_id: str, label: str | None) -> Json:
        """Give a model another name; None takes it away."""
        return self._connection.json("PATCH", path("/model/{}", model_id), json={"label": label})

    def delete(self, model_id: str) -> None:
        """Delete a finished model with all its files."""
        self._connection.send("DELETE", path("/model/{}", model_id))

    def pin(self, model_id: str) -> Json:
        """Keep a model, even where the settings delete old ones."""
        return self._connection.json("PUT", path("/model/{}/pin", model_id))

    def unpin(self, model_id: str) -> Json:
        """Allow the settings to delete a model once it is old."""
        return self._connection.json("DELETE", path("/model/{}/pin", model_id))

    def cancel(self, model_id: str) -> Json:
        """Stop a model."""
        return self._connection.json("POST", path("/model/{}/cancel", model_id))

    def file(self, model_id: str, name: str) -> bytes:
        """A file of a model, by its name."""
        return self._connection.send("GET", path("/model/{}/{}", model_id, name)).content

    def follow(self, model_id: str) -> Iterator[Event]:
        """The events of a model, from the first to the last, as they happen."""
        return self._connection.follow(path("/model/{}/events", model_id))

    def wait(self, model_id: str) -> Json:
        """The model's record once it is done. `Client.fetch` writes a file of its `links`.

        Raises
        ------
        ModelFailedError
            It failed or was cancelled.
        """
        for _ in self.follow(model_id):
            pass
        model = self.get(model_id)
        if model["state"] != "succeeded":
            raise ModelFailedError(model)
        return model


class PresetResource(Resource):
    """Options of scans by name."""

    def list(self) -> Json:
        """The presets: shipped, of the rig file, and stored by the service."""
        return self._connection.json("GET", "/preset")

    def get(self, name: str) -> Json:
        """A preset as a document, which another service accepts as it is."""
        return self._connection.json("GET", path("/preset/{}", name))

    def put(self, name: str, document: Mapping[str, Any] | str | bytes) -> Json:
        """Store a preset by this name."""
        return self._connection.json("PUT", path("/preset/{}", name), **document_body(document))

    def delete(self, name: str) -> None:
        """Delete a stored preset."""
        self._connection.send("DELETE", path("/preset/{}", name))


class RigState(Resource):
    """The rig, and the devices that are plugged in."""

    def get(self) -> Json:
        """The rig: devices, positions, calibration in use, who holds it, and the number of waiting scans."""
        return self._connection.json("GET", "/rig")

    def devices(self) -> Json:
        """The installed drivers, the devices that are plugged in, and the missing libraries."""
        return self._connection.json("GET", "/device")

    def get_file(self) -> Json:
        """The rig file, its settings, and `proposals` of the last examinations. Needs the scope administer."""
        return self._connection.json("GET", "/rig/file")

    def put_file(self, text: str, *, version: str) -> Json:
        """Open the rig by another text of its file, and keep that. version : of the file that it was made of."""
        return self._connection.json("PUT", "/rig/file", json={"text": text, "version": version})

    def put_settings(
        self,
        cameras: Mapping[str, Mapping[str, float | None]],
        *,
        version: str,
        tolerance_mm: float | None = None,
        refuse_when_stale: bool | None = None,
    ) -> Json:
        """Change exposures, gains and the requirements on scans in the rig file, and open the rig by it.

        cameras : `exposure_s` and `gain` by name. version : of the file that is changed.
        """
        options = given(tolerance_mm=tolerance_mm, refuse_when_stale=refuse_when_stale)
        return self._connection.json("PUT", "/rig/settings", json={"cameras": cameras, "version": version, **options})

    def reopen(self) -> None:
        """Close every device, and open the rig by its file as it is now."""
        self._connection.send("POST", "/rig/reopen")

    def pictures(
        self,
        camera: str,
        *,
        light: Literal["off", "white"] | None = None,
        marks: bool | None = None,
        exposure_s: float | None = None,
    ) -> Iterator[Picture]:
        """The live picture of a camera, (H, W) or (H, W, 3) uint8, until a scan needs the rig or the caller stops.

        light : what the projector shows; "off" by default. marks : draw saturated pixels, and in white light those that
        are too dark. exposure_s : of the pictures; the rig file's by default.
        """
        options = given(light=light, marks=marks, exposure_s=exposure_s)
        return self._connection.pictures(path("/preview/{}", camera), params=options)


class Examinations(Resource):
    """Examinations of the rig: doctor, latency of its light, conformance of its drivers."""

    def last(self) -> Json:
        """Latest result of each examination: `doctor`, `latency`, `conformance`; null where there was none."""
        return self._connection.json("GET", "/rig/examinations")

    def doctor(self, *, search_s: float | None = None, if_busy: IfBusy | None = None) -> Json:
        """Examine light, timing, picture, response and flicker; `wait` returns the record once that is done.

        search_s : longest latency to search for, seconds.
        """
        options = given(search_s=search_s, if_busy=if_busy)
        return self._connection.json("POST", "/rig/doctor", once=True, json=options)

    def latency(
        self,
        *,
        flashes: int | None = None,
        search_s: float | None = None,
        exposure_s: float | None = None,
        trigger: Literal["free", "software"] | None = None,
        if_busy: IfBusy | None = None,
    ) -> Json:
        """Measure how late the light is. flashes : of each camera. trigger : how exposures are started."""
        options = given(flashes=flashes, search_s=search_s, exposure_s=exposure_s, trigger=trigger, if_busy=if_busy)
        return self._connection.json("POST", "/rig/latency", once=True, json=options)

    def conformance(self, *, if_busy: IfBusy | None = None) -> Json:
        """Check that the rig's drivers keep their contract."""
        return self._connection.json("POST", "/rig/conformance", once=True, json=given(if_busy=if_busy))

    def get(self, job_id: str) -> Json:
        """An examination: its state; `summary` is what it found, or `error` why it found nothing."""
        return self._connection.json("GET", path("/rig/job/{}", job_id))

    def cancel(self, job_id: str) -> Json:
        """Stop an examination."""
        return self._connection.json("POST", path("/rig/job/{}/cancel", job_id))

    def follow(self, job_id: str) -> Iterator[Event]:
        """The events of an examination, from the first to the last, as they happen."""
        return self._connection.follow(path("/rig/job/{}/events", job_id))

    def wait(self, job_id: str, progress: ProgressCallback | None = None) -> Json:
        """The record of an examination once it is done. progress : as of a scan.

        Raises
        ------
        ExaminationFailedError
            It failed or was cancelled before it found anything.
        """
        for event in self.follow(job_id):
            if progress and isinstance(event, Progress):
                progress(event.stage, event.fraction, event.detail)
        record = self.get(job_id)
        if record["state"] != "succeeded" and record["summary"] is None:
            raise ExaminationFailedError(record)
        return record


class CalibrationResource(Resource):
    """Calibrations: a session of poses, a solve, and its use."""

    def open(
        self,
        *,
        board: Mapping[str, Any] | None = None,
        label: str | None = None,
        patterns: Mapping[str, Any] | None = None,
        projector: bool | None = None,
    ) -> Json:
        """Open a new session."""
        options = given(board=board, label=label, patterns=patterns, projector=projector)
        return self._connection.json("POST", "/calibration", json=options)

    def list(self, *, limit: int | None = None) -> Json:
        """Calibrations, newest first, and the active one."""
        return self._connection.json("GET", "/calibration", params=given(limit=limit))

    def submit(self, document: Mapping[str, Any] | str | bytes, *, label: str | None = None) -> Json:
        """Import a calibration that was made elsewhere: slrig's as a dict or JSON, OpenCV's YAML or XML as text."""
        body = document_body(document)
        return self._connection.json("POST", "/calibration/import", params=given(label=label), **body)

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
        options = given(
            kind=kind,
            columns=columns,
            rows=rows,
            square_mm=square_mm,
            marker_mm=marker_mm,
            dictionary=dictionary,
            page=page,
        )
        return self._connection.send("GET", "/calibration/board.pdf", params=options).content

    def compare(self, first: str, second: str) -> Json:
        """The differences between two calibrations."""
        return self._connection.json("GET", "/calibration/compare", params={"first": first, "second": second})

    def get(self, calibration_id: str) -> Json:
        """A calibration: its poses, their coverage, the next step, and its solve."""
        return self._connection.json("GET", path("/calibration/{}", calibration_id))

    def delete(self, calibration_id: str) -> None:
        """Delete a calibration."""
        self._connection.send("DELETE", path("/calibration/{}", calibration_id))

    def pin(self, calibration_id: str) -> Json:
        """Keep a calibration, even where the settings delete old ones."""
        return self._connection.json("PUT", path("/calibration/{}/pin", calibration_id))

    def unpin(self, calibration_id: str) -> Json:
        """Allow the settings to delete a calibration once it is old."""
        return self._connection.json("DELETE", path("/calibration/{}/pin", calibration_id))

    def shoot(
        self,
        calibration_id: str,
        *,
        position: Position | None = None,
        exposure_s: float | None = None,
        if_busy: IfBusy | None = None,
    ) -> Json:
        """Capture a pose of the board where it is held, or at a position of the positioner."""
        options = given(position=position, exposure_s=exposure_s, if_busy=if_busy)
        return self._connection.json("POST", path("/calibration/{}/pose", calibration_id), once=True, json=options)

    def script(
        self,
        calibration_id: str,
        *,
        positions: Sequence[Position] | None = None,
        exposure_s: float | None = None,
        if_busy: IfBusy | None = None,
    ) -> Json:
        """Capture poses at these positions of the positioner, one after the other; at all unless some are named."""
        options = given(positions=positions, exposure_s=exposure_s, if_busy=if_busy)
        return self._connection.json("POST", path("/calibration/{}/script", calibration_id), once=True, json=options)

    def pose(self, calibration_id: str, number: int) -> Json:
        """A pose, and the findings in its pictures."""
        return self._connection.json("GET", path("/calibration/{}/pose/{}", calibration_id, number))

    def drop_pose(self, calibration_id: str, number: int) -> None:
        """Remove a pose from the session."""
        self._connection.send("DELETE", path("/calibration/{}/pose/{}", calibration_id, number))

    def cancel_pose(self, calibration_id: str, number: int) -> Json:
        """Stop the capture of a pose."""
        return self._connection.json("POST", path("/calibration/{}/pose/{}/cancel", calibration_id, number))

    def solve(
        self,
        calibration_id: str,
        *,
        board_shape: Literal["auto", "flat", "bowed"] | None = None,
        measured_mm: Sequence[float] | None = None,
    ) -> Json:
        """Solve from all accepted poses. measured_mm: both printed scales of the board, if not known yet."""
        options = given(board_shape=board_shape, measured_mm=measured_mm)
        return self._connection.json("POST", path("/calibration/{}/solve", calibration_id), json=options)

    def activate(self, calibration_id: str) -> Json:
        """Use this calibration for scans from now on."""
        return self._connection.json("POST", path("/calibration/{}/activate", calibration_id))

    def deactivate(self, calibration_id: str) -> Json:
        """Use the rig's own calibration again."""
        return self._connection.json("POST", path("/calibration/{}/deactivate", calibration_id))

    def file(self, calibration_id: str, name: str) -> bytes:
        """calibration.json, calibration.yml or calibration.xml (OpenCV's), or report.html."""
        return self._connection.send("GET", path("/calibration/{}/{}", calibration_id, name)).content

    def pose_picture(self, calibration_id: str, number: int, *, camera: str | None = None) -> Picture:
        """A camera's picture of a pose, with the corners that were found."""
        link = path("/calibration/{}/pose/{}/picture.png", calibration_id, number)
        return self._connection.picture(link, params=given(camera=camera))

    def coverage(self, calibration_id: str, *, device: str | None = None) -> Picture:
        """The area of a device's picture that the poses cover."""
        return self._connection.picture(
            path("/calibration/{}/coverage.png", calibration_id), params=given(device=device)
        )

    def follow(self, calibration_id: str) -> Iterator[Event]:
        """The events of a calibration, from the first, as long as a job of it runs."""
        return self._connection.follow(path("/calibration/{}/events", calibration_id))


class RigHealth(Resource):
    """Does the calibration in use still hold?"""

    def get(self) -> Json:
        """The verdict, its reasons, and what to do."""
        return self._connection.json("GET", "/rig/health")

    def history(self, *, limit: int | None = None, since: str | None = None) -> Json:
        """Verifications, newest first. since : ISO 8601, with its offset from UTC."""
        return self._connection.json("GET", "/rig/health/history", params=given(limit=limit, since=since))

    def plot(self, *, limit: int | None = None) -> str:
        """The newest verifications over time, as SVG."""
        return self._connection.send("GET", "/rig/health.svg", params=given(limit=limit)).text

    def verify(
        self,
        *,
        board: Mapping[str, Any] | None = None,
        position: int | None = None,
        exposure_s: float | None = None,
        if_busy: IfBusy | None = None,
    ) -> Json:
        """Capture the board, and compare it with the calibration in use."""
        options = given(board=board, position=position, exposure_s=exposure_s, if_busy=if_busy)
        return self._connection.json("POST", "/rig/verification", once=True, json=options)

    def verification(self, verification_id: str) -> Json:
        """A verification: its state, and its result or its fault."""
        return self._connection.json("GET", path("/rig/verification/{}", verification_id))

    def cancel(self, verification_id: str) -> Json:
        """Stop a verification."""
        return self._connection.json("POST", path("/rig/verification/{}/cancel", verification_id))

    def follow(self, verification_id: str) -> Iterator[Event]:
        """The events of a verification, from the first to the last, as they happen."""
        return self._connection.follow(path("/rig/verification/{}/events", verification_id))


class HandEyeResource(Resource):
    """Pose of the rig on or before a robot, kept with the calibration in use."""

    def get(self) -> Json:
        """The pose, with covariances and residuals."""
        return self._connection.json("GET", "/hand-eye")

    def put(self, document: Mapping[str, Any] | str | bytes) -> Json:
        """Keep a hand_eye.json."""
        return self._connection.json("PUT", "/hand-eye", **document_body(document))

    def delete(self) -> None:
        """Forget it."""
        self._connection.send("DELETE", "/hand-eye")

    def solve(
        self,
        poses: Sequence[Mapping[str, Any]],
        *,
        kind: str,
        calibration: str | None = None,
        sphere_mm: float | None = None,
        robot_sigma: Sequence[float] | None = None,
        base_frame: str | None = None,
        flange_frame: str | None = None,
    ) -> Json:
        """Find it: {"pose": a pose's number, "robot_pose": the flange in the base, 4 x 4, mm} each of a session, the
        `calibration`; or, with `sphere_mm`, {"scan": a scan's id, "robot_pose": …} each.

        kind : "in-hand" or "fixed".
        """
        options = given(
            calibration=calibration, sphere_mm=sphere_mm, robot_sigma=robot_sigma, base_frame=base_frame,
            flange_frame=flange_frame,
        )  # fmt: skip
        return self._connection.json("POST", "/hand-eye", json={"poses": list(poses), "kind": kind, **options})

    def check(
        self, poses: Sequence[Mapping[str, Any]], *, calibration: str | None = None, sphere_mm: float | None = None
    ) -> Json:
        """Compare new poses, as for `solve`, with the kept result."""
        options = given(calibration=calibration, sphere_mm=sphere_mm)
        return self._connection.json("POST", "/hand-eye/check", json={"poses": list(poses), **options})


class TurntableResource(Resource):
    """The turntable of a rig: its axis, and the planes by which models are cut."""

    def get(self) -> Json:
        """The axis, its accuracy, the planes, and whether both still hold."""
        return self._connection.json("GET", "/rig/turntable")

    def plot(self) -> str:
        """The movement of the axis over time, as SVG."""
        return self._connection.send("GET", "/rig/turntable.svg").text

    def calibrate(
        self, calibration: str, *, poses: Sequence[int] | None = None, angles_deg: Sequence[float] | None = None
    ) -> Json:
        """Find the axis from poses of a board that stood on the turntable.

        angles_deg : of the turntable, pose by pose.
        """
        options = given(calibration=calibration, poses=poses, angles_deg=angles_deg)
        return self._connection.json("POST", "/rig/turntable/axis", json=options)

    def shoot(
        self,
        *,
        board: Mapping[str, Any] | None = None,
        first_deg: float | None = None,
        step_deg: float | None = None,
        count: int | None = None,
        exposure_s: float | None = None,
        if_busy: IfBusy | None = None,
    ) -> Json:
        """Shoot a board on the turntable at several angles, and measure the axis: a job, as those of `examinations`.

        board : that of the calibration in use by default.
        """
        options = given(
            board=board, first_deg=first_deg, step_deg=step_deg, count=count, exposure_s=exposure_s, if_busy=if_busy
        )
        return self._connection.json("POST", "/rig/turntable/shoot", once=True, json=options)

    def find_planes(self, scan: str) -> Json:
        """Find the plate and backdrops in a scan of the empty turntable."""
        return self._connection.json("POST", "/rig/turntable/planes", json={"scan": scan})

    def put(self, document: Mapping[str, Any] | str | bytes) -> Json:
        """Replace axis, planes and history by a stored document."""
        return self._connection.json("PUT", "/rig/turntable", **document_body(document))

    def delete(self) -> None:
        """Delete axis, planes and history."""
        self._connection.send("DELETE", "/rig/turntable")


class Acceptance(Resource):
    """Acceptance tests, position by position."""

    def open(
        self,
        *,
        artefacts: Mapping[str, Any] | None = None,
        volume_mm: Sequence[Sequence[float]] | None = None,
        tolerance_mm: float | None = None,
        limits: Mapping[str, Any] | None = None,
        repeats: int | None = None,
        exposure_s: float | None = None,
        notes: str | None = None,
    ) -> Json:
        """Open a new test of the rig with its present calibration."""
        options = given(
            artefacts=artefacts,
            volume_mm=volume_mm,
            tolerance_mm=tolerance_mm,
            limits=limits,
            repeats=repeats,
            exposure_s=exposure_s,
            notes=notes,
        )
        return self._connection.json("POST", "/acceptance", once=True, json=options)

    def list(self, *, limit: int | None = None) -> Json:
        """Tests, newest first."""
        return self._connection.json("GET", "/acceptance", params=given(limit=limit))

    def get(self, test_id: str) -> Json:
        """A test: the next step, the measurements, and the decisions."""
        return self._connection.json("GET", path("/acceptance/{}", test_id))

    def delete(self, test_id: str) -> None:
        """Delete a test with all its files."""
        self._connection.send("DELETE", path("/acceptance/{}", test_id))

    def measure(self, test_id: str, *, scripted: bool | None = None, if_busy: IfBusy | None = None) -> Json:
        """Measure the next position; with a script, all that are left."""
        options = given(scripted=scripted, if_busy=if_busy)
        return self._connection.json("POST", path("/acceptance/{}/position", test_id), once=True, json=options)

    def cancel(self, test_id: str) -> Json:
        """End a test early."""
        return self._connection.json("POST", path("/acceptance/{}/cancel", test_id))

    def file(self, test_id: str, name: str) -> bytes:
        """report.html or report.json."""
        return self._connection.send("GET", path("/acceptance/{}/{}", test_id, name)).content


class Schedules(Resource):
    """Work for the rig at set times."""

    def list(self) -> Json:
        """Every schedule, oldest first."""
        return self._connection.json("GET", "/schedule")

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
        """Run a task by the clock: "30 6 * * mon-fri" is 06:30 on working days."""
        request = given(
            cron=cron,
            task=task,
            time_zone=time_zone,
            options=options,
            label=label,
            grace_s=grace_s,
            retry_s=retry_s,
            catch_up=catch_up,
            enabled=enabled,
        )
        return self._connection.json("POST", "/schedule", json=request)

    def get(self, schedule_id: str) -> Json:
        """A schedule, with its next due times."""
        return self._connection.json("GET", path("/schedule/{}", schedule_id))

    def remove(self, schedule_id: str) -> None:
        """Delete a schedule and its runs."""
        self._connection.send("DELETE", path("/schedule/{}", schedule_id))

    def runs(self, schedule_id: str, *, cursor: int | None = None, limit: int | None = None) -> Json:
        """A page of the results of its due times, from new to old."""
        params = given(cursor=cursor, limit=limit)
        return self._connection.json("GET", path("/schedule/{}/runs", schedule_id), params=params)

    def run(self, schedule_id: str) -> Json:
        """Run the task now."""
        return self._connection.json("POST", path("/schedule/{}/run", schedule_id))

    def pause(self, schedule_id: str) -> Json:
        """Stop due times until the schedule is resumed."""
        return self._connection.json("POST", path("/schedule/{}/pause", schedule_id))

    def resume(self, schedule_id: str) -> Json:
        """Continue after a pause."""
        return self._connection.json("POST", path("/schedule/{}/resume", schedule_id))

    def cancel(self, schedule_id: str) -> Json:
        """Stop the present run."""
        return self._connection.json("POST", path("/schedule/{}/cancel", schedule_id))


class Notices(Resource):
    """Receivers of notices: of failed and missed runs, changes of the rig's health, and finished jobs."""

    def list(self) -> Json:
        """The receivers: host, kinds of notices, and how many wait."""
        return self._connection.json("GET", "/notices")

    def set_webhook(self, url: str, kinds: Sequence[str] | None = None) -> Json:
        """Send notices to an address by POST; all kinds unless some are named."""
        return self._connection.json("PUT", "/notices/webhook", json=given(url=url, kinds=kinds))

    def remove_webhook(self) -> None:
        """Send nothing more to the webhook that was set."""
        self._connection.send("DELETE", "/notices/webhook")

    def test(self, receiver: str) -> Json:
        """Send one test notice, and return the result."""
        return self._connection.json("POST", path("/notices/{}/test", receiver))


class System(Resource):
    """The service itself."""

    def alive(self) -> Json:
        """An answer shows that the service runs."""
        return self._connection.json("GET", "/livez")

    def ready(self) -> Json:
        """An answer shows that the service can scan; a RefusedError lists what is missing. See `readiness`."""
        return self._connection.json("GET", "/readyz")

    def readiness(self) -> Json:
        """The `checks` of `ready`, each "ok" or its fault, and those `pending`, which need only time."""
        try:
            found = self.ready()
        except RefusedError as error:
            if "checks" not in error.problem:
                raise
            found = error.problem
        return {"checks": dict(found["checks"]), "pending": [*found.get("pending", ())]}

    def about(self) -> Json:
        """The version of the service, the space on its disk, and how many jobs are damaged."""
        return self._connection.json("GET", "/service")

    def metrics(self) -> str:
        """Figures for Prometheus."""
        return self._connection.send("GET", "/metrics").text

    def fleet(self) -> Json:
        """The rigs that share a catalogue: the state, the last scan and the backlog of each."""
        return self._connection.json("GET", "/fleet")

    def audit(self, *, cursor: int | None = None, limit: int | None = None) -> Json:
        """A page of the record of who did what, from new to old."""
        return self._connection.json("GET", "/audit", params=given(cursor=cursor, limit=limit))

    def explain(self, name: str) -> Json:
        """The meaning of a kind of problem."""
        return self._connection.json("GET", path("/problems/{}", name))

    def session(self) -> Json:
        """The name and the rights of this client."""
        return self._connection.json("GET", "/session")

    def open_session(self) -> Json:
        """Log in with a cookie, as a browser does."""
        return self._connection.json("POST", "/session")

    def close_session(self) -> None:
        """Log out."""
        self._connection.send("DELETE", "/session")

    def make_link(self) -> Json:
        """Make a link, `path`, by which a browser logs in as this client, once, within a quarter of an hour."""
        return self._connection.json("POST", "/session/links")

    def follow_link(self, token: str) -> None:
        """Log in with the token of the link that `slrig serve` printed."""
        self._connection.send("GET", "/session/link", params={"token": token})

    def follow(self, *, after: int | None = None) -> Iterator[Event]:
        """The events of all jobs from now on; after=0 begins with the oldest event on record."""
        return self._connection.follow("/events", after=None, params=given(after=after))
