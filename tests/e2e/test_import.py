"""`slrig import`: images of other programs give the mesh that slrig's own bundle of them gives, or a refusal.

A rendered rig plays the patterns of each program, as that program is documented to make them, written down here anew;
its frames are laid out as the program lays them out. Real captures of two of them are imported where they are at hand.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from slrig.bundle import read_bundle, write_bundle
from slrig.cli.commands import app
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.model import Axis, Black, Gray, Pattern, PatternSequence, Pixels, Shot, Size, White
from slrig.patterns.sequence import encode
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ScanPlan
from tests.e2e.conftest import write_rig
from tests.golden.test_bundles import reconstructed

PROJECTOR = Size(200, 160)


def gray(extent: int, bits: int, *, offset: int = 0) -> list[Pixels]:
    """(extent,) profiles of the first bits of a code of 8, most significant first: bit b of i is b of i xor i/2."""
    places = np.arange(extent) + offset
    return [
        ((places // 2**power + places // 2 ** (power + 1)) % 2 * 255).astype(np.uint8) for power in range(7, -1, -1)
    ][:bits]


def profiles(columns: Sequence[Pixels], rows: Sequence[Pixels], *, inverses: bool) -> list[Pixels]:
    """Each bit, followed by its inverse: of columns as one row, of rows as one column."""
    both = [*(each[None, :] for each in columns), *(each[:, None] for each in rows)]
    return [image for each in both for image in ((each, 255 - each) if inverses else (each,))]


WHITE, BLACK = np.full((1, 1), 255, np.uint8), np.zeros((1, 1), np.uint8)
SHOWN = {
    "opencv": [*profiles(gray(200, 8), gray(160, 8), inverses=True), WHITE, BLACK],
    # Both codes have as many bits, the projector is in the middle of them, and the finest bit is not shown.
    "scan3d": [
        WHITE,
        BLACK,
        *profiles(gray(200, 7, offset=(256 - 200) // 2), gray(160, 7, offset=(256 - 160) // 2), inverses=True),
    ],
    "slstudio": [WHITE, BLACK, *profiles(gray(200, 8), [], inverses=False)],
}


def own_patterns(program: str) -> list[Pattern]:
    """The same in slrig's words, written by hand."""
    both = (False, True)
    if program == "opencv":
        return [*(Gray(axis, bit, 8, 1, 0, inv) for axis in Axis for bit in range(8) for inv in both), White(), Black()]
    if program == "scan3d":
        offsets = {Axis.COLUMN: 28, Axis.ROW: 48}
        code = [Gray(axis, bit, 7, 2, offsets[axis], inv) for axis in Axis for bit in range(7) for inv in both]
        return [White(), Black(), *code]
    return [White(), Black(), *(Gray(Axis.COLUMN, bit, 8) for bit in range(8))]


@pytest.mark.parametrize("program", SHOWN)
def test_the_patterns_of_a_program_light_what_slrig_says(program: str) -> None:
    ours = encode(own_patterns(program), PROJECTOR)
    assert len(ours) == len(SHOWN[program])
    for index, theirs in enumerate(SHOWN[program]):
        assert (ours.image(index) == np.broadcast_to(theirs, PROJECTOR.shape)).all(), index


@pytest.mark.parametrize("size", [Size(1024, 768), Size(912, 1140), Size(13, 8), Size(2, 3)], ids=str)
def test_opencv_itself_shows_these_patterns(size: Size) -> None:
    if not hasattr(cv2, "structured_light"):
        pytest.skip("needs OpenCV's extra modules: pip install opencv-contrib-python-headless")
    from slrig.foreign.layouts import Code, opencv_sequence

    made, images = cv2.structured_light.GrayCodePattern.create(size.width_px, size.height_px).generate()
    assert made
    ours = encode(opencv_sequence(Code(size), len(images), (), ends_first=False), size)
    for index, image in enumerate(images):
        assert (ours.image(index) == image).all(), index


