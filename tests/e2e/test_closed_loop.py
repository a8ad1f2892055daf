"""Real drivers around a rendered world: only the photons are simulated.

The screen driver shows on an Xorg output with pixels that light the world; the trigger box does so at the end of a
serial line. What the world's camera sees of it comes through a V4L2 node and its driver, or by wire triggers. Such
scans give the mesh that the simulator alone gives. A rig of a V4L2 camera and a trigger box goes through its first
day: from an empty box to a verified calibration, with the commands and requests that a person gives.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from simulated_rig.device import open_simulated_head
from simulated_rig.light import light_table
from simulated_rig.options import HeadOptions
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import SceneSurface, read_scene
from simulated_rig.staging import PoseScript
from slrig.bundle.calibration import write_calibration
from slrig.bundle.validation import validate
from slrig.config import read_rig
from slrig.devices import CameraSettings, Rig
from slrig.discovery import open_rig
from slrig.meshing.quality import SearchTree, TruthScore, score
from slrig.model import Calibration, CameraFormat, Mesh, Pixels, Size, Truth
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ReconstructionPlan, ScanPlan, pattern_sequence
from slrig.scan.reconstruct import reconstruct_bundle
from tests.contract.screen_bench import let_go
from tests.contract.screen_server import DummyServer, OutputPixels, require_xorg
from tests.contract.serial_bench import TriggerBox
from tests.contract.stage import exposed_shares
from tests.contract.v4l2_bench import DEBIAN_PYTHON, ROOT, Faked, why_not
from tests.contract.v4l2_sensor import SensorService
from tests.contract.wired_camera import WiredCamera
from tests.e2e.conftest import scanned, serving, slrig, write_rig
from tests.e2e.test_calibration_walk import BOARD, Caller
from tests.e2e.test_calibration_walk import write_rig as write_board_rig
from tests.npm import lacking
from tests.unit.drivers.serial_projector.engines import CoreEngine, Scene, description
from tests.unit.drivers.serial_projector.line import SerialLine

if TYPE_CHECKING:
    from tests.contract.stage import Stage as Below

pytestmark = pytest.mark.slow

DARK: Pixels = np.zeros((1, 1), np.uint8)


def profile_of(colours: NDArray[np.uint8]) -> Pixels:
    """The one line that a picture, (H, W, 3), repeats: (1, W), (H, 1), or (1, 1) where all its pixels are alike.

    Raises
    ------
    ValueError
        The picture has a colour, or varies along both axes: no pattern, and nothing that the world can render.
    """
    grey = colours[..., 0]
    if (colours != grey[..., None]).any():
        raise ValueError("expected a grey picture on the output, found colours")
    along, down = bool((grey != grey[:, :1]).any()), bool((grey != grey[:1]).any())
    if along and down:
        message = "expected a picture that varies along one axis on the output, found one that varies along both"
        raise ValueError(message)
    return grey[: None if down else 1, : None if along else 1].copy()


class World:
    """The scene of a rendered rig's file, its projector's lens and lamp, and what its camera's sensor reads.

    Stands where `tests.contract.stage.Stage` does: below drivers. Light comes by `show` and `changed`, in
    CLOCK_MONOTONIC; `exposed` answers for any interval of the past, by a mixture where the light changed in it. Safe
    between threads. seed : of the sensor's noise. saturation_s : of the sensor, in place of the rig file's.
    """

    def __init__(self, rig: Path, *, seed: int, saturation_s: float | None = None) -> None:
        head = read_rig(rig).head
        assert head is not None
        options = validate(HeadOptions, head.options, str(rig))
        (camera,) = options.camera
        scene = rig.parent / options.scene
        lens = options.projector.pinhole()
        self._script = PoseScript(options, read_scene(scene), scene.parent)
        self._stage = SceneState(
            self._script.surface(0),
            lens,
            working_distance_mm=options.projector.working_distance_mm or float(np.linalg.norm(lens.centre_mm)),
        )
        self._view = CameraView(
            camera.pinhole(),
            self._stage,
            blur_px=camera.blur_px,
            ambient=options.ambient,
            samples_per_axis=options.samples_per_axis,
            jitter=options.jitter,
            seed=options.seed,
            workers=options.workers,
        )
        self._format = CameraFormat(camera.size, camera.bit_depth)
        self.projector: Size = options.projector.size
        self.calibration = Calibration({camera.name: camera.pinhole()}, lens)
        self._response = options.projector.response()
        self._sensor = replace(camera.sensor(), saturation_s=saturation_s or camera.saturation_s)
        self._rng = np.random.default_rng((seed, 0x6C6F6F70))
        self._lock = threading.Lock()
        self._changes: list[tuple[int, Pixels]] = [(0, DARK)]
        self._images: dict[tuple[tuple[int, ...], bytes], NDArray[np.float32]] = {}
        # Tracing takes seconds: now, and not while a sensor waits.
        self._seen(DARK)

    @property
    def format(self) -> CameraFormat:
        return self._format

    def move(self, index: int) -> None:
        """Put what the script moves into a pose, as a person does: between photographs."""
        with self._lock:
            self._stage.change(surface=self._script.surface(index))
            self._images.clear()
        self._seen(DARK)

    @property
    def profiles(self) -> list[Pixels]:
        with self._lock:
            return [profile for _, profile in self._changes]

    def show(self, profile: Pixels | None) -> int:
        """Change the light now, to a pattern's profile or to the dark; return the instant, ns."""
        at_ns = time.monotonic_ns()
        self.changed(DARK if profile is None else profile, at_ns=at_ns)
        return at_ns

    def changed(self, profile: Pixels, *, at_ns: int) -> None:
        with self._lock:
            self._changes.append((max(at_ns, self._changes[-1][0]), profile))

    def exposed(
        self, t_start_ns: int, t_end_ns: int, *, gain: float = 1.0, readout_ns: int = 0, defocus_px: float = 0.0
    ) -> Pixels:
        """(H, W): what the sensor reads after an exposure, with its noise; see `tests.contract.stage.Stage`."""
        with self._lock:
            changes = list(self._changes)
        mean, rows = np.zeros(self._format.size.shape, np.float32), self._format.size.height_px
        for share, profile in exposed_shares(changes, t_start_ns, t_end_ns, rows=rows, readout_ns=readout_ns):
            mean += np.asarray(share, np.float32) * self._seen(profile)
        if defocus_px > 0:
            mean = np.asarray(cv2.GaussianBlur(mean, (0, 0), defocus_px), np.float32)
        electrons = self._sensor.electrons(mean, max(t_end_ns - t_start_ns, 1) / 1e9)
        with self._lock:
            return self._sensor.read_out(electrons, gain=gain, rng=self._rng)

    def expected(self, profile: Pixels, *, exposure_s: float) -> NDArray[np.float32]:
        """(H, W): what the sensor reads of a pattern, DN at gain 1, without noise."""
        electrons = self._sensor.electrons(self._seen(profile), exposure_s)
        return np.asarray(electrons * self._sensor.dn_per_electron(1.0), np.float32)

    @property
    def surface(self) -> SceneSurface:
        """What stands there now."""
        return self._stage.surface

    def _seen(self, profile: Pixels) -> NDArray[np.float32]:
        """(H, W): the mean light on the sensor while this is shown; light adds up, so mixtures are sums of these."""
        key = (profile.shape, profile.tobytes())
        with self._lock:
            if key not in self._images:
                self._images[key] = self._view.image([(1.0, light_table(profile, self.projector, self._response))])
            return self._images[key]


