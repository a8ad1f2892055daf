"""A scan's result as a person looks at it: the mesh, what is measured on it, why pixels are missing, its files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slrig.model import FloatArray, Refusal
from tests.e2e.conftest import SLOW, ServiceProcess, scanned, serving, write_rig
from tests.e2e.page.conftest import PHONE, Visit, count, fits, violations
from tests.e2e.page.golden import looks_as_kept

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.slow

# Of tests.e2e.conftest: where the plate, the camera and what it looks at are.
PLATE_NORMAL: FloatArray = Rotation.from_euler("xyz", (8.0, -12.0, 0.0), degrees=True).as_matrix()[:, 2]
EYE_MM: FloatArray = np.array((-150.0, -12.0, -560.0))
HALF_FIELD = np.tan(np.radians(15))
BAR_PX = 60
"""What stands over the mesh at its upper and lower edge is less high."""


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    folder = tmp_path_factory.mktemp("results")
    with serving(write_rig(folder / "rig", head=SLOW), folder / "data") as service:
        yield service


def on_plate(right: float, down: float) -> FloatArray:
    """Where on the plate, mm, the view from the camera looks, in half heights of the picture from its middle."""
    forward = -EYE_MM / np.linalg.norm(EYE_MM)
    sideways = np.cross((0.0, 1.0, 0.0), forward)
    sideways /= np.linalg.norm(sideways)
    ray = forward + HALF_FIELD * (right * sideways + down * np.cross(forward, sideways))
    return np.asarray(EYE_MM - ray * (EYE_MM @ PLATE_NORMAL) / (ray @ PLATE_NORMAL))


def picture(page: Page) -> NDArray[np.uint8]:
    """(H, W, 3) uint8, blue, green, red: the mesh between the bars, once it stands still and is whole."""
    page.wait_for_timeout(600)
    page.locator("canvas[data-level=full]").wait_for()
    shot = page.locator("canvas").screenshot()
    decoded = cv2.imdecode(np.frombuffer(shot, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded[BAR_PX:-BAR_PX], dtype=np.uint8)


def plainly(text: str | None) -> str:
    """A text of the page with ordinary spaces and minus signs."""
    return (text or "").replace("\u00a0", " ").replace("\u202f", "").replace("−", "-")


def orange(shown: NDArray[np.uint8]) -> float:
    return float((shown[..., 2].astype(int) - shown[..., 0] > 60).mean())


def measured(page: Page, right: float, down: float) -> None:
    """Click on the mesh, in half heights of the picture from its middle."""
    box = page.locator("canvas").bounding_box()
    assert box is not None
    x, y = (box["width"] + right * box["height"]) / 2, (1 + down) * box["height"] / 2
    page.locator("canvas").click(position={"x": x, "y": y})


def test_a_result_is_looked_at_measured_compared_and_downloaded(service: ServiceProcess, visit: Visit) -> None:
    with service.client() as client:
        first, scan = (scanned(client)["links"]["self"] for _ in range(2))
    folder = service.data / "scans" / scan.rpartition("/")[2]
    report = json.loads((folder / "report.json").read_text())
    page = visit(service, scan[1:], size=(1280, 1100), ignored="404")
    plain = picture(page)
    page.get_by_text(f"{report['mesh']['figures']['triangles']:,} triangles.".replace(",", " ")).wait_for()
    assert (plain != plain[0, 0]).any(axis=2).mean() > 0.3
    looks_as_kept(page, "result")

    page.get_by_role("button", name="Stripe").click()
    page.get_by_text(f"{report['frames']['projector_px'][0]} px").wait_for()
    coloured = picture(page)
    looks_as_kept(page, "result-stripe")
    row = coloured[len(coloured) // 2]
    shown = np.flatnonzero((row != coloured[0, 0]).any(axis=1))[10:-10]
    greens = [float(part.mean()) for part in np.array_split(row[shown, 1].astype(float), 6)]
    assert all(before < after for before, after in pairwise(greens)), greens
    page.get_by_role("button", name="σ").click()
    page.get_by_text(f"{report['mesh']['sigma_mm']['p95']:.3g} mm").wait_for()
    assert (picture(page) != coloured).any()
    page.get_by_role("button", name="Albedo").click()
    albedo = picture(page)[300:-300, 300:-300]
    assert (albedo[..., 0] == albedo[..., 2]).mean() > 0.9, "a grey plate"

    # Truth is the plate's own geometry: the camera looks at its middle.
    page.get_by_role("button", name="From left").click()
    page.get_by_role("button", name="Measure").click()
    page.locator("canvas").focus()
    page.keyboard.press("Enter")
    measured(page, 0.12, -0.1)
    line = plainly(page.locator(".stage text", has_text=re.compile("mm, σ")).first.text_content())
    cells = [plainly(each) for each in page.locator(".measured tbody td").all_inner_texts()]
    points = np.array(
        [[float(mm.replace("−", "-")) for mm in at.split(", ")] for at in re.findall(r"\((.*?)\)", cells[3])]
    )
    expected = np.array((on_plate(0.0, 0.0), on_plate(0.12, -0.1)))
    assert np.abs((points - expected) @ PLATE_NORMAL).max() < 0.1
    # A click is right to a pixel of the screen, half a millimetre of the plate.
    assert np.linalg.norm(points - expected, axis=1).max() < 0.6
    distance_mm = float(np.linalg.norm(points[1] - points[0]))
    assert float(cells[1].removesuffix(" mm")) == pytest.approx(distance_mm, abs=0.006)
    assert distance_mm == pytest.approx(np.linalg.norm(expected[1] - expected[0]), abs=0.8)
    assert line == f"{cells[1]}, σ {cells[2]}", "the figure stands at the line"
    sigma = re.fullmatch(r"([\d.]+) µm", cells[2])
    assert sigma is not None
    assert 1.0 < float(sigma[1]) / 1000 / report["mesh"]["sigma_mm"]["p50"] < 3.0
    page.get_by_role("button", name="Point to plane").click()
    for right in (-0.1, 0.1):
        measured(page, right, 0.05)
    row = page.get_by_role("row", name="Point to plane")
    assert float(plainly(row.get_by_role("cell").nth(1).inner_text()).removesuffix(" mm")) < 0.1, "the plate is flat"
    assert violations(page) == []
    page.keyboard.press("m")
    page.get_by_role("button", name="Clear").click()

    # The middle of the mesh, seen from the camera, is what the middle of its picture shows.
    stage, area = page.locator("canvas"), page.locator(".causes")
    stage.hover()
    told = page.get_by_text(re.compile(r"Column \d+, row \d+: measured")).inner_text()
    assert [int(each) for each in re.findall(r"\d+", told)] == pytest.approx([119.5, 95.5], abs=2)
    area.hover()
    box, ring = stage.bounding_box(), page.locator(".pointed").bounding_box()
    assert box is not None
    assert ring is not None
    middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
    assert [ring["x"] + ring["width"] / 2, ring["y"] + ring["height"] / 2] == pytest.approx(middle, abs=6)

    causes = cv2.imread(str(folder / "causes-left.png"), cv2.IMREAD_UNCHANGED)
    assert causes is not None
    for cause, words in ((Refusal.NONE, "measured"), (Refusal.NOT_LIT, "refused: no light, or too little")):
        rows, columns = np.nonzero(causes == cause)
        row_px, column_px = rows[len(rows) // 2], columns[len(columns) // 2]
        box = area.bounding_box()
        assert box is not None
        area.hover(
            position={
                "x": (column_px + 0.5) * box["width"] / causes.shape[1],
                "y": (row_px + 0.5) * box["height"] / causes.shape[0],
            }
        )
        page.get_by_text(f"Column {column_px}, row {row_px}: {words}").wait_for()

    page.get_by_role("button", name="Download").click()
    page.get_by_role("listitem").filter(has_text="mesh.ply").get_by_text("MB").wait_for()
    with page.expect_download() as download:
        page.get_by_role("link", name="mesh.ply").click()
    page.keyboard.press("Escape")
    assert Path(download.value.path()).read_bytes() == (folder / "mesh.ply").read_bytes()

    page.get_by_label("with").select_option(first.rpartition("/")[2])
    page.get_by_text(re.compile(r"Other scan: [\d\s]+ triangles")).wait_for()
    mine, theirs = (
        json.loads((service.data / "scans" / path.rpartition("/")[2] / "report.json").read_text())["mesh"]["figures"]
        for path in (scan, first)
    )
    difference = theirs["triangles"] - mine["triangles"]
    written = f"{'−' if difference < 0 else '+'}{abs(difference):,}".replace(",", " ")
    page.get_by_role("row", name="Triangles").get_by_role("cell", name=written, exact=True).wait_for()
    # Two scans of one thing differ by noise: the legend reaches no further than a few standard deviations.
    page.get_by_role("button", name="Deviation").click()
    far = re.search(r"95 % within ([\d.]+) µm", plainly(page.get_by_text("Half lie within").inner_text()))
    assert far is not None
    assert float(far[1]) / 1000 < 6 * report["mesh"]["sigma_mm"]["p50"]
    page.get_by_role("button", name="Shaded").click()
    page.locator("canvas").focus()
    page.keyboard.press("b")
    assert orange(picture(page)) < 0.001
    page.keyboard.press("b")
    assert orange(picture(page)) > 0.05
    page.keyboard.press("ArrowLeft")
    assert violations(page) == []

    page.set_viewport_size({"width": 1440, "height": 900})
    page.keyboard.press("r")
    page.keyboard.press("?")
    page.get_by_role("dialog", name="Keys").get_by_text("Full screen, and back").wait_for()
    assert violations(page) == []
    page.keyboard.press("Escape")
    drawn, area_px = picture(page), page.locator(".stage").bounding_box()
    assert area_px is not None
    assert area_px["width"] * area_px["height"] >= 0.65 * 1440 * 900
    across, down = (np.flatnonzero((line != drawn[0, 0]).any(axis=1)) for line in (drawn[390], drawn[:, 540]))
    assert max(np.ptp(across) / area_px["width"], np.ptp(down) / area_px["height"]) >= 0.8
    page.keyboard.press("t")
    count(page.get_by_role("complementary"), 0)
    page.keyboard.press("t")

    with service.client() as client:
        client.delete(scan)
    page.get_by_text("It was deleted, or the address is not right.").wait_for()


def test_the_region_of_a_scan_is_named_and_drawn(service: ServiceProcess, visit: Visit) -> None:
    region = {"box_mm": [[-20, -25, -40], [20, 15, 40]], "min_contrast": 0.02}
    with service.client() as client:
        scan = scanned(client, reconstruction={"region": region})
    assert scan["state"] == "succeeded", scan
    page = visit(service, scan["links"]["self"][1:], size=(1280, 1100), ignored="status of 4")
    page.get_by_text("a box, x -20 to 20, y -25 to 15, z -40 to 40 mm; contrasts above 2 %").wait_for()
    page.get_by_text("outside the region that the scan was asked for").wait_for()
    page.get_by_role("button", name="Front").click()
    shown = picture(page).astype(int)
    # The lines are blue, and a grey plate is not.
    assert ((shown[..., 0] - shown[..., 2]) > 100).sum() > 200

    # The next scan's region is the part in view, with what the person types.
    page.get_by_role("button", name="Limit the next scan to this view").click()
    page.get_by_label("Nearest depth, mm").fill("900")
    page.get_by_label("Farthest depth, mm").fill("300")
    page.get_by_role("button", name="Scan", exact=True).click()
    page.get_by_role("alert").get_by_text("region.depth_mm: expected two rising numbers").wait_for()
    page.get_by_label("Nearest depth, mm").fill("100")
    page.get_by_label("Farthest depth, mm").fill("1000")
    page.get_by_label("Least contrast, %").fill("4")
    page.get_by_label("Greatest σ, mm").fill("0.5")
    page.get_by_text(
        re.compile(
            r"a box, x -20 to 20, y -25 to 15, z .* mm; depths of 100 to 1000 mm; contrasts above 4\s%; σ up to 0.5\smm"
        )
    ).wait_for()
    assert violations(page) == []
    page.get_by_role("button", name="Scan", exact=True).click()
    page.wait_for_url("**/#/scan/*-*")
    with service.client() as client:
        region_sent = client.get(page.url.rpartition("#")[2])["plan"]["reconstruction"]["region"]
    least, most = region_sent["box_mm"]
    assert (region_sent["depth_mm"], region_sent["min_contrast"], region_sent["max_sigma_mm"]) == (
        [100, 1000],
        0.04,
        0.5,
    )
    assert (least[:2], most[:2]) == ([-20, -25], [20, 15])
    assert -40 < least[2] < most[2] < 40, "no further than the surface"
    page.go_back()
    page.get_by_role("button", name="Without the box").click()
    count(page.get_by_text("a box"), 0)


def test_a_scan_without_a_mesh_says_why_and_what_next(service: ServiceProcess, visit: Visit) -> None:
    with service.client() as client:
        scan: str = client.scans.start(label="a wrong one")["links"]["self"]
    page = visit(service, scan[1:], size=PHONE, dark=True)
    page.get_by_role("button", name="Stop it").click()
    page.get_by_text("The scan was stopped").wait_for()
    count(page.get_by_role("link", name="mesh.ply"), 0)
    fits(page)
    page.get_by_role("button", name="Scan again").click()
    page.wait_for_url(re.compile(r"#/scan$"))
    # The result shows itself as soon as there is a mesh, while the rest is computed.
    page.wait_for_url(re.compile(r"#/scan/.+"))
    page.locator("canvas[data-level=full]").wait_for()
    fits(page)
    page.get_by_role("button", name="Pin").click()
    page.get_by_role("button", name="Unpin").wait_for()
    page.get_by_role("button", name="Delete").click()
    page.get_by_role("button", name="Delete it").click()
    page.get_by_text("Recent scans").wait_for()
