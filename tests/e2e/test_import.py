"""`slrig import`: images of other programs become a bundle that gives the mesh of slrig's own, or are refused.

A rig plays the patterns of each program as that program is documented to make them, written down here a second time.
Frames are laid out as the program lays them out. Real captures of two of them are imported where they are at hand.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import Result

from slrig.bundle import read_bundle, write_bundle
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.model import Axis, Black, FloatArray, Gray, Pattern, Pixels, Size, White
from slrig.patterns.sequence import encode
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ScanPlan
from tests.core import parametrize_core
from tests.e2e.conftest import write_rig
from tests.golden.test_bundles import reconstructed
from tests.rendered_folders import understand_folder_of
from tests.unit.command import slrig

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
BOTH = (False, True)
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
OWN: dict[str, list[Pattern]] = {
    "opencv": [
        *(Gray(axis, bit, 8, 1, 0, inverted) for axis in Axis for bit in range(8) for inverted in BOTH),
        White(), Black(),
    ],
    "scan3d": [
        White(), Black(),
        *(Gray(axis, bit, 7, 2, offset, inverted) for axis, offset in ((Axis.COLUMN, 28), (Axis.ROW, 48))
          for bit in range(7) for inverted in BOTH),
    ],
    "slstudio": [White(), Black(), *(Gray(Axis.COLUMN, bit, 8) for bit in range(8))],
}  # fmt: skip
"""The same in slrig's words, written by hand."""


@pytest.mark.parametrize("program", SHOWN)
def test_the_patterns_of_a_program_light_what_slrig_says(program: str) -> None:
    ours = encode(OWN[program], PROJECTOR)
    assert len(ours) == len(SHOWN[program])
    for index, theirs in enumerate(SHOWN[program]):
        assert (ours.image(index) == np.broadcast_to(theirs, PROJECTOR.shape)).all(), index


@pytest.mark.parametrize("size", [Size(1024, 768), Size(912, 1140), Size(13, 8), Size(2, 3)], ids=str)
def test_opencv_itself_shows_these_patterns(size: Size) -> None:
    if not hasattr(cv2, "structured_light"):
        pytest.skip("needs OpenCV's extra modules: pip install opencv-contrib-python-headless")
    from slrig.importers.orders import ProjectorCode, opencv_sequence

    made, images = cv2.structured_light.GrayCodePattern.create(size.width_px, size.height_px).generate()
    assert made
    ours = encode(opencv_sequence(ProjectorCode(size), len(images), (), references_first=False), size)
    for index, image in enumerate(images):
        assert (ours.image(index) == image).all(), index