_BETWEEN_LOOKS_S = 0.003
_LOOKS_AGAIN_IN_S = 10.0


class WatchedOutput:
    """Looks at an output's pixels all the time and lights a world with them. A context manager.

    Stands before a sensor as the world itself does. A frame is read out only after a look at the output that follows
    its exposure, so a program that waits for the frame cannot have changed the picture before. A change is known to
    within two looks, and taken to have done so right after the first of them; its light comes `late_s` later, as a
    display's does. A picture that is no pattern ends the watch, and is raised on leaving. `pictures` : each that was
    there, (H, W, 3).
    """

    def __init__(self, pixels: OutputPixels, world: World, *, late_s: float = 0.0) -> None:
        self._pixels, self._world = pixels, world
        self._late_ns = round(late_s * 1e9)
        self._left = threading.Event()
        self._looked = threading.Condition()
        self._seen_until_ns = 0
        self._fault: Exception | None = None
        self.pictures: list[NDArray[np.uint8]] = []
        self._thread = threading.Thread(target=self._watch, name="watched output", daemon=True)

    @property
    def format(self) -> CameraFormat:
        return self._world.format

    def exposed(self, t_start_ns: int, t_end_ns: int, *, readout_ns: int = 0, **more: float) -> Pixels:
        """See `World`. Waits until the output was seen after the exposure."""
        self._see(t_end_ns + readout_ns - self._late_ns)
        return self._world.exposed(t_start_ns, t_end_ns, readout_ns=readout_ns, **more)

    def _see(self, t_ns: int) -> None:
        with self._looked:
            seen = self._looked.wait_for(lambda: self._fault or self._seen_until_ns > t_ns, _LOOKS_AGAIN_IN_S)
        assert seen, "the output was not looked at"

    def _watch(self) -> None:
        last_ns = time.monotonic_ns()
        try:
            while not self._left.is_set():
                now_ns = time.monotonic_ns()
                picture = self._pixels.colours()
                if not self.pictures or not np.array_equal(picture, self.pictures[-1]):
                    self._world.changed(profile_of(picture), at_ns=last_ns + self._late_ns)
                    self.pictures.append(picture)
                last_ns = now_ns
                with self._looked:
                    self._seen_until_ns = now_ns
                    self._looked.notify_all()
                self._left.wait(_BETWEEN_LOOKS_S)
        except (AssertionError, ValueError) as fault:
            with self._looked:
                self._fault = fault
                self._looked.notify_all()

    def __enter__(self) -> Self:
        self._thread.start()
        self._see(0)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        # The last picture counts as well.
        self._see(time.monotonic_ns())
        self._left.set()
        self._thread.join(_LOOKS_AGAIN_IN_S)
        self._pixels.close()
        if self._fault is not None and kind is None:
            raise self._fault


