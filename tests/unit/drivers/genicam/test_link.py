"""What limits a camera's frames on their way: the system's memory for USB, and the user's rights."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.genicam import link
from slrig.devices import Trigger
from slrig.errors import FrameTimeoutError
from tests.contract import gentl_bench
from tests.contract.genicam_bench import scene
from tests.contract.gentl_producer import MemoryCamera
from tests.contract.stage import Stage


@pytest.mark.parametrize(("memory_mb", "notes"), [("0", 0), ("10", 0), ("9", 1)])
def test_little_memory_for_usb_is_noted_with_the_command_that_gives_more(
    memory_mb: str, notes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usbfs = tmp_path / "usbfs_memory_mb"
    usbfs.write_text(f"{memory_mb}\n")
    monkeypatch.setattr(link, "USBFS", usbfs)
    # 32 frames of 640 x 480 bytes.
    with gentl_bench.serving(MemoryCamera(Stage(scene()), link="U3V")) as producer:
        camera = gentl_bench.opened(producer, region=None)
        camera.arm(1, Trigger.HARDWARE)
        with pytest.raises(FrameTimeoutError, match="check the trigger's cable") as late:
            camera.read(0, 0.0)
        camera.close()
    told = camera.info.notes
    assert len(told) == notes
    assert all("9 MB of the system" in note and f"sudo sh -c 'echo 1000 > {usbfs}'" in note for note in told)
    assert all(note in str(late.value) for note in told)


@pytest.mark.parametrize(("subclass", "permitted", "found"), [("05", False, 1), ("05", True, 0), ("02", False, 0)])
def test_a_usb3_vision_camera_that_the_user_may_not_open_is_listed_with_its_udev_rule(
    subclass: str, permitted: bool, found: int, tmp_path: Path
) -> None:
    told = {"idVendor": "2676", "manufacturer": "Basler", "product": "acA1300", "serial": "23A", "busnum": "2"}
    facts = {"1-2": {**told, "devnum": "7"}, "1-2:1.0": {"bInterfaceClass": "ef", "bInterfaceSubClass": subclass}}
    for device, each in facts.items():
        (tmp_path / "sys" / device).mkdir(parents=True)
        for name, text in each.items():
            (tmp_path / "sys" / device / name).write_text(f"{text}\n")
    if permitted:
        (tmp_path / "dev/002").mkdir(parents=True)
        (tmp_path / "dev/002/007").touch()
    devices = link.find_forbidden(tmp_path / "sys", tmp_path / "dev")
    assert [(each.driver, each.device) for each in devices] == [("genicam", "23A")] * found
    assert all('ATTR{idVendor}=="2676"' in each.label and "Basler acA1300 23A" in each.label for each in devices)
