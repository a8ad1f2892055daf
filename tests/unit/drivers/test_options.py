"""What drivers say of their options, and of a library that is missing, old, or cannot be loaded."""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers import depthai, genicam, picamera2, serial_projector
from drivers.depthai.library import ENVIRONMENT, load_depthai
from drivers.genicam.aravis import install_command
from drivers.genicam.aravis import load_aravis as aravis
from drivers.genicam.gentl import load_harvesters
from slrig.bundle.validation import validate
from slrig.discovery import driver_kinds, drivers_with_options, option_model
from slrig.errors import ConfigError, LibraryMissingError

SHIPPED = {
    *("depthai", "genicam", "gentl", "opencv", "picamera2", "v4l2"),
    *("dlpc347x", "dlpc350", "dlpc900", "kms", "screen", "serial_projector"),
    *("grbl_turntable", "serial_turntable"),
    *("replay", "simulated"),
}


def properties(schema: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for table in (schema, *schema.get("$defs", {}).values()):
        yield from table.get("properties", {}).items()


def test_every_driver_of_slrig_describes_its_options() -> None:
    assert set(drivers_with_options("slrig")) == SHIPPED


@pytest.mark.parametrize("driver", sorted(SHIPPED))
def test_every_option_has_a_meaning_in_a_sentence(driver: str) -> None:
    model = option_model(driver)
    assert model is not None
    told = dict(properties(model.model_json_schema()))
    assert told
    for name, part in told.items():
        assert len(part.get("description", "")) > 5, name
        assert part["description"].endswith((".", ")")), name


@pytest.mark.parametrize(
    ("driver", "table", "words"),
    [
        (
            "v4l2",
            {"pixel_format": "H264", "size_px": [640], "fokus": 3, "frame_rate_hz": -1},
            ("device: missing", "'H264'", "size_px", "did you mean 'focus'?", "frame_rate_hz"),
        ),
        (
            "genicam",
            {"devise": "GV01", "region": {"width_px": 0, "height_px": 10}, "time_stamp": "sometimes", "transfer_s": -1},
            ("device: missing", "did you mean 'device'", "region.width_px", "time_stamp", "transfer_s"),
        ),
        (
            "depthai",
            {"socket": "left", "fsp": 3, "fps": 0, "focus": 300},
            ("device: missing", "'CAM_A'", "fsp: unknown key; did you mean 'fps'", "fps: ", "focus: "),
        ),
        (
            "dlpc350",
            {"patern": "p", "led": "ultraviolet", "hold_s": 1.0, "trigger_delay_us": 5.0},
            ("patern: unknown key; did you mean 'patterns'?", "patterns: missing", "led: ", "hold_s: ", "5.0"),
        ),
        ("kms", {"outputs": "A", "refresh_hz": 0, "display": ":0"}, ("output: missing", "refresh_hz", "display")),
        (
            "serial_projector",
            {"port": "", "baud": 1, "watchdog": 1.0, "max_duty": 2.0},
            ("port", "baud", "did you mean 'watchdog_s'?", "max_duty"),
        ),
        (
            "grbl_turntable",
            {"axis": "W", "sped_deg_s": 3.0, "units_per_deg": 0.0},
            ("port", "axis", "sped_deg_s", "units_per_deg"),
        ),
    ],
)
def test_every_fault_of_a_table_is_in_one_message(
    driver: str, table: dict[str, object], words: tuple[str, ...]
) -> None:
    model = option_model(driver)
    assert model is not None
    with pytest.raises(ConfigError) as refused:
        validate(model, table, "the table")
    assert [each for each in words if each not in str(refused.value)] == []


@pytest.mark.parametrize("driver", sorted(SHIPPED))
def test_a_driver_opens_nothing_by_a_wrong_table(driver: str) -> None:
    for kind in driver_kinds(driver):
        (entry,) = importlib.metadata.entry_points(group=f"slrig.{kind}s", name=driver)
        with pytest.raises(ConfigError, match="colour: unknown key"):
            entry.load()(*["left"] * (kind == "camera"), {"colour": "none such"}, Path())


def test_a_finders_id_is_taken_by_device_or_by_what_a_model_marks() -> None:
    marked = {
        driver: [name for name, part in properties(model.model_json_schema()) if part.get("takes") == "device"]
        for driver in SHIPPED
        if (model := option_model(driver)) is not None
    }
    assert {driver: names for driver, names in marked.items() if names} == {
        "grbl_turntable": ["port"],
        "kms": ["output"],
        "screen": ["output"],
        "serial_projector": ["port"],
        "serial_turntable": ["port"],
    }


@pytest.mark.slow
def test_no_vendors_library_is_needed() -> None:
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('depthai', 'gi', 'serial', 'sdl2')))\n"
        "from slrig.discovery import option_model\n"
        f"print(all(option_model(name) for name in {sorted(SHIPPED - {'simulated'})}), 'numba' in sys.modules)"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert shown.stdout == "True False\n"