def require_umockdev() -> None:
    """Skip where a fake device cannot stand; fail instead where CI=true, which installs what it needs."""
    if why_not():
        lacking(why_not())


class VideoNode:
    """A fake kernel's /dev/video0, 8 bits of grey unless told otherwise. A context manager.

    environment : what a program needs in its environment to find the device. `sensor.asked` : every exposure read.
    """

    def __init__(self, folder: Path, world: World | WatchedOutput, faked: Faked | None = None) -> None:
        require_umockdev()
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "faults").mkdir()
        # Socket paths may have 107 characters, and those of test folders have more.
        self._short = tempfile.TemporaryDirectory(prefix="slrig-loop-")
        socket = Path(self._short.name) / "light"
        size = world.format.size
        faked = faked or Faked(formats={"GREY": [(size.width_px, size.height_px)]})
        self.sensor = SensorService(
            socket, cast("Below", world), readout_s=faked.readout_s, rolling=faked.rolling, sharp_at=faked.sharp_at
        )
        config = folder / "device.json"
        config.write_text(json.dumps(faked.config(socket, folder / "faults")))
        self._server = subprocess.Popen(  # noqa: S603 - our own program
            ["umockdev-wrapper", str(DEBIAN_PYTHON), "-m", "tests.contract.v4l2_server", str(config)],  # noqa: S607
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        assert self._server.stdout is not None
        word, root = self._server.stdout.readline().split(maxsplit=1)
        assert word == "ready"
        loaded = ["libumockdev-preload.so.0", *filter(None, [os.environ.get("LD_PRELOAD")])]
        self.environment = {"UMOCKDEV_DIR": root.strip(), "LD_PRELOAD": ":".join(loaded)}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError, subprocess.TimeoutExpired):
            self._server.communicate(timeout=10)
        self._server.kill()
        self._server.wait(10)
        self.sensor.close()
        self._short.cleanup()


EXPOSURE_S = 0.0167
OUTPUT = "DUMMY1"
MOST_OF_NOISE = 1.1
BELOW_MM = (1.0, 0.3)
"""Gross errors at depth edges are few, and weigh so much that they hide the rest: without them, too."""
SIMULATED = 4
"""Scans by the simulator: the noise of one pair is known to 5 %, that of six pairs to 2 %."""
SAME_COMPLETENESS = 0.005

