"""What the drivers say of their options: every one has a meaning, and no library of a vendor is loaded to learn it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from slrig.bundle.faults import checked
from slrig.errors import ConfigError
from slrig.option_models import described_drivers, kinds_of, option_model

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
    assert set(described_drivers("slrig")) == SHIPPED


@pytest.mark.parametrize("driver", sorted(SHIPPED))
def test_every_option_has_a_meaning_in_a_sentence(driver: str) -> None:
    model = option_model(driver)
    assert model is not None
    assert kinds_of(driver)
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
    ],
)
def test_every_fault_of_a_cameras_table_is_in_one_message(
    driver: str, table: dict[str, object], words: tuple[str, ...]
) -> None:
    model = option_model(driver)
    assert model is not None
    with pytest.raises(ConfigError) as refused:
        checked(model, table, "the table")
    assert [each for each in words if each not in str(refused.value)] == []


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


def test_no_vendors_library_is_needed() -> None:
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('depthai', 'gi', 'serial', 'sdl2')))\n"
        "from slrig.option_models import option_model\n"
        f"print(all(option_model(name) for name in {sorted(SHIPPED - {'simulated'})}), 'numba' in sys.modules)"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert shown.stdout == "True False\n"
