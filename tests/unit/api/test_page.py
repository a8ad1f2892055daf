"""/: the page of the service, what it may load, and that it holds what it names."""

from __future__ import annotations

import gzip
import hashlib
import json
import re
import shutil
import subprocess

import cv2
import numpy as np
import pytest

from slrig.api.rig import encoded, marked_picture
from slrig.api.system import FOLDER, policy
from tests.npm import lacking, npm_package
from tests.unit.api.conftest import ServedBench
from tests.unit.api.test_access import stranger

MOST_GZIPPED_BYTES = 600_000
_IMPORTED = re.compile(r"""(?:^|[\s;}])(?:import|export)\b[^"';]*?from\s*["']([^"']+)["']""", re.MULTILINE)


@pytest.mark.usefixtures("client")
def test_page_and_its_files_need_no_key(served: ServedBench) -> None:
    visitor = stranger(served)
    page = visitor.get("/")
    assert (page.status_code, page.headers["content-type"]) == (200, "text/html; charset=utf-8")
    for path in re.findall(r'(?:src|href)="([^"]+)"', page.text):
        assert path.startswith("/page/")
        assert visitor.get(path).status_code == 200
    for path in ("/page/", "/page/none-such.js", "/page/../api/keys.py", "/page/%2e%2e/api/keys.py", "/page/vendor"):
        assert visitor.get(path).status_code in {401, 404}, path
    assert visitor.get("/rig").status_code == 401


@pytest.mark.usefixtures("client")
def test_nothing_runs_but_what_the_service_sends(served: ServedBench) -> None:
    page = stranger(served).get("/")
    told = page.headers["Content-Security-Policy"]
    assert "unsafe" not in told
    assert "http" not in told
    assert "default-src 'none'" in told
    assert len(re.findall(r"'sha256-[\w+/=]+'", told)) == 1
    assert "sha256" not in policy('<script src="a.js"></script>')
    # Attributes that hold scripts or styles would be dropped by a browser without a word.
    assert re.findall(r"\s(?:on\w+|style)=", page.text) == []


@pytest.mark.usefixtures("client")
def test_files_of_the_page_are_packed_and_cached(served: ServedBench) -> None:
    visitor = stranger(served)
    first = visitor.get("/page/vendor/three.core.js")
    assert first.headers["Content-Encoding"] == "gzip"
    assert first.headers["Cache-Control"] == "no-cache"
    assert first.headers["X-Content-Type-Options"] == "nosniff"
    again = visitor.get("/page/vendor/three.core.js", headers={"If-None-Match": first.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_modules_import_what_is_there() -> None:
    imported = [
        (path, name) for path in FOLDER.glob("*.js") for name in _IMPORTED.findall(path.read_text(encoding="utf-8"))
    ]
    assert [
        (path.name, name)
        for path, name in imported
        if name != "three" and not (name.startswith("./") and (path.parent / name).is_file())
    ] == []


VENDORED = re.compile(
    r"^\| `(?P<file>[\w.-]+)` \| \[(?P<name>\w+) (?P<version>[\d.]+)\]\(https://registry\.npmjs\.org/(?P=name)/-/(?P=name)-"
    r"(?P=version)\.tgz\).* \| `(?P<source>[\w./]+)` \| `(?P<digest>\w{64})` \|$",
    re.MULTILINE,
)
ROWS = [each.groupdict() for each in VENDORED.finditer((FOLDER / "README.md").read_text(encoding="utf-8"))]


def test_vendored_files_are_those_that_the_readme_names() -> None:
    found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (FOLDER / "vendor").iterdir()}
    assert {row["file"]: row["digest"] for row in ROWS} == found
    licensed = {row["name"] for row in ROWS if row["file"] == f"LICENSE.{row['name']}.txt"}
    assert licensed == {row["name"] for row in ROWS}


@pytest.mark.slow
def test_vendored_files_are_those_that_npm_publishes() -> None:
    for row in ROWS:
        package = npm_package(f"{row['name']}@{row['version']}", "which slrig/page/vendor has files of")
        assert (package / row["source"]).read_bytes() == (FOLDER / "vendor" / row["file"]).read_bytes(), row["file"]


def test_the_page_is_small() -> None:
    files = [path for path in FOLDER.rglob("*") if path.suffix in {".js", ".css", ".html", ".svg"}]
    assert sum(len(gzip.compress(path.read_bytes(), 6)) for path in files) < MOST_GZIPPED_BYTES


WRITTEN = {
    "length(0.0123)": "12.3 µm", "length(-143.25)": "−143.3 mm", "length(1234.5)": "1 235 mm",
    "length(null)": "not known", "length(0)": "0 mm", "length(31.234, '% of baseline')": "31.2 % of baseline",
    "duration(0.012)": "12 ms", "duration(95.2)": "95.2 s",
    "duration(259200)": "3 days",
    "bytes(5.25e9)": "5.3 GB", "count(1234567)": "1 234 567", "percent(0)": "0 %", "percent(3.7e-5)": "< 0.01 %",
    "percent(0.9998)": "> 99.9 %", "percent(0.12345)": "12.3 %", "number(-1e-5, {decimals: 2})": "0.00",
    "weeks('2027-02')[0][0]": "2027-02-01", "weeks('2026-11').length": 6, "weeks('2026-11')[0].at(-1)": "2026-11-01",
    "cronOf({days: 'mon-fri', time: '06:30'})": "30 6 * * mon-fri", "when('30 6 * * mon-fri')": "Working days at 06:30",
    "cronOf({days: '1', time: '04:05'})": "5 4 1 * *", "when('*/5 * * * *')": "At */5 * * * *",
}  # fmt: skip


def test_numbers_and_times_are_written_for_people() -> None:
    node = shutil.which("node") or lacking("needs Node 18 or newer, to run the page's modules: apt install nodejs")
    modules = ", ".join(f"...await import('{(FOLDER / name).as_uri()}')" for name in ("ui.js", "schedule.js"))
    calls = ", ".join(f"page.{each}" for each in WRITTEN)
    program = f"const page = {{{modules}}}; console.log(JSON.stringify([{calls}]))"
    done = subprocess.run(  # noqa: S603 - our own program
        [node, "--input-type=module", "--eval", program], capture_output=True, text=True, check=True
    )
    # Narrow spaces, and those that keep a unit with its number.
    found = json.loads(re.sub(r"[\u202f\xa0]", " ", done.stdout))
    assert dict(zip(WRITTEN, found, strict=True)) == WRITTEN


def test_marks_are_on_what_is_saturated_and_in_light_on_what_is_dark() -> None:
    image = np.full((16, 30), 128, dtype=np.uint8)
    image[:, :10], image[:, 20:] = 255, 3
    lit, dark = marked_picture(image, lit=True), marked_picture(image, lit=False)
    assert (lit[:, 10:20] == 128).all()
    assert (lit[:, :10, 2] > lit[:, :10, 1] + 100).all()
    assert (lit[:, 20:, 0] > lit[:, 20:, 1] + 100).all()
    assert (dark[:, 20:] == 3).all()
    np.testing.assert_array_equal(dark[:, :20], lit[:, :20])
    decoded = cv2.imdecode(np.frombuffer(encoded(lit), dtype=np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert decoded.shape == (16, 30, 3)
    assert decoded[8, 4, 2] > 180 > decoded[8, 4, 1]