class Recorded:
    """A scan of a small rendered rig that plays a program's patterns: slrig's bundle, and its frames."""

    def __init__(self, folder: Path, patterns: Sequence[Pattern], monkeypatch: pytest.MonkeyPatch) -> None:
        rig = write_rig(folder)
        text = rig.read_text().replace("[256, 192]", "[200, 160]").replace("[240, 192]", "[480, 384]")
        for device in ("1100.0, 1101.0", "950.0, 951.0"):
            x, y = map(float, device.split(", "))
            factor = 0.8 if x > 1000 else 2
            text = text.replace(device, f"{x * factor}, {y * factor}")
        rig.write_text(text)
        sequence: PatternSequence = encode(patterns, PROJECTOR)
        monkeypatch.setattr("slrig.scan.acquisition.pattern_sequence", lambda *_, **__: sequence)
        with open_rig(read_rig(rig)) as opened:
            capture_frames(
                opened, ScanPlan(), folder / "own", progress=lambda *_: None, cancelled=lambda: False
            ).finish()
        self.folder = folder / "own"
        bundle = read_bundle(self.folder)
        assert bundle.calibration is not None
        self.capture, self.calibration = bundle.capture, bundle.calibration

    def images(self) -> list[Pixels]:
        return [shot.image for shot in self.capture.shots]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Recorded]:
    kept: dict[str, Recorded] = {}

    def record(program: str) -> Recorded:
        if program not in kept:
            with pytest.MonkeyPatch.context() as patch:
                kept[program] = Recorded(tmp_path_factory.mktemp(program), own_patterns(program), patch)
        return kept[program]

    return record


def lay_out(folder: Path, images: Sequence[Pixels], name: str, *, first: int = 0) -> Path:
    folder.mkdir(parents=True)
    for number, image in enumerate(images, first):
        assert cv2.imwrite(str(folder / name.format(number)), image)
    return folder


def run(*words: object) -> Result:
    return CliRunner().invoke(app, ["import", *map(str, words)])


def imported(folder: Path, output: Path, *words: object, projector: str = "200x160") -> Result:
    return run(folder, "--output", output, "--projector", projector, *words)


def refused(result: Result, *words: str) -> None:
    assert result.exit_code == 2, result.output
    said = " ".join(result.stderr.split())
    assert [word for word in words if word not in said] == [], said


def opencv_file(
    path: Path, names: Sequence[str], values: Sequence[object], numbers: dict[str, int] | None = None
) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in [*zip(names, values, strict=True), *(numbers or {}).items()]:
        storage.write(name, value)
    storage.release()


def lenses(scan: Recorded) -> list[np.ndarray]:
    """Two lenses and the pose of the second in the first, as other programs have them."""
    camera, projector = scan.calibration.cameras["left"], scan.calibration.projector
    assert projector is not None
    turn = projector.rotation @ camera.rotation.T
    move = projector.translation_mm - turn @ camera.translation_mm
    return [
        camera.matrix, camera.distortion[None], projector.matrix, projector.distortion[None], turn, move[:, None]
    ]  # fmt: skip


def same_mesh(one: Path, other: Path, scratch: Path) -> None:
    reconstructed(one, scratch / "one")
    reconstructed(other, scratch / "other")
    assert (scratch / "one" / "mesh.ply").read_bytes() == (scratch / "other" / "mesh.ply").read_bytes()


def in_the_cameras_frame(scan: Recorded, folder: Path) -> Path:
    """A bundle of slrig's own with the camera's frame as world, as the calibrations of other programs have it."""
    turn, move = lenses(scan)[-2:]
    calibration = scan.calibration
    assert calibration.projector is not None
    left = replace(calibration.cameras["left"], rotation=np.eye(3), translation_mm=np.zeros(3))
    there = replace(calibration.projector, rotation=turn, translation_mm=move.ravel())
    capture = scan.capture
    write_bundle(folder, capture, replace(calibration, cameras={"left": left}, projector=there, solved=None))
    return folder