def photographed(program: str) -> list[Pixels]:
    """Small images of a program's patterns, as of a camera that looks at the projector's picture."""
    sequence = encode(OWN[program], PROJECTOR)
    return [np.uint8(10) + sequence.image(index)[::5, ::5] // np.uint8(2) for index in range(len(sequence))]


def lay_out(folder: Path, images: Sequence[Pixels], name: str = "{:02}.png", *, first: int = 0) -> Path:
    folder.mkdir(parents=True)
    for number, image in enumerate(images, first):
        assert cv2.imwrite(str(folder / name.format(number)), image)
    return folder


def run(*words: object) -> Result:
    return slrig("import", *words)


def imported(folder: Path, output: Path, *words: object, projector: str = "200x160") -> Path:
    done = run(folder, "--output", output, "--projector", projector, *words)
    assert done.exit_code == 0, done.output
    return output


@parametrize_core(
    "order", ["opencv", "white first", "black first", "without both", "scan3d", "slstudio"], core=[0, 3, 4, 5]
)
def test_the_order_of_the_images_says_their_patterns(tmp_path: Path, order: str) -> None:
    program = order if order in SHOWN else "opencv"
    shown, wanted = photographed(program), OWN[program]
    match order:
        case "white first":
            shown, wanted = [*shown[-2:], *shown[:-2]], [*wanted[-2:], *wanted[:-2]]
        case "black first":
            shown, wanted = [*shown[:-2], shown[-1], shown[-2]], [*wanted[:-2], Black(), White()]
        case "without both":
            shown, wanted = shown[:-2], wanted[:-2]
    bundle = imported(lay_out(tmp_path / "images", shown), tmp_path / "bundle", "--format", program)
    assert list(read_bundle(bundle).capture.patterns) == wanted


def test_names_by_a_template_and_by_a_list(tmp_path: Path) -> None:
    folder, lines = tmp_path / "images", ["file,pattern,camera"]
    shown = dict(zip(OWN["opencv"], photographed("opencv"), strict=True))
    for pattern, image in shown.items():
        if isinstance(pattern, Gray):
            name = f"{pattern.axis.value[:3]}_{7 - pattern.bit:02}_{'inv' if pattern.inverted else 'n'}.png"
            words = f"{pattern.axis.value} {pattern.bit}{' inverted' if pattern.inverted else ''}"
        else:
            name, words = f"{pattern.kind}.png", pattern.kind
        for camera in ("a", "b"):
            (folder / camera).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / camera / name), image)
            lines.append(f"{camera}/{name}, {words}, {camera}")
    shutil.copy(folder / "a" / "white.png", folder / "a" / "preview.png")
    (tmp_path / "list.csv").write_text("\n".join(lines))
    template = ("--names", "{camera}/{axis}_{power:02}_{inverted}.png", "--white", "{camera}/white.png")
    ends = (*template, "--black", "{camera}/black.png")
    done = run(folder, "--output", tmp_path / "one", "--projector", "200x160", *ends)
    assert "1 images that no pattern is known of: a/preview.png" in done.stdout
    for bundle in (tmp_path / "one", imported(folder, tmp_path / "other", "--list", tmp_path / "list.csv")):
        capture = read_bundle(bundle).capture
        assert set(capture.cameras) == {"a", "b"}
        assert len(capture.shots) == 2 * len(shown)
        assert all((shot.image == shown[capture.patterns[shot.pattern]]).all() for shot in capture.shots)


@pytest.mark.slow
def test_what_does_not_fit_is_refused_in_words(tmp_path: Path) -> None:
    images, out = photographed("opencv"), tmp_path / "bundle"
    whole = lay_out(tmp_path / "whole", images)

    def refused(folder: Path, *words: object, says: Sequence[str], projector: str = "200x160") -> None:
        result = run(folder, "--output", out, "--projector", projector, *words)
        assert result.exit_code == 2, result.output
        said = " ".join(result.stderr.split())
        assert [word for word in says if word not in said] == [], said

    count = "expected 44 images for a projector of 1280 x 800: white, black, 42 of the code"
    refused(whole, "--format", "opencv", projector="1280x800", says=[count, "found 34"])
    refused(whole, projector="1280x800", says=["8 bits with cells of 1 px would end at column 255", "bundle-sheet.png"])
    refused(whole, "--pattern", "white black columns", says=["expected 18 images", "found 34"])
    refused(whole, "--pattern", "white, black, columns, rows", says=["2 frames ahead of their patterns"])
    refused(whole, "--format", "slstudio", says=["expected 10, 8, 16 images", "phase shifts are described by"])
    refused(whole, "--format", "scan3d", "--names", "{bit}.png", says=["expected one of --format"])
    refused(whole, "--camera", "a", "--camera", "b", says=["expected 1 names of cameras (cam0), found 2"])
    refused(whole, "--format", "scan3d", "--cell-px", 2, says=["expected no --cell-px and --offset-px"])
    refused(tmp_path / "none", says=["expected a folder of images"])
    (whole / "07.png").unlink()
    refused(whole, "--format", "opencv", says=["found 33"])
    refused(whole, says=["no image shows column bit 3 inverse: a frame is missing"])
    cv2.imwrite(str(whole / "07.png"), images[7][:-1])
    refused(whole, "--format", "opencv", says=["07.png: expected 40 x 32 of 8 bits as 00.png, found 40 x 31"])
    # Three steps of a phase instead of a code.
    phases = [np.tile(np.uint8(127 + 100 * np.cos(np.arange(64) / 5 + k)), (48, 1)) for k in (0, 2, 4)]
    three = lay_out(tmp_path / "three", phases, "frameSeq_{:02}.bmp")
    refused(three, "--format", "slstudio", says=["found 3", "phase shifts are described by"])
    ten = lay_out(tmp_path / "ten", (phases * 4)[:10], "{:02}.bmp")
    refused(ten, "--format", "slstudio", says=["These may be phase shifts"])
    # Samples of 12 bits in files of 16.
    deep = lay_out(tmp_path / "deep", deep_images())
    words = ("--pattern", "white black columns")
    refused(deep, *words, "--bit-depth", 8, projector="2x1", says=["samples of 16 bits, found 8"])
    assert not out.exists()
    assert list(tmp_path.glob(".*")) == []