SCENE = """
name = "ball before a wall"
[[object]]
name = "wall"
shape = "plane"
size_mm = [160.0, 130.0]
rotation_deg = [8.0, -12.0, 0.0]
position_mm = [0.0, 0.0, 20.0]
albedo = 0.8
[[object]]
name = "ball"
shape = "sphere"
radius_mm = 26.0
position_mm = [-8.0, 4.0, -8.0]
albedo = 0.6
"""
RIG = """
name = "loop"
{calibration}
[projector]
{projector}
[[camera]]
name = "left"
driver = "v4l2"
device = "/dev/video0"
exposure_s = {exposure_s}
frame_rate_hz = 50
gain_unity = 16
focus = 0
"""
SCREEN = """driver = "screen"
output = "{output}"
display = "{display}"
backend = "x11"
native_px = [{width}, {height}]
latency_s = 0
latency_error_s = 0
dark_after_s = 60
"""


def rendered_rig(folder: Path, *, seed: int) -> Path:
    """The rig file of the simulator alone."""
    return write_rig(folder, scene=SCENE, head=f"seed = {seed}\nexposure_s = {EXPOSURE_S}")


def scanned_here(rig: Rig, folder: Path) -> Mesh:
    """Scan in this process."""
    bundle, results = folder / "bundle", folder / "results"
    with rig:
        capture_frames(rig, ScanPlan(), bundle).finish()
    reconstruct_bundle(bundle, results, plan=ReconstructionPlan())
    return mesh_in(results)


def mesh_in(results: Path) -> Mesh:
    """The mesh that a scan wrote, as far as its shape goes."""
    read = trimesh.load_mesh(results / "mesh.ply", process=False)
    # From y up, z towards the rig, to the axes of the calibration.
    read.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
    count = len(read.vertices)
    return Mesh(
        np.asarray(read.vertices, np.float32),
        np.asarray(read.faces, np.int32),
        np.asarray(read.vertex_normals, np.float32),
        np.zeros((count, 3), np.uint8),
        np.zeros(count, np.uint8),
        np.full(count, np.nan, np.float32),
        np.zeros(count, np.int32),
    )


def distances_mm(first: Mesh, second: Mesh) -> NDArray[np.float64]:
    """(n,): from the vertices of either mesh to the other's surface."""
    ways = []
    for mesh, other in ((first, second), (second, first)):
        surface = SearchTree.build(np.asarray(other.vertices_mm, np.float64), other.faces)
        ways.append(surface.distances_mm(np.asarray(mesh.vertices_mm, np.float64)))
    return np.concatenate(ways)


def rms_mm(pairs: Iterable[NDArray[np.float64]], *, below_mm: float) -> float:
    """Root mean square of the distances of pairs of meshes, each pair with the same weight, without gross ones."""
    return float(np.sqrt(np.mean([np.mean(distances[distances < below_mm] ** 2) for distances in pairs])))


@dataclass(frozen=True)
class Reference:
    """Scans by the simulator alone, which differ by their sensor's noise, and what was there to be scanned.

    noise_mm : the rms distance between two of these meshes, for each limit in `BELOW_MM`.
    """

    rig: Path
    meshes: tuple[Mesh, ...]
    noise_mm: Mapping[float, float]
    truth: Truth

    def ratios(self, found: Mesh) -> dict[float, float]:
        """How far a mesh is from the simulator's, over how far these are from one another, for each limit."""
        pairs = [distances_mm(found, mesh) for mesh in self.meshes]
        return {below: rms_mm(pairs, below_mm=below) / self.noise_mm[below] for below in BELOW_MM}

    def scored(self, mesh: Mesh) -> TruthScore:
        """A mesh against what was there to be scanned."""
        (camera,) = self.truth.cameras.values()
        eye_mm = World(self.rig, seed=1).calibration.cameras["left"].centre_mm
        return score(mesh, self.truth.surface, camera.visible_points_mm, eye_mm)

    def require_same(self, found: Mesh) -> None:
        """Compare a scan around the world with the simulator's own."""
        ours, usual = self.scored(found), [self.scored(mesh) for mesh in self.meshes]
        for name in ("complete_01mm", "complete_03mm"):
            missed = getattr(ours, name) - float(np.mean([getattr(each, name) for each in usual]))
            assert abs(missed) <= SAME_COMPLETENESS, name
        assert max(self.ratios(found).values()) <= MOST_OF_NOISE


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    folder = tmp_path_factory.mktemp("simulator")
    rigs = [rendered_rig(folder / str(seed), seed=seed) for seed in range(1, SIMULATED + 1)]
    meshes = tuple(scanned_here(open_rig(read_rig(rig)), rig.parent) for rig in rigs)
    pairs = [distances_mm(*pair) for pair in itertools.combinations(meshes, 2)]
    noise_mm = {below: rms_mm(pairs, below_mm=below) for below in BELOW_MM}
    head = read_rig(rigs[0]).head
    assert head is not None
    return Reference(rigs[0], meshes, noise_mm, open_simulated_head(head.options, rigs[0].parent).truth())


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DummyServer]:
    require_xorg()
    with DummyServer(tmp_path_factory.mktemp("xorg")) as server:
        yield server