@pytest.mark.slow
def test_images_in_opencvs_order_give_the_mesh_of_slrigs_bundle(
    recorded: Callable[[str], Recorded], tmp_path: Path
) -> None:
    scan = recorded("opencv")
    folder = lay_out(tmp_path / "images", scan.images(), "pattern_cam1_im{}.png", first=1)
    shutil.copy(scan.folder / "calibration.json", folder)
    done = imported(folder, tmp_path / "bundle", "--camera", "left")
    assert done.exit_code == 0, done.output
    bundle = read_bundle(tmp_path / "bundle")
    assert list(bundle.capture.patterns) == own_patterns("opencv")
    assert bundle.capture.cameras == scan.capture.cameras
    same_mesh(scan.folder, tmp_path / "bundle", tmp_path)
    assert reconstructed(scan.folder, tmp_path / "judged")["truth"]["rms_mm"] < 0.06


@pytest.mark.parametrize("ends", ["first", "swapped", "none"])
def test_white_and_black_may_stand_first_or_last_or_be_absent(
    recorded: Callable[[str], Recorded], tmp_path: Path, ends: str
) -> None:
    *images, white, black = recorded("opencv").images()
    *code, _, _ = own_patterns("opencv")
    orders: dict[str, tuple[list[Pixels], list[Pattern]]] = {
        "first": ([white, black, *images], [White(), Black(), *code]),
        "swapped": ([*images, black, white], [*code, Black(), White()]),
        "none": (images, code),
    }
    shown, wanted = orders[ends]
    folder = lay_out(tmp_path / "images", shown, "{:02}.png")
    assert imported(folder, tmp_path / "bundle").exit_code == 0
    assert list(read_bundle(tmp_path / "bundle").capture.patterns) == wanted


