"""A GLB of slrig's in programs of others: three.js in a browser, as on any page of the web, and Khronos' validator."""

from __future__ import annotations

import base64
import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Mesh
from slrig.scan.formats import encode_coarse_glb, encode_mesh_glb, encode_view_glb
from tests.npm import npm_package
from tests.unit.scan.test_mesh_formats import half_ball

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Route

pytestmark = pytest.mark.slow

# The camera of three.js looks along -z, with y up, and nothing here turns it: the page only steps back far enough.
PAGE = """<!doctype html>
<canvas width="480" height="360"></canvas>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
const THREE = await import("three");
const {GLTFLoader} = await import("/three/examples/jsm/loaders/GLTFLoader.js");
const canvas = document.querySelector("canvas");
const renderer = new THREE.WebGLRenderer({canvas, alpha: true, preserveDrawingBuffer: true});
const scene = new THREE.Scene();
scene.add((await new GLTFLoader().loadAsync("/mesh.glb")).scene);
const box = new THREE.Box3().setFromObject(scene, true);
const size = box.getSize(new THREE.Vector3()).length();
const camera = new THREE.PerspectiveCamera(30, canvas.width / canvas.height, size / 100, size * 100);
camera.position.copy(box.getCenter(new THREE.Vector3())).add(new THREE.Vector3(0, 0, 2 * size));
const light = new THREE.DirectionalLight(0xffffff, 2);
light.position.set(0, 0, 1);
scene.add(light);
renderer.render(scene, camera);
window.found = {picture: canvas.toDataURL("image/png"), least_m: box.min.toArray(), most_m: box.max.toArray()};
</script>
"""

CENTRE_MM = np.array([3.0, -4.0, 500.0])
"""Of a dome of radius 50 mm that looks along -z, towards the camera that scanned it."""

TO_GLTF = np.array([0.001, -0.001, -0.001])
"""Camera axes in mm (x right, y down, z away) to glTF's in m (x right, y up, z towards the viewer)."""


def two_shades() -> Mesh:
    """The dome as a camera sees it: dark on the left and bright on the right, its lower right quarter missing."""
    mesh = half_ball(60, 160)
    right, low = (mesh.vertices_mm - CENTRE_MM)[:, :2].T > 0
    missing = (right & low)[mesh.faces].all(axis=1)
    shade = np.where(right, 230, 60).astype(np.uint8)
    return replace(mesh, colour=np.repeat(shade[:, None], 3, axis=1), faces=mesh.faces[~missing])


def assert_upright_and_from_the_front(shown: NDArray[np.uint8]) -> None:
    """A picture, (H, W, 4) uint8, shows `two_shades` as the camera that scanned it did."""
    opaque, light = shown[..., 3] > 127, shown[..., :3].mean(axis=2)
    rows, columns = np.nonzero(opaque)
    top, bottom, left, right = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
    # The whole of it is shown, in the middle, large enough to be looked at.
    assert 0 < top < bottom < shown.shape[0]
    assert 0 < left < right < shown.shape[1]
    assert bottom - top > shown.shape[0] / 4
    middle, centre = (top + bottom) // 2, (left + right) // 2
    quarters = {
        "upper left": np.s_[top : middle - 3, left : centre - 3],
        "upper right": np.s_[top : middle - 3, centre + 3 : right],
        "lower left": np.s_[middle + 3 : bottom, left : centre - 3],
        "lower right": np.s_[middle + 3 : bottom, centre + 3 : right],
    }
    covered = {name: opaque[quarter].mean() for name, quarter in quarters.items()}
    shade = {name: light[quarter][opaque[quarter]].mean() for name, quarter in quarters.items() if covered[name] > 0.5}
    assert covered.pop("lower right") < 0.05
    assert min(covered.values()) > 0.65, covered
    assert max(shade["upper left"], shade["lower left"]) < 0.7 * shade["upper right"], shade


@pytest.mark.parametrize("encode", [encode_mesh_glb, encode_view_glb])
def test_three_js_shows_the_side_that_was_scanned_upright_and_in_metres(
    tmp_path: Path, browser: Browser, encode: Callable[[Mesh], bytes]
) -> None:
    mesh = two_shades()
    (tmp_path / "three").symlink_to(npm_package("three@0.187.0", "to show a GLB on a page"))
    (tmp_path / "index.html").write_text(PAGE, encoding="utf-8")
    (tmp_path / "mesh.glb").write_bytes(encode(mesh))

    def answered(route: Route) -> None:
        route.fulfill(path=tmp_path / (urlsplit(route.request.url).path.strip("/") or "index.html"))

    page = browser.new_page()
    try:
        page.route("http://viewer.example/**", answered)
        page.goto("http://viewer.example/")
        page.wait_for_function("window.found")
        found: dict[str, Any] = page.evaluate("window.found")
    finally:
        page.close()
    png = np.frombuffer(base64.b64decode(found["picture"].partition(",")[2]), dtype=np.uint8)
    assert_upright_and_from_the_front(np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED), dtype=np.uint8))
    placed_m = mesh.vertices_mm[np.unique(mesh.faces)] * TO_GLTF
    np.testing.assert_allclose(found["least_m"], placed_m.min(axis=0), rtol=0, atol=1e-6)
    np.testing.assert_allclose(found["most_m"], placed_m.max(axis=0), rtol=0, atol=1e-6)


# Prints what the validator finds in files.
VALIDATE = """
const validator = require(process.argv[1]), {readFileSync} = require("fs");
Promise.all(process.argv.slice(2).map((path) => validator.validateBytes(new Uint8Array(readFileSync(path)))))
  .then((reports) => console.log(JSON.stringify(reports.map(({issues}) => issues))));
"""


def test_the_validator_of_the_format_finds_nothing(tmp_path: Path) -> None:
    package = npm_package("gltf-validator@2.0.0-dev.3.10", "to validate a GLB")
    mesh = two_shades()
    meshes = [mesh, half_ball(200, 200), replace(mesh, faces=mesh.faces[:1]), replace(mesh, faces=mesh.faces[:0])]
    encoders = (encode_mesh_glb, encode_view_glb, encode_coarse_glb)
    paths = [str(tmp_path / f"{each}.glb") for each in range(len(meshes) * len(encoders))]
    for path, (encode, shape) in zip(paths, product(encoders, meshes), strict=True):
        Path(path).write_bytes(encode(shape))
    command = ["node", "-e", VALIDATE, str(package), *paths]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)  # noqa: S603
    assert [issues["messages"] for issues in found] == [[]] * len(paths)