def deep_images() -> list[Pixels]:
    """White, black and one bit of columns, of 12 bits."""
    lit = np.random.default_rng(1).integers(2000, 4000, (30, 40)).astype(np.uint16)
    return [lit, lit // 9, *((lit * (np.arange(40) // 20 == side)).astype(np.uint16) for side in (1, 0))]


def test_depth_and_colour_are_those_of_the_files(tmp_path: Path) -> None:
    words = ("--pattern", "white black columns")
    deep = lay_out(tmp_path / "12", deep_images())
    for name, given in (("a", ("--bit-depth", 14)), ("c", ())):
        bundle = imported(deep, tmp_path / name, *words, *given, projector="2x1")
        assert read_bundle(bundle).capture.cameras["cam0"].bit_depth == (14 if given else 12)
    coloured = [np.dstack([each // 16, each // 64, each // 32]).astype(np.uint8) for each in deep_images()]
    bundle = imported(lay_out(tmp_path / "bgr", coloured), tmp_path / "b", *words, projector="2x1")
    shots = read_bundle(bundle).capture.shots
    assert [shot.colour is not None for shot in shots] == [True, True, False, False]
    assert shots[0].colour is not None
    assert (shots[0].colour == coloured[0]).all()
    assert (shots[2].image == cv2.cvtColor(coloured[2], cv2.COLOR_BGR2GRAY)).all()


def opencv_file(path: Path, names: Sequence[str], values: Sequence[object]) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in zip(names, values, strict=True):
        storage.write(name, value)
    storage.release()


SCAN3D = ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T", "E")


def of_cells(matrix: FloatArray) -> FloatArray:
    """The projector's lens as scan3d has it: its pixels are cells of two columns and rows, x = 2 x' + 1/2."""
    return np.asarray(np.diag([0.5, 0.5, 1.0]) @ (matrix - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))


def test_scan3ds_lens_is_of_its_cells(tmp_path: Path) -> None:
    folder = lay_out(tmp_path / "images", photographed("scan3d"), "cam_{:02}.png", first=1)
    lens, straight = np.array([[400.0, 0, 99], [0, 400, 79], [0, 0, 1]]), np.zeros((1, 5))
    seen = np.array([[80.0, 0, 19.4], [0, 80, 15.4], [0, 0, 1]])
    values = [seen, straight, of_cells(lens), straight, np.eye(3), np.array([[-100.0], [0], [0]]), np.eye(3)]
    opencv_file(folder / "calibration.yml", SCAN3D, values)
    calibration = read_bundle(imported(folder, tmp_path / "bundle", "--format", "scan3d")).calibration
    assert calibration is not None
    assert calibration.projector is not None
    np.testing.assert_allclose(calibration.projector.matrix, lens)


def test_the_unit_of_a_calibration_is_asked_and_taken(tmp_path: Path) -> None:
    folder = lay_out(tmp_path / "images", photographed("opencv"))
    lens, straight = np.array([[80.0, 0, 19.4], [0, 80, 15.4], [0, 0, 1]]), np.zeros((1, 5))
    shift = np.array([[-0.1], [0], [0]])
    opencv_file(folder / "calibration.yml", SCAN3D, [lens, straight, lens, straight, np.eye(3), shift, np.eye(3)])
    result = run(folder, "--output", tmp_path / "bundle", "--projector", "200x160", "--format", "opencv")
    assert result.exit_code == 2
    assert "are 0.1 mm apart (--unit mm). Metres?" in " ".join(result.stderr.split())
    calibration = read_bundle(imported(folder, tmp_path / "bundle", "--unit", "m", "--format", "opencv")).calibration
    assert calibration is not None
    assert calibration.projector is not None
    np.testing.assert_allclose(calibration.projector.translation_mm, (-100, 0, 0))


class Recorded:
    """A scan of a small rendered rig that plays a program's patterns: slrig's bundle, and its frames."""

    def __init__(self, folder: Path, program: str, monkeypatch: pytest.MonkeyPatch) -> None:
        rig = write_rig(folder)
        text = rig.read_text().replace("[256, 192]", "[200, 160]").replace("[240, 192]", "[480, 384]")
        text = text.replace("[1100.0, 1101.0]", "[880.0, 880.8]").replace("[950.0, 951.0]", "[1900.0, 1902.0]")
        rig.write_text(text)
        sequence = encode(OWN[program], PROJECTOR)
        monkeypatch.setattr("slrig.scan.acquisition.rig_sequence", lambda *_, **__: sequence)
        self.folder = folder / "own"
        with open_rig(read_rig(rig)) as opened:
            plan = ScanPlan()
            capture_frames(opened, plan, self.folder).finish()
        bundle = read_bundle(self.folder)
        assert bundle.calibration is not None
        self.capture, self.calibration = bundle.capture, bundle.calibration
        self.images = [shot.image for shot in self.capture.shots]
        camera, projector = self.calibration.cameras["left"], self.calibration.projector
        assert projector is not None
        turn = projector.rotation @ camera.rotation.T
        move = projector.translation_mm - turn @ camera.translation_mm
        # Two lenses and the pose of the second in the first, as other programs have them.
        self.lenses = [
            camera.matrix, camera.distortion[None], projector.matrix, projector.distortion[None], turn, move[:, None]
        ]  # fmt: skip

    def in_the_cameras_frame(self, folder: Path) -> Path:
        """A bundle of slrig's own with the camera's frame as world, as the calibrations of other programs have it."""
        calibration = self.calibration
        assert calibration.projector is not None
        left = replace(calibration.cameras["left"], rotation=np.eye(3), translation_mm=np.zeros(3))
        there = replace(calibration.projector, rotation=self.lenses[4], translation_mm=self.lenses[5].ravel())
        write_bundle(folder, self.capture, replace(calibration, cameras={"left": left}, projector=there, solved=None))
        return folder


@pytest.mark.slow
@pytest.mark.parametrize("program", SHOWN)
def test_the_images_of_a_program_give_the_mesh_of_slrigs_bundle(
    program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = Recorded(tmp_path / "rig", program, monkeypatch)
    words = ["--camera", "left"]
    match program:
        case "opencv":
            folder = lay_out(tmp_path / "images", scan.images, "pattern_cam1_im{}.png", first=1)
            shutil.copy(scan.folder / "calibration.json", folder)
        case "scan3d":
            folder = lay_out(tmp_path / "images", scan.images, "cam_{:02}.png", first=1)
            values = [*scan.lenses[:2], of_cells(scan.lenses[2]), *scan.lenses[3:], np.eye(3)]
            opencv_file(folder / "calibration.yml", SCAN3D, values)
            words += ["--format", "scan3d"]
        case _:
            folder = lay_out(tmp_path / "images", scan.images, "frameSeq_{:02}.bmp")
            names = ("Kc", "kc", "Kp", "kp", "Rp", "Tp", "frameWidth", "frameHeight", "screenResX", "screenResY")
            opencv_file(tmp_path / "rig.xml", names, [*scan.lenses, 480, 384, 200, 160])
            words += ["--format", "slstudio", "--calibration", str(tmp_path / "rig.xml")]
    bundle = imported(folder, tmp_path / "bundle", *words)
    assert list(read_bundle(bundle).capture.patterns) == OWN[program]
    own = scan.folder if program == "opencv" else scan.in_the_cameras_frame(tmp_path / "own")
    report = reconstructed(own, tmp_path / "one")
    reconstructed(bundle, tmp_path / "other")
    assert (tmp_path / "one" / "mesh.ply").read_bytes() == (tmp_path / "other" / "mesh.ply").read_bytes()
    if program == "opencv":
        assert report["truth"]["rms_mm"] < 0.06


@pytest.mark.shared
@pytest.mark.slow
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
    given = [str(folder / word) if word.endswith(".json") else word for word in words]
    done = run(folder / "frames", "--output", tmp_path / "bundle", *given)
    assert done.exit_code == 0, done.output
    manual, found = read_bundle(folder), read_bundle(tmp_path / "bundle")
    assert found.capture.patterns == manual.capture.patterns
    assert found.capture.cameras == manual.capture.cameras
    for one, other in zip(found.capture.shots, manual.capture.shots, strict=True):
        assert one.pattern == other.pattern
        assert (one.image == other.image).all()
    assert (found.calibration is None) == (manual.calibration is None)


# ---- folders that tell by themselves what they show


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4, 8, 10, 18, 29, 37])
def test_a_rendered_folder_is_understood_without_an_option(seed: int, tmp_path: Path) -> None:
    folder, verdict = understand_folder_of(seed, tmp_path / "images")
    assert verdict in ("right", "named"), folder.kinds


def test_what_was_found_is_proposed_and_can_be_read_again(tmp_path: Path) -> None:
    shown = photographed("opencv")
    # The camera's name after the number, a time stamp before it, and all images one frame ahead.
    shown.append(shown.pop(0))
    folder = tmp_path / "images of a colleague"
    folder.mkdir()
    for number, image in enumerate(shown):
        assert cv2.imwrite(str(folder / f"20240511_{101500 + 7 * number}_{number:02}_left.png"), image)
    ask = (folder, "--projector", "200x160", "--output", tmp_path / "my bundle")
    refused = run(*ask)
    sheet = tmp_path / "my bundle-sheet.png"
    assert refused.exit_code == 2
    assert f"Check {sheet}; if it is right, add --yes" in " ".join(refused.stderr.split())
    assert cv2.imread(str(sheet)) is not None
    taken = run(*ask, "--yes", "--save-list", tmp_path / "list.csv")
    assert taken.exit_code == 0, taken.output
    assert f"slrig reconstruct '{tmp_path / 'my bundle'}' --output 'my bundle-mesh'" in taken.output
    again = imported(folder, tmp_path / "again", "--list", tmp_path / "list.csv")
    one, other = read_bundle(tmp_path / "my bundle").capture, read_bundle(again).capture
    assert set(one.patterns) == set(OWN["opencv"])
    assert one.patterns == other.patterns
    numbered = run(folder, "--projector", "200x160", "--output", tmp_path / "b", "--names", "*_{number}_{camera}.png")
    assert "camera left: 34 images" in numbered.output
    listed = run(folder, "--projector", "200x160", "--output", tmp_path / "c", "--format", "opencv")
    assert "34 cameras of one image each" in " ".join(listed.stderr.split())
