"""three.js in a browser without a window: a page like those that show a GLB on the web, served on loopback."""

from __future__ import annotations

import base64
import json
import os
import queue
import shutil
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.e2e.conftest import BROWSERS
from tests.npm import lacking, npm_package

PACKAGE = "three@0.187.0"
_LIMIT_S = 120.0
# Drawn by the processor; nothing is looked for on the network.
_OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--disable-dev-shm-usage",
)  # fmt: skip

# The camera of three.js looks along -z, with y up, and nothing here turns it: the page only steps back far enough.
_PAGE = """<!doctype html>
<canvas width="480" height="360"></canvas>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js"}}</script>
<script type="module">
const tell = (found) => fetch("/found", {method: "POST", body: JSON.stringify(found)});
try {
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
  await tell({picture: canvas.toDataURL("image/png"), least_m: box.min.toArray(), most_m: box.max.toArray()});
} catch (error) {
  await tell({error: `${error}\\n${error.stack}`});
}
</script>
"""


@dataclass(frozen=True, slots=True)
class Shown:
    """What the page drew, and the axis-aligned box in which three.js places the model.

    picture : (360, 480, 4) uint8, blue, green, red, opacity. least_m, most_m : (3,) float64.
    """

    picture: NDArray[np.uint8]
    least_m: NDArray[np.float64]
    most_m: NDArray[np.float64]


class _Page(SimpleHTTPRequestHandler):
    """Serves a folder, and takes what the page tells."""

    def __init__(self, *args: Any, found: queue.Queue[dict[str, Any]], **options: Any) -> None:
        self._found = found
        super().__init__(*args, **options)

    def do_POST(self) -> None:
        self._found.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Say nothing for each request."""


def three_js(model: bytes, folder: Path) -> Shown:
    """Show a GLB. Skips without a browser or three.js, and fails if CI=true."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        lacking("needs Chromium, to show a GLB on a page: apt install chromium")
    site = folder / "site"
    site.mkdir(parents=True)
    (site / "three").symlink_to(npm_package(PACKAGE, "to show a GLB on a page"))
    (site / "index.html").write_text(_PAGE, encoding="utf-8")
    (site / "mesh.glb").write_bytes(model)
    found: queue.Queue[dict[str, Any]] = queue.Queue()
    log = folder / "browser.log"
    with _served(site, found) as url, _browser(browser, url, folder / "profile", log):
        try:
            told = found.get(timeout=_LIMIT_S)
        except queue.Empty:
            told = {"error": f"the page told nothing in {_LIMIT_S:g} s; the browser: {log.read_text()[-3000:]}"}
    assert "error" not in told, told["error"]
    png = base64.b64decode(told["picture"].partition(",")[2])
    picture = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    (folder / "picture.png").write_bytes(png)
    return Shown(np.asarray(picture, dtype=np.uint8), np.array(told["least_m"]), np.array(told["most_m"]))


@contextmanager
def _served(site: Path, found: queue.Queue[dict[str, Any]]) -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Page, found=found, directory=str(site))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/"
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def _browser(browser: str, url: str, profile: Path, log: Path) -> Iterator[None]:
    """A browser with an empty profile on one page; it and its processes are ended with the block."""
    with log.open("wb") as output:
        process = subprocess.Popen(  # noqa: S603 - a browser from the system's own packages
            [browser, *_OPTIONS, f"--user-data-dir={profile}", url],
            env={**os.environ, "HOME": str(profile.parent)},
            stdout=output, stderr=output, start_new_session=True,
        )  # fmt: skip
    try:
        yield
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
