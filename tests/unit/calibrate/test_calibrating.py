"""A session from its first pose to the calibration in use, restarts, imports, and which calibrations are kept."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from uuid import UUID, uuid4

import numpy as np
import pytest

from slrig.bundle.calibration import read_calibration, write_calibration
from slrig.calibrate.job import CalibrationArchive, PoseJob, PoseRequest, named_by_scans
from slrig.calibrate.store import CalibrationStore, SessionRecord, SessionState, session_readings, with_jobs
from slrig.errors import (
    ArtefactNotReadyError,
    CalibrationError,
    CalibrationNotFoundError,
    CalibrationStateError,
    DeviceGoneError,
    SolveRefusedError,
    StorageError,
    UnsupportedByDeviceError,
)
from slrig.jobs.records import JobKind, JobProgress, JobRecord, JobState, read_record, write_record
from slrig.jobs.retention import CLOCK, TRASH, Limits, Retention, SteadyClock
from slrig.jobs.store import Audit
from slrig.model import Size
from tests.unit.calibrate.calibration_bench import BOARD, PNG, CalibrationBench
from tests.unit.scan.fakes import WAIT_S, tame_calibration


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[CalibrationBench]:
    bench = CalibrationBench(tmp_path)
    bench.manager.start()
    yield bench
    bench.close()


@pytest.fixture
def moved(tmp_path: Path) -> Iterator[CalibrationBench]:
    """A bench with a positioner, open."""
    bench = CalibrationBench(tmp_path, positioner=True)
    bench.manager.start()
    bench.until(bench.scan().id)
    yield bench
    bench.close()


def test_session_walks_from_poses_to_the_calibration_in_use(bench: CalibrationBench) -> None:
    session_id = bench.session()
    first, second = bench.shot(session_id), bench.shot(session_id)
    assert [first.state, second.state] == [JobState.SUCCEEDED] * 2
    assert first.answer == {"corners_found": {"cam0": 12}}
    assert bench.tame.judged == [[], ["pose 1"]]
    record = bench.record(session_id)
    assert record.coverage == {"poses": ["pose 1", "pose 2"]}
    assert record.next_move == {"words": "tilt it", "enough": False}
    assert (dict(record.cameras), record.projector) == ({"cam0": Size(64, 48)}, Size(64, 40))
    place = bench.calibrations.store.pose(session_id, 1)
    assert {path.name for path in place.iterdir()} == {
        "bundle", "answer.json", "files.json", "picture-cam0.png", "reading.npz", "record.json",
    }  # fmt: skip
    assert (place / "picture-cam0.png").read_bytes() == PNG

    assert bench.solve(session_id).solve == 1
    assert bench.tame.solved == [["pose 1", "pose 2"]]
    path = bench.calibrations.file(session_id, "calibration.json")
    solved = read_calibration(path).solved
    assert solved is not None
    assert solved.id == str(session_id)
    assert bench.calibrations.file(session_id, "report.html").read_text() == "<html>report</html>"

    assert bench.manager.status().active is None
    bench.calibrations.activate(session_id)
    assert bench.in_use.name == str(session_id)
    assert bench.calibrations.active == session_id
    assert list(bench.folder.incoming.iterdir()) == []
    assert bench.opened[0][1].dark

    events = bench.store.events_of(session_id, after=0)
    numbers = [event.number for event in events]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == bench.store.last_event_of(session_id)
    of_each = ["queued", "capturing", "computing", "succeeded"]
    of_all = [*of_each, *of_each, "queued", "computing", "succeeded"]
    assert [event.data["state"] for event in events if event.kind == "state"] == of_all
    assert {"capture", "adjust"} <= {event.data["stage"] for event in events if event.kind == "progress"}


def test_the_progress_of_a_session_is_that_of_its_job_under_way() -> None:
    now = datetime(2026, 11, 28, tzinfo=UTC)

    def solve(state: JobState, stage: str) -> JobRecord:
        progress = JobProgress(stage, 0.5, "")
        return JobRecord(1, uuid4(), JobKind.SOLVE, state, None, "rig", {}, now, None, None, progress, None, None)

    waits, runs, done = (
        solve(JobState.QUEUED, "waits"), solve(JobState.COMPUTING, "runs"), solve(JobState.SUCCEEDED, "done"),
    )  # fmt: skip
    session = SessionRecord(1, uuid4(), now, "rig")
    found = with_jobs(session, [done, waits, runs])
    assert (found.state, found.under_way, found.progress) == (SessionState.SOLVING, True, runs.progress)
    assert with_jobs(session, [done, waits]).progress is None
    assert not with_jobs(session, [done]).under_way


def test_pose_is_shot_along_both_axes_and_knows_no_earlier_calibration(bench: CalibrationBench) -> None:
    bench.calibrations.activate(bench.solved())
    bench.shot(bench.session(), PoseRequest(exposure_s=0.02))
    rig, plan, _ = bench.captured[-1]
    assert plan.patterns.rows
    assert plan.patterns.line_shift
    assert plan.exposure_s == 0.02
    assert (rig.calibration, rig.head) == (None, None)


def test_bad_pose_is_refused_with_its_cause_and_its_picture(bench: CalibrationBench) -> None:
    session_id = bench.session()
    bench.tame.refusals = ("camera 'cam0' saw the board move: hold it still.",)
    judged = bench.shot(session_id)
    bench.tame.refusals = ()
    bench.tame.unseen = True
    unseen = bench.shot(session_id)
    bench.tame.unseen = False
    for pose, words in ((judged, "hold it still."), (unseen, "no camera sees the board. Move it into view.")):
        assert (pose.state, pose.refused) == (JobState.FAILED, True)
        assert pose.fault is not None
        assert pose.fault.code == "pose-refused"
        assert pose.fault.message.endswith(words)
        assert "pose '" not in pose.fault.message
        place = bench.calibrations.store.pose(session_id, pose.number)
        assert (place / "picture-cam0.png").read_bytes() == PNG
        assert words in json.loads((place / "answer.json").read_text())["refused"][0]
        assert not (place / "reading.npz").exists()
    good = bench.shot(session_id)
    assert good.number == 3
    assert bench.tame.judged[-1] == []
    bench.solve(session_id)
    assert bench.tame.solved == [["pose 3"]]


def test_end_that_the_disk_refuses_is_not_lost(bench: CalibrationBench, monkeypatch: pytest.MonkeyPatch) -> None:
    session_id = bench.session()
    pose = bench.held_pose(session_id)

    def save(*_: object) -> None:
        message = "session.json: the disk refused."
        raise StorageError(message)

    monkeypatch.setattr(CalibrationStore, "save", save)
    bench.gate.set()
    assert bench.until_pose(session_id, pose.number).state is JobState.SUCCEEDED
    monkeypatch.undo()
    assert bench.shot(session_id).state is JobState.SUCCEEDED
    (record,) = CalibrationStore(bench.folder).load()
    assert record.coverage == {"poses": ["pose 1", "pose 2"]}


@pytest.mark.slow
def test_dropped_pose_is_in_no_solve_and_its_number_is_not_given_again(bench: CalibrationBench) -> None:
    session_id = bench.session()
    bench.shot(session_id)
    bench.shot(session_id)
    bench.calibrations.drop(session_id, 1)
    record = bench.record(session_id)
    assert [pose.number for pose in record.poses] == [2]
    assert record.coverage == {"poses": ["pose 2"]}
    assert not bench.calibrations.store.pose(session_id, 1).exists()
    with pytest.raises(CalibrationNotFoundError, match="its poses: 2"):
        bench.calibrations.drop(session_id, 1)
    assert bench.shot(session_id).number == 3
    held = bench.held_pose(session_id)
    with pytest.raises(CalibrationStateError, match="Pose 4 is capturing"):
        bench.calibrations.drop(session_id, held.number)


def test_positioner_takes_a_pose_or_all_in_turn(moved: CalibrationBench) -> None:
    session_id = moved.session()
    pose = moved.shot(session_id, PoseRequest(position="far"))
    assert (pose.position, pose.position_name) == (1, "far")
    assert moved.tame.visited == [1]
    moved.calibrations.script(session_id, (), PoseRequest(), wait=False)
    record = moved.until_session(session_id, lambda found: len(found.accepted) == 4)
    assert moved.tame.visited == [1, 0, 1, 2]
    assert record.script == ()
    moved.calibrations.script(session_id, ("tilted", 0), PoseRequest(exposure_s=0.02), wait=False)
    moved.until_session(session_id, lambda found: len(found.accepted) == 6)
    assert moved.tame.visited[4:] == [2, 0]
    assert [plan.exposure_s for _, plan, _ in moved.captured[1:]] == [None] * 4 + [0.02] * 2
    with pytest.raises(UnsupportedByDeviceError, match="found 7, this rig has 0 to 2: near, far, tilted"):
        moved.calibrations.shoot(session_id, PoseRequest(position=7), wait=False)


@pytest.mark.slow
def test_failed_or_cancelled_pose_ends_its_script(moved: CalibrationBench) -> None:
    session_id = moved.session()
    moved.began.clear()
    moved.gate.clear()
    first = moved.calibrations.script(session_id, (), PoseRequest(), wait=False)
    assert moved.began.wait(WAIT_S)
    assert moved.record(session_id).script == (1, 2)
    moved.calibrations.cancel(session_id, first.number)
    assert moved.until_pose(session_id, first.number).state is JobState.CANCELLED
    moved.gate.set()
    moved.error = DeviceGoneError("Camera 'cam0' was unplugged.")
    second = moved.calibrations.script(session_id, (), PoseRequest(), wait=True)
    assert moved.until_pose(session_id, second.number).state is JobState.FAILED
    record = moved.record(session_id)
    assert (record.script, record.latest_pose, moved.tame.visited) == ((), 2, [0, 0])


@pytest.mark.slow
def test_rig_without_a_positioner_says_so(bench: CalibrationBench) -> None:
    bench.until(bench.scan().id)
    poses = bench.calibrations
    with pytest.raises(UnsupportedByDeviceError, match="no positioner"):
        poses.shoot(bench.session(), PoseRequest(position=0), wait=False)
    with pytest.raises(UnsupportedByDeviceError, match="no positioner"):
        poses.script(bench.session(), (), PoseRequest(), wait=False)


@pytest.mark.slow
def test_a_board_can_be_measured_when_its_poses_are_shot_and_once(bench: CalibrationBench) -> None:
    session_id = bench.session()
    bench.shot(session_id)
    across_mm, down_mm = BOARD.rulers_mm
    bench.calibrations.solve(session_id, measured_mm=(1.002 * across_mm, down_mm))
    bench.until_session(session_id, lambda record: record.state is SessionState.SOLVED)
    used = bench.tame.boards[-1]
    assert used == bench.record(session_id).board
    assert used.square_mm == pytest.approx(1.002 * BOARD.square_mm)
    with pytest.raises(CalibrationStateError, match="was measured already"):
        bench.calibrations.solve(session_id, measured_mm=(across_mm, down_mm))


def test_solve_is_refused_until_it_makes_sense(bench: CalibrationBench) -> None:
    session_id = bench.session()
    with pytest.raises(SolveRefusedError, match="no accepted pose"):
        bench.calibrations.solve(session_id)
    bench.held_pose(session_id)
    with pytest.raises(CalibrationStateError, match="pose 1 is still under way"):
        bench.calibrations.solve(session_id)
    bench.gate.set()
    bench.until_pose(session_id, 1)
    bench.tame.solving.clear()
    bench.calibrations.solve(session_id)
    with pytest.raises(CalibrationStateError, match="is being solved already"):
        bench.calibrations.solve(session_id)
    with pytest.raises(CalibrationStateError, match="is being solved"):
        bench.calibrations.shoot(session_id, PoseRequest(), wait=False)
    with pytest.raises(CalibrationStateError, match="under way"):
        bench.calibrations.delete(session_id)
    bench.tame.solving.set()
    bench.until_session(session_id, lambda found: found.state is SessionState.SOLVED)


def test_failed_solve_states_why_and_another_pose_opens_the_session_again(bench: CalibrationBench) -> None:
    session_id = bench.session()
    bench.shot(session_id)
    bench.tame.solve_error = SolveRefusedError("All poses are parallel: tilt the board.")
    failed = bench.solve(session_id, SessionState.FAILED)
    assert failed.fault is not None
    assert (failed.fault.code, failed.solve) == ("solve-refused", 0)
    with pytest.raises(CalibrationStateError, match="was not solved yet"):
        bench.calibrations.activate(session_id)
    bench.tame.solve_error = None
    bench.shot(session_id)
    assert bench.record(session_id).state is SessionState.OPEN
    bench.solve(session_id)


def used_focal_length(bench: CalibrationBench) -> tuple[str, float]:
    """Of the camera in the calibration in use, beside the name of its solve."""
    used = bench.in_use.calibration
    assert used is not None
    assert used.solved is not None
    return used.solved.id, float(used.cameras["cam0"].matrix[0, 0])


@pytest.mark.slow
def test_second_solve_changes_no_calibration_in_use(bench: CalibrationBench) -> None:
    bench.tame.calibration = tame_calibration(focal_px=82.0)
    session_id = bench.solved()
    bench.calibrations.activate(session_id)
    bench.shot(session_id)
    bench.tame.calibration = tame_calibration(focal_px=81.0)
    assert bench.solve(session_id).solve == 2
    # The solve was held against the one in use, the rig's own at first.
    assert [each and each.cameras["cam0"].matrix[0, 0] for each in bench.tame.earlier] == [80.0, 82.0]
    assert used_focal_length(bench) == (str(session_id), 82.0)
    bench.calibrations.activate(session_id)
    assert used_focal_length(bench) == (f"{session_id}.2", 81.0)


def test_calibration_in_use_is_not_deleted_and_can_be_let_go(bench: CalibrationBench) -> None:
    session_id = bench.solved()
    bench.calibrations.activate(session_id)
    with pytest.raises(CalibrationStateError, match=r"is in use.*deactivate"):
        bench.calibrations.delete(session_id)
    bench.calibrations.deactivate(session_id)
    assert bench.manager.status().active is None
    with pytest.raises(CalibrationStateError, match="not in use"):
        bench.calibrations.deactivate(session_id)
    bench.calibrations.delete(session_id)
    assert not bench.calibrations.store.folder(session_id).exists()
    with pytest.raises(CalibrationNotFoundError):
        bench.record(session_id)


def test_import_of_other_devices_is_not_activated_and_of_no_calibration_leaves_no_trace(
    bench: CalibrationBench,
) -> None:
    bench.until(bench.scan().id)
    with pytest.raises(CalibrationError, match="the calibration sent") as refused:
        bench.calibrations.submit(b"{}", ".json")
    assert str(bench.folder.root) not in str(refused.value)
    assert bench.calibrations.latest() == []
    assert list(bench.folder.incoming.iterdir()) == []
    path = bench.folder.root / "other.json"
    write_calibration(path, tame_calibration(camera=Size(640, 480)))
    record = bench.calibrations.submit(path.read_bytes(), ".json")
    with pytest.raises(CalibrationError, match="expected 64 x 48 as the camera's frames are, found 640 x 480"):
        bench.calibrations.activate(record.id)
    assert bench.calibrations.active is None


@pytest.mark.parametrize("name", ["calibration.json", pytest.param("calibration.yml", marks=pytest.mark.slow)])
def test_exported_calibration_comes_in_again(bench: CalibrationBench, name: str) -> None:
    session_id = bench.solved()
    text = bench.calibrations.exported(session_id, name)
    record = bench.calibrations.submit(text, Path(name).suffix, label="from elsewhere")
    assert (record.state, record.label, record.board) == (SessionState.SOLVED, "from elsewhere", None)
    again = bench.calibrations.calibration(record.id)
    np.testing.assert_allclose(again.cameras["cam0"].matrix, tame_calibration().cameras["cam0"].matrix)
    assert again.solved is not None
    assert again.solved.expected_error_mm == 0.02
    with pytest.raises(CalibrationStateError, match="was imported and has no board"):
        bench.calibrations.shoot(record.id, PoseRequest(), wait=False)
    with pytest.raises(ArtefactNotReadyError, match="was imported"):
        bench.calibrations.file(record.id, "report.html")
    bench.calibrations.activate(record.id)


@pytest.mark.slow
def test_restart_keeps_the_active_one_and_marks_what_was_cut_off(bench: CalibrationBench) -> None:
    active = bench.solved()
    bench.calibrations.activate(active)
    session_id = bench.session()
    bench.shot(session_id)
    solving = bench.session()
    bench.shot(solving)
    bench.tame.solving.clear()
    bench.calibrations.solve(solving)
    staged = bench.folder.staging(bench.held_pose(session_id).id)
    assert staged.is_dir()
    # What a power cut leaves, seen by the next start.
    again = bench.restarted()
    assert not staged.exists()
    assert again.active == active
    record = again.register.get(session_id)
    assert [pose.state for pose in record.poses] == [JobState.SUCCEEDED, JobState.INTERRUPTED]
    fault = record.poses[1].fault
    assert fault is not None
    assert (fault.code, "Start it again" in fault.message) == ("scan-interrupted", True)
    # What is read lies on the disk: the solve is done once more.
    assert again.register.get(solving).state is SessionState.SOLVING
    assert [each.id for each in again.latest()] == [solving, session_id, active]
    assert [each.observation.name for each in session_readings(again.store.folder(record.id))] == ["pose 1"]


@pytest.mark.slow
def test_pose_that_waited_is_shot_after_a_restart_and_one_with_its_frames_is_read(bench: CalibrationBench) -> None:
    session_id = bench.session()
    bench.shot(session_id)
    waiting, whole, answered = (bench.manager.record(PoseJob(session_id, number))[0] for number in (2, 3, 4))
    bench.store.advance(whole.id, JobState.COMPUTING)
    bundle = bench.folder.stage(whole.id) / "bundle"
    shutil.copytree(bench.calibrations.store.pose(session_id, 1) / "bundle", bundle)
    # It was ended between its answer and its place.
    (bench.folder.staging(whole.id) / "answer.json").write_text("{}")
    bench.store.advance(answered.id, JobState.COMPUTING)
    place = bench.calibrations.store.pose(session_id, 4)
    shutil.copytree(bench.calibrations.store.pose(session_id, 1), place)
    first = read_record(place)
    assert first is not None
    write_record(place, replace(first, id=answered.id, plan=answered.plan))
    bench.calibrations = bench.restarted(start=True)
    record = bench.until_session(session_id, lambda found: not found.under_way)
    assert [pose.state for pose in record.poses] == [JobState.SUCCEEDED] * 4
    assert len(bench.captured) == 2
    assert bench.store.takes(waiting.id) == 1


@pytest.mark.slow
def test_poses_outlive_their_records_and_records_do_not_outlive_their_files(bench: CalibrationBench) -> None:
    session_id = bench.session()
    poses = [bench.shot(session_id) for _ in range(2)]
    bench.tame.refusals = ("hold it still.",)
    bench.shot(session_id)
    before = bench.record(session_id)
    bench.store.delete_of(session_id)
    again = bench.restarted().register.get(session_id)
    told = [(pose.number, pose.state, pose.answer, pose.fault) for pose in again.poses]
    assert told == [(pose.number, pose.state, pose.answer, pose.fault) for pose in before.poses]
    assert len(again.accepted) == len(poses)
    shutil.rmtree(bench.calibrations.store.pose(session_id, 1))
    lost = bench.restarted().register.pose(session_id, 1)
    assert (lost.state, None if lost.fault is None else lost.fault.code) == (JobState.FAILED, "damaged")


@pytest.mark.slow
def test_links_are_not_followed_and_folders_of_no_session_put_aside(bench: CalibrationBench, tmp_path: Path) -> None:
    stray = bench.folder.calibrations / str(uuid4())
    stray.mkdir()
    (stray / "session.json").write_text('{"number": 1}')
    session_id, store = bench.solved(), bench.calibrations.store
    place, elsewhere = store.folder(session_id), tmp_path / "elsewhere"
    solved = store.solve(session_id, 1) / "calibration.json"
    solved.rename(tmp_path / "calibration.json")
    solved.symlink_to(tmp_path / "calibration.json")
    with pytest.raises(CalibrationError, match="is a link"):
        store.calibration(session_id, 1)
    place.rename(elsewhere)
    place.symlink_to(elsewhere)
    (bench.folder.calibrations / "nowhere").symlink_to(tmp_path / "absent")
    assert CalibrationStore(bench.folder).load() == []
    assert (bench.folder.orphans / f"calibrations-{stray.name}" / "session.json").is_file()
    store.delete(session_id)
    assert not place.is_symlink()
    assert (elsewhere / "session.json").is_file()


@pytest.mark.parametrize(
    "damage", ["one digit", *(pytest.param(each, marks=pytest.mark.slow) for each in ("gone", "pointer"))]
)
def test_active_calibration_that_is_damaged_refuses_scans_until_another_is_chosen(
    bench: CalibrationBench, damage: str
) -> None:
    session_id = bench.solved()
    bench.calibrations.activate(session_id)
    path = bench.calibrations.store.solve(session_id, 1) / "calibration.json"
    text = path.read_text()
    if damage == "gone":
        path.unlink()
    elif damage == "one digit":
        # Still a calibration, and a wrong one.
        path.write_text(text.replace("1", "2", 1))
    else:
        (bench.folder.calibrations / "active.json").write_text("{}")
    again = bench.restarted()
    rig = bench.next_rig
    with pytest.raises(CalibrationError, match=r"(?s)active calibration cannot be read.*Activate another one"):
        rig.refuse_misfit()
    path.write_text(text)
    again.activate(session_id)
    rig.refuse_misfit()


def a_scan(bench: CalibrationBench, *, report: object = None, bundle: UUID | None = None) -> None:
    """The folder of a scan that names a calibration in its report, or has its file in its bundle."""
    folder = bench.folder.scan(uuid4())
    (folder / "bundle").mkdir(parents=True)
    if report is not None:
        (folder / "report.json").write_text(json.dumps(report))
    if bundle is not None:
        store = bench.calibrations.store
        shutil.copy(store.solve(bundle, 1) / "calibration.json", folder / "bundle" / "calibration.json")


def kept(bench: CalibrationBench, count: int | None, named: Callable[[], set[str]] = set) -> Retention:
    """A retention that keeps so many calibrations."""
    archive = CalibrationArchive(bench.calibrations, bench.folder.scans, named)
    clock = SteadyClock(bench.folder.root / CLOCK)
    return Retention(bench.folder.root, [(archive, Limits(count))], Audit(bench.store.database), clock)


@pytest.mark.slow
def test_only_what_is_neither_new_nor_needed_is_removed(bench: CalibrationBench) -> None:
    in_report, twice, in_bundle, active, empty, unused, begun, newest = (
        *(bench.solved() for _ in range(4)), bench.session(), bench.solved(), bench.session(), bench.solved(),
    )  # fmt: skip
    bench.solve(twice)
    bench.calibrations.activate(active)
    a_scan(bench, report={"calibration": {"id": str(in_report)}})
    a_scan(bench, report={"calibration": {"id": f"{twice}.2"}})
    a_scan(bench, bundle=in_bundle)
    nothings: list[object] = [{}, [], "not a report"]
    for nothing in nothings:
        a_scan(bench, report=nothing)
    places = [bench.calibrations.store.folder(each) for each in (empty, unused)]
    assert all(place.is_dir() for place in places)
    assert kept(bench, 7).apply() == []
    assert kept(bench, None).apply() == []
    bench.calibrations.pin(unused, pinned=True)
    assert kept(bench, 1).apply() == [empty]
    bench.calibrations.pin(unused, pinned=False)
    assert kept(bench, 1).apply() == [unused]
    assert not any(place.exists() for place in places)
    # They lie in the trash, and come back by hand.
    (trashed,) = (bench.folder.root / TRASH).glob(f"*-calibration-{unused}")
    assert (trashed / "session.json").is_file()
    assert [record.id for record in bench.calibrations.latest()] == [newest, begun, active, in_bundle, twice, in_report]
    assert kept(bench, 1).apply() == []


def test_a_pose_under_way_keeps_its_session(bench: CalibrationBench) -> None:
    old = bench.session()
    bench.held_pose(old)
    bench.session()
    assert kept(bench, 1).apply() == []
    bench.gate.set()
    bench.until_pose(old, 1)
    assert kept(bench, 1).apply() == [old]


@pytest.mark.slow
def test_one_that_states_no_error_is_known_by_its_numbers(bench: CalibrationBench, tmp_path: Path) -> None:
    given = tmp_path / "given.json"
    needed, gone = (tame_calibration(focal_px=focal) for focal in (80.0, 90.0))
    imported = []
    for each in (needed, gone):
        write_calibration(given, each)
        document = json.loads(given.read_text())
        document.pop("solved")
        imported.append(bench.calibrations.submit(json.dumps(document).encode(), ".json").id)
    bench.solved()
    a_scan(bench, report={"calibration": {"id": needed.digest}})
    assert named_by_scans(bench.folder.scans) == {needed.digest}
    # Others than scans name them too.
    assert kept(bench, 1, lambda: {gone.digest}).apply() == []
    assert kept(bench, 1).apply() == [imported[1]]