OAK = {"device": "14442C10D13EABCE00", "socket": "CAM_B"}
LOADED = (aravis, load_harvesters)
ARAVIS: tuple[Callable[[], object], ...] = (
    genicam.find_devices,
    lambda: genicam.open_camera("left", {"device": "x"}, Path()),
)
MISSING: list[tuple[str, tuple[Callable[[], object], ...], str, str]] = [
    (
        "depthai",
        (
            depthai.find_devices,
            lambda: depthai.open_camera("left", OAK, Path()),
            lambda: depthai.read_calibration(OAK["device"]),
        ),
        "not installed",
        "pip install 'slrig[depthai]'",
    ),
    ("gi", ARAVIS, "Aravis", install_command()),
    ("gi.repository.Aravis", ARAVIS, "Aravis", install_command()),
    (
        "picamera2",
        (picamera2.find_devices, lambda: picamera2.open_camera("left", {"device": "x"}, Path())),
        "--system-site-packages",
        "sudo apt install python3-libcamera python3-kms++ libcap-dev && pip install --upgrade simplejpeg "
        "'slrig[picamera2]'",
    ),
    (
        "harvesters.core",
        (genicam.find_gentl_devices, lambda: genicam.open_gentl_camera("left", {"device": "x"}, Path())),
        "harvesters",
        "pip install 'slrig[gentl]'",
    ),
    (
        "serial",
        (serial_projector.find_devices, lambda: serial_projector.open_projector({"port": "/dev/ttyACM0"}, Path())),
        "not installed",
        "pip install 'slrig[serial]'",
    ),
]


@pytest.mark.parametrize(("module", "calls", "words", "install"), MISSING, ids=[each[0] for each in MISSING])
def test_a_missing_library_is_named_with_the_command_that_installs_it(
    module: str, calls: tuple[Callable[[], object], ...], words: str, install: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if module.startswith("gi."):
        pytest.importorskip("gi", reason="PyGObject is not installed")
    for loaded in LOADED:
        loaded.cache_clear()
    # None in this table makes an import fail, as a package that is not installed does.
    for name in {module, *(name for name in sys.modules if name.startswith(f"{module}."))}:
        monkeypatch.setitem(sys.modules, name, None)
    for call in calls:
        with pytest.raises(LibraryMissingError, match=words) as missing:
            call()
        assert missing.value.install == install


def test_an_old_library_is_named_with_its_version(monkeypatch: pytest.MonkeyPatch) -> None:
    old = types.ModuleType("depthai")
    old.__dict__.update(__version__="2.30.0", Pipeline=object, __spec__=types.SimpleNamespace())
    monkeypatch.setitem(sys.modules, "depthai", old)
    with pytest.raises(LibraryMissingError, match=r"need depthai 3.12 or later, found 2.30.0"):
        depthai.find_devices()


def test_depthai_reports_nothing_to_its_maker_unless_the_user_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    new = types.ModuleType("depthai")
    pipeline = types.SimpleNamespace(setStopOnDeviceLoss=None)
    new.__dict__.update(__version__="3.12.0", Pipeline=pipeline, __spec__=types.SimpleNamespace())
    monkeypatch.setitem(sys.modules, "depthai", new)
    for variable in ENVIRONMENT:
        # Set, then gone: so that it is restored afterwards, whatever happens to it here.
        monkeypatch.setenv(variable, "")
        monkeypatch.delenv(variable)
    monkeypatch.setenv("DEPTHAI_LEVEL", "debug")
    assert load_depthai() is new
    assert os.environ["DEPTHAI_TELEMETRY"] == "0"
    assert os.environ["DEPTHAI_DISABLE_STARTUP_NOTIFICATIONS"] == "1"
    assert os.environ["DEPTHAI_LEVEL"] == "debug"


@pytest.mark.parametrize(
    ("module", "calls", "install"),
    [
        (module.split(".")[0], calls, install)
        for module, calls, _, install in MISSING
        if module != "gi.repository.Aravis"
    ],
    ids=[each[0] for each in MISSING if each[0] != "gi.repository.Aravis"],
)
def test_a_library_that_was_built_for_others_is_named_with_the_command_that_builds_it_anew(
    module: str, calls: tuple[Callable[[], object], ...], install: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for loaded in LOADED:
        loaded.cache_clear()
    cause = "numpy.dtype size changed, may indicate binary incompatibility"
    (tmp_path / f"{module}.py").write_text(f"raise ValueError({cause!r})")
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    for call in calls:
        with pytest.raises(LibraryMissingError, match=f"installed and cannot be loaded.*ValueError: {cause}") as broken:
            call()
        assert broken.value.install.startswith(f"{install} && pip install --force-reinstall")