@pytest.mark.slow
def test_scan3ds_folder_gives_the_mesh_of_slrigs_bundle(recorded: Callable[[str], Recorded], tmp_path: Path) -> None:
    scan = recorded("scan3d")
    folder = lay_out(tmp_path / "images", scan.images(), "cam_{:02}.png", first=1)
    values = lenses(scan)
    # Its pixels are cells of two of the projector's columns and rows: x = 2 x' + 1/2.
    values[2] = np.diag([0.5, 0.5, 1.0]) @ (values[2] - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    names = ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T")
    opencv_file(folder / "calibration.yml", [*names, "E"], [*values, np.eye(3)])
    done = imported(folder, tmp_path / "bundle", "--format", "scan3d", "--camera", "left")
    assert done.exit_code == 0, done.output
    bundle = read_bundle(tmp_path / "bundle")
    assert list(bundle.capture.patterns) == own_patterns("scan3d")
    own = read_bundle(in_the_cameras_frame(scan, tmp_path / "own"))
    assert bundle.calibration is not None
    assert bundle.calibration.projector is not None
    assert own.calibration is not None
    assert own.calibration.projector is not None
    assert np.allclose(bundle.calibration.projector.matrix, own.calibration.projector.matrix, atol=1e-9)
    same_mesh(tmp_path / "own", tmp_path / "bundle", tmp_path)


def test_slstudios_folder_gives_the_mesh_of_slrigs_bundle(recorded: Callable[[str], Recorded], tmp_path: Path) -> None:
    scan = recorded("slstudio")
    folder = lay_out(tmp_path / "images", scan.images(), "frameSeq_{:02}.bmp")
    extents = {"frameWidth": 480, "frameHeight": 384, "screenResX": 200, "screenResY": 160}
    opencv_file(tmp_path / "rig.xml", ("Kc", "kc", "Kp", "kp", "Rp", "Tp"), lenses(scan), extents)
    done = imported(
        folder, tmp_path / "bundle", "--format", "slstudio", "--camera", "left", "--calibration", tmp_path / "rig.xml"
    )
    assert done.exit_code == 0, done.output
    assert list(read_bundle(tmp_path / "bundle").capture.patterns) == own_patterns("slstudio")
    same_mesh(in_the_cameras_frame(scan, tmp_path / "own"), tmp_path / "bundle", tmp_path)


def test_a_capture_without_a_calibration_decodes(recorded: Callable[[str], Recorded], tmp_path: Path) -> None:
    folder = lay_out(tmp_path / "images", recorded("opencv").images(), "{:02}.png")
    assert imported(folder, tmp_path / "bundle").exit_code == 0
    done = CliRunner().invoke(
        app, ["reconstruct", str(tmp_path / "bundle"), "--decode-only", "--output", str(tmp_path / "decoded")]
    )
    assert done.exit_code == 0, done.output


def test_names_by_a_template_and_by_a_list(recorded: Callable[[str], Recorded], tmp_path: Path) -> None:
    scan = recorded("opencv")
    folder, lines = tmp_path / "images", ["file,pattern,camera"]
    for camera in ("a", "b"):
        (folder / camera).mkdir(parents=True)
    for shot in scan.capture.shots:
        pattern = scan.capture.patterns[shot.pattern]
        if isinstance(pattern, Gray):
            kind = "inv" if pattern.inverted else "n"
            name = f"{pattern.axis.value[:3]}_{7 - pattern.bit:02}_{kind}.png"
            words = f"{pattern.axis.value} {pattern.bit}{' inverted' if pattern.inverted else ''}"
        else:
            name, words = f"{pattern.kind}.png", pattern.kind
        for camera in ("a", "b"):
            cv2.imwrite(str(folder / camera / name), shot.image)
            lines.append(f"{camera}/{name}, {words}, {camera}")
    (folder / "a" / "preview.png").write_bytes((folder / "a" / "white.png").read_bytes())
    (tmp_path / "list.csv").write_text("\n".join(lines))
    template = ("--names", "{camera}/{axis}_{power:02}_{inverted}.png", "--white", "{camera}/white.png")
    done = imported(folder, tmp_path / "one", *template, "--black", "{camera}/black.png")
    assert done.exit_code == 0, done.output
    assert "1 images that no pattern is known of: a/preview.png" in done.stdout
    assert imported(folder, tmp_path / "other", "--list", tmp_path / "list.csv").exit_code == 0
    wanted = {shot.pattern: shot.image for shot in scan.capture.shots}
    for bundle in ("one", "other"):
        capture = read_bundle(tmp_path / bundle).capture
        assert set(capture.cameras) == {"a", "b"}
        assert len(capture.shots) == 2 * len(scan.capture.shots)
        for shot in capture.shots:
            index = scan.capture.patterns.index(capture.patterns[shot.pattern])
            assert (shot.image == wanted[index]).all()


def test_what_does_not_fit_is_refused_in_words(recorded: Callable[[str], Recorded], tmp_path: Path) -> None:
    images = recorded("opencv").images()
    out = tmp_path / "bundle"
    whole = lay_out(tmp_path / "whole", images, "{:02}.png")
    refused(imported(whole, out, projector="1280x800"), "expected 42 images for a projector of 1280 x 800", "found 34")
    refused(imported(whole, out, projector="200"), "expected columns x rows as 1024x768, found '200'")
    refused(imported(whole, out, "--pattern", "white black columns"), "expected 18 images", "found 34")
    refused(imported(whole, out, "--pattern", "white xor-02"), "'xor-02'", "XOR-02", "not read")
    refused(imported(whole, out, "--pattern", "white, black, columns, rows"), "expected white, and 01.png black")
    refused(imported(whole, out, "--format", "slstudio"), "expected 10, 8, 16 images", "phase shifts are not read")
    refused(imported(whole, out, "--format", "scan3d", "--names", "{bit}.png"), "expected one of --format")
    refused(imported(whole, out, "--camera", "a", "--camera", "b"), "expected 1 names of cameras (cam0), found 2")
    refused(imported(whole, out, "--format", "scan3d", "--cell-px", 2), "expected no --cell-px and --offset-px")
    refused(imported(tmp_path / "none", out), "expected a folder of images")
    (whole / "07.png").unlink()
    refused(imported(whole, out), "found 33 images")
    refused(imported(whole, out, "--names", "{bit:02}.png"), "expected bits 0 to 7")
    cv2.imwrite(str(whole / "07.png"), images[7][:-1])
    refused(imported(whole, out), "07.png: expected 480 x 384 of 8 bits as 00.png, found 480 x 383")
    # Three steps of a phase instead of a code.
    phases = [np.tile(np.uint8(127 + 100 * np.cos(np.arange(64) / 5 + k)), (48, 1)) for k in (0, 2, 4)]
    three = lay_out(tmp_path / "three", phases, "frameSeq_{:02}.bmp")
    refused(imported(three, out, "--format", "slstudio"), "found 3", "phase shifts are not read")
    twelve = lay_out(tmp_path / "twelve", phases * 4, "{:02}.bmp")
    (twelve / "10.bmp").unlink()
    (twelve / "11.bmp").unlink()
    refused(imported(twelve, out, "--format", "slstudio"), "These may be phase shifts")
    assert not out.exists()
    assert list(tmp_path.glob(".*")) == []


def test_depth_and_colour_are_those_of_the_files(tmp_path: Path) -> None:
    lit = np.random.default_rng(1).integers(2000, 4000, (30, 40)).astype(np.uint16)
    code = [(lit * (np.arange(40) // 20 == side)).astype(np.uint16) for side in (1, 0)]
    folder = lay_out(tmp_path / "deep", [lit, lit // 9, *code], "{}.png")
    words = ("--pattern", "white black columns")
    refused(imported(folder, tmp_path / "no", *words, projector="2x1"), "--bit-depth 12")
    assert imported(folder, tmp_path / "deep12", *words, "--bit-depth", 12, projector="2x1").exit_code == 0
    assert read_bundle(tmp_path / "deep12").capture.cameras["cam0"].bit_depth == 12
    refused(imported(folder, tmp_path / "no", *words, "--bit-depth", 8, projector="2x1"), "samples of 16 bits, found 8")
    blue = np.dstack([lit // 16, lit // 64, lit // 32]).astype(np.uint8)
    shown = [blue, blue // 9, *(np.where(each[..., None] > 0, blue, 0).astype(np.uint8) for each in code)]
    assert (
        imported(lay_out(tmp_path / "bgr", shown, "{}.png"), tmp_path / "colour", *words, projector="2x1").exit_code
        == 0
    )
    shots: tuple[Shot, ...] = read_bundle(tmp_path / "colour").capture.shots
    assert [shot.colour is not None for shot in shots] == [True, True, False, False]
    assert shots[0].colour is not None
    assert (shots[0].colour == blue).all()
    assert (shots[2].image == cv2.cvtColor(shown[2], cv2.COLOR_BGR2GRAY)).all()


@pytest.mark.shared
@pytest.mark.parametrize(
    ("capture", "words"),
    [
        ("boards/pose_0", ("--projector", "1024x768")),
        ("skull", ("--projector", "1824x1140", "--format", "slstudio", "--calibration", "calibration.json")),
    ],
)
def test_real_captures_are_imported_as_they_were_by_hand(
    shared: Path, tmp_path: Path, capture: str, words: tuple[str, ...]
) -> None:
    folder = shared / "captures" / capture
    told = [str(folder / word) if word.endswith(".json") else word for word in words]
    done = run(folder / "frames", "--output", tmp_path / "bundle", *told)
    assert done.exit_code == 0, done.output
    by_hand, found = read_bundle(folder), read_bundle(tmp_path / "bundle")
    assert found.capture.patterns == by_hand.capture.patterns
    assert found.capture.cameras == by_hand.capture.cameras
    for one, other in zip(found.capture.shots, by_hand.capture.shots, strict=True):
        assert one.pattern == other.pattern
        assert (one.image == other.image).all()
    assert (found.calibration is None) == (by_hand.calibration is None)