def test_a_mesh_two_hundredths_of_a_millimetre_deeper_is_another(reference: Reference) -> None:
    mesh = reference.meshes[0]
    moved = replace(mesh, vertices_mm=mesh.vertices_mm + np.array([0, 0, 0.02], np.float32))
    assert min(reference.ratios(moved).values()) > MOST_OF_NOISE


def test_screen_and_v4l2_around_the_world(
    server: DummyServer, reference: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    require_umockdev()
    world = World(reference.rig, seed=3)
    size = world.projector
    place = server.arrange(DUMMY0=size, DUMMY1=size)[OUTPUT]
    screen = SCREEN.format(output=OUTPUT, display=server.display, width=size.width_px, height=size.height_px)
    write_calibration(tmp_path / "calibration.json", world.calibration)
    rig = tmp_path / "rig.toml"
    calibration = 'calibration = "calibration.json"'
    rig.write_text(RIG.format(calibration=calibration, projector=screen, exposure_s=EXPOSURE_S))
    monkeypatch.setenv("DISPLAY", server.display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    pixels = OutputPixels(server.display, place, size)
    try:
        with WatchedOutput(pixels, world) as watched, VideoNode(tmp_path / "node", watched) as node:
            with serving(rig, tmp_path / "data", **node.environment) as service, service.client() as client:
                scan = scanned(client)
                assert scan["state"] == "succeeded", f"{scan}\n{service.log.read_text()[-3000:]}"
            shown = {picture.tobytes() for picture in watched.pictures}
    finally:
        let_go(OUTPUT)
    patterns = pattern_sequence(PatternPlan(), size)
    wanted = {patterns.image(index)[..., None].repeat(3, axis=2).tobytes() for index in range(len(patterns))}
    assert wanted <= shown
    # A white desktop before, and none after the scan, nor after the service has ended.
    assert not watched.pictures[-1].any()
    reference.require_same(mesh_in(tmp_path / "data" / "scans" / scan["id"]))


def test_trigger_box_plays_to_a_camera_on_its_wire(reference: Reference, tmp_path: Path) -> None:
    world = World(reference.rig, seed=5)
    box = TriggerBox(cast("Below", world), pattern_sequence(PatternPlan(), world.projector))
    try:
        camera = WiredCamera("left", cast("Below", world))
        box.cameras = {"left": camera}
        projector = box.projector()
        assert projector.info.plays
        settings = {"left": CameraSettings(EXPOSURE_S)}
        found = scanned_here(Rig("wired", {"left": camera}, projector, settings, world.calibration), tmp_path / "scan")
        assert not world.profiles[-1].any()
    finally:
        box.line.close()
    reference.require_same(found)


SHOT = range(1, 6)
"""Poses that calibrate; 0 is behind the wall, and a later one verifies."""
VERIFIED = 9
DELAYED = ("/problems/frame-timeout", "/problems/scan-evidence")


class Box:
    """A trigger box with an empty flash and a light that falls on a world."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._flash: list[Pixels] = []
        size = world.projector
        about = description((), width_px=size.width_px, height_px=size.height_px)
        self._about = about
        self.line = SerialLine(CoreEngine(Scene(watch=[self._lit]), about))

    def flash(self, folder: Path) -> None:
        """What a person does with the files of `slrig patterns`: images into the engine, patterns.json onto the box."""
        crc32 = [int(each, 16) for each in json.loads((folder / "patterns.json").read_text())["crc32"]]
        for number in range(len(crc32)):
            image = cv2.imread(str(folder / f"{number:03d}.png"), cv2.IMREAD_COLOR)
            assert image is not None
            self._flash.append(profile_of(np.asarray(image, np.uint8)))
        flashed = description(crc32, width_px=self._about.width_px, height_px=self._about.height_px)

        def power_cycled() -> None:
            self._about.crc32, self._about.count = flashed.crc32, flashed.count
            self.line.restart()

        self.line.do(power_cycled)

    def _lit(self, pattern: int | None) -> None:
        self._world.show(None if pattern is None else self._flash[pattern])


def shoot(caller: Caller, made: dict[str, Any]) -> None:
    """Shoot a pose, and once more where a refusal says so: a busy machine may delay a frame's light."""
    shot: dict[str, Any] = {}
    for _ in range(2):
        caller.post(made["links"]["pose"], 202)
        shot = caller.settled(made)["shot"][-1]
        if shot["state"] == "succeeded":
            return
        assert shot["error"]["detail"].endswith("shoot again") or "shoot again;" in shot["error"]["detail"]
    pytest.fail(str(shot["error"]))


def ended(caller: Caller, path: str) -> dict[str, Any]:
    """A job that has succeeded; asked for again where it was refused because a busy machine delayed its frames."""
    for _ in range(3):
        begun = caller.post(path, 202)
        caller.http.get(begun["links"]["events"])
        found = caller.get(begun["links"]["self"])
        if found["state"] == "succeeded":
            return found
        assert found["error"]["type"] in DELAYED, found["error"]
    pytest.fail(str(found["error"]))


def test_one_flash_of_the_box_serves_from_the_doctor_to_a_verification(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    require_umockdev()
    world = World(write_board_rig(tmp_path / "world"), seed=8)
    world.move(SHOT[0])
    box = Box(world)
    # Under a name of its own: umockdev takes every terminal in /dev for a device of its test bed.
    port = tmp_path / "box"
    port.symlink_to(box.line.path)
    rig = tmp_path / "rig" / "rig.toml"
    rig.parent.mkdir()
    projector = f'driver = "serial_projector"\nport = "{port}"'
    rig.write_text(RIG.format(calibration="", projector=projector, exposure_s=EXPOSURE_S))
    try:
        with VideoNode(tmp_path / "node", world) as node:
            for name, value in node.environment.items():
                monkeypatch.setenv(name, value)
            first_day(rig, world, box)
    finally:
        box.line.close()
    assert len(list((rig.parent / "patterns").iterdir())) == 1, "one export, whatever was shown"
    assert not world.profiles[-1].any()


def first_day(rig: Path, world: World, box: Box) -> None:
    """Everything from the empty box to the verdict."""
    said = slrig("patterns", rig).stdout
    (folder,) = (rig.parent / "patterns").iterdir()
    assert str(folder) in said
    box.flash(folder)

    doctored = rig.with_name("doctored.toml")
    # It ends with 1 where it finds a fault.
    done = slrig("doctor", rig, "--output", doctored, "--search-s", "0.05", "--json", codes=(0, 1))
    found = json.loads(done.stdout)
    names = {finding["name"]: finding["severity"] for finding in found["findings"]}
    assert "patterns.own" not in names, "the doctor's own patterns are among those that were flashed"
    # It is the camera's stamps that are uncertain; the file that the doctor writes waits for that.
    assert {name for name, severity in names.items() if severity == "fault"} <= {"timing.late"}, found

    depth_mm = mesh_in(calibrated_and_verified(doctored, world)).vertices_mm[:, 2]
    assert np.isfinite(depth_mm).all()
    assert len(depth_mm) > 10_000


def calibrated_and_verified(rig: Path, world: World, **environment: str) -> Path:
    """Calibrate a rig by a board, scan with that, verify it, and return the scan's results."""
    with serving(rig, rig.parent / "data", **environment) as service, Caller(service) as caller:
        made = caller.post("/calibration", 201, board=BOARD)
        for pose in SHOT:
            world.move(pose)
            shoot(caller, made)
        caller.post(made["links"]["solve"], 202)
        solved = caller.settled(made)
        assert solved["state"] == "solved", solved["error"]
        caller.post(solved["links"]["activate"], 200)
        world.move(VERIFIED)
        scan = ended(caller, "/scan")
        verified = ended(caller, "/rig/verification")
        assert verified["found"]["state"] == "good", verified["found"]
    return service.data / "scans" / str(scan["id"])
