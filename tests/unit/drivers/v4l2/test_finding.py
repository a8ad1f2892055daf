"""Names of cameras: stable, and never one for two."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.v4l2.finding import NodeIdentity, list_nodes, probe_node, resolve_node
from slrig.errors import DeviceGoneError


class Machine:
    """A tree like /sys and /dev, with cameras plugged in."""

    def __init__(self, root: Path) -> None:
        self.sysfs, self.dev = root / "sys" / "class" / "video4linux", root / "dev"
        self.sysfs.mkdir(parents=True)
        self.devices = root / "sys" / "devices"
        self.identities: dict[str, NodeIdentity | None] = {}

    def plug(
        self,
        name: str,
        *,
        port: str = "1-2",
        serial: str | None = None,
        index: int = 0,
        captures: bool = True,
        **more: str,
    ) -> None:
        usb = self.devices / port
        folder = usb / f"{port}:1.0" / "video4linux" / name
        folder.mkdir(parents=True)
        (folder / "index").write_text(f"{index}\n")
        (folder / "name").write_text("Bench camera\n")
        if port[0].isdigit():
            (usb / "idVendor").write_text("046d\n")
            (usb / "idProduct").write_text("0825\n")
            if serial is not None:
                (usb / "serial").write_text(f"{serial}\n")
        (self.sysfs / name).symlink_to(folder)
        self.dev.mkdir(exist_ok=True)
        (self.dev / name).touch()
        self.identities[name] = NodeIdentity("Bench camera", more.get("bus", f"usb-{port}"), captures)
        for kind in ("id", "path"):
            if f"by_{kind}" in more:
                link = self.dev / "v4l" / f"by-{kind}" / more[f"by_{kind}"]
                link.parent.mkdir(parents=True, exist_ok=True)
                link.unlink(missing_ok=True)
                link.symlink_to(self.dev / name)

    def ask(self, path: Path) -> NodeIdentity | None:
        return self.identities[path.name]

    def names(self) -> list[str]:
        return [node.name for node in list_nodes(self.sysfs, self.dev, self.ask)]

    def resolved(self, device: str) -> Path:
        return resolve_node(device, self.dev, lambda: list_nodes(self.sysfs, self.dev, self.ask)).path


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


BY_ID = "usb-046d_0825_ABC-video-index0"
BY_PATH = "pci-0000:00:14.0-usb-0:2:1.0-video-index0"


def test_a_serial_number_gives_a_name_that_goes_with_the_camera(machine: Machine) -> None:
    machine.plug("video0", serial="ABC", by_id=BY_ID, by_path=BY_PATH)
    machine.plug("video1", serial="ABC", index=1, captures=False)
    assert machine.names() == [BY_ID]
    # Either of udev's names may be written, and paths.
    for device in (BY_ID, BY_PATH, str(machine.dev / "video0"), str(machine.dev / "v4l" / "by-path" / BY_PATH)):
        assert machine.resolved(device) == machine.dev / "video0"


def test_without_a_serial_number_the_port_gives_the_name(machine: Machine) -> None:
    # udev gives both cameras the same by-id name, and the last one plugged in has it.
    machine.plug("video0", port="1-2", by_id="usb-046d_0825-video-index0", by_path="pci-usb-0:2:1.0-video-index0")
    machine.plug("video2", port="1-3", by_id="usb-046d_0825-video-index0", by_path="pci-usb-0:3:1.0-video-index0")
    assert machine.names() == ["pci-usb-0:2:1.0-video-index0", "pci-usb-0:3:1.0-video-index0"]


def test_cameras_that_share_a_serial_number_are_named_by_their_port(machine: Machine) -> None:
    machine.plug("video0", port="1-2", serial="0001", by_id="usb-x_0001-video-index0", by_path="pci-2-video-index0")
    machine.plug("video2", port="1-3", serial="0001", by_id="usb-x_0001-video-index0", by_path="pci-3-video-index0")
    assert machine.names() == ["pci-2-video-index0", "pci-3-video-index0"]


def test_nodes_of_one_parent_have_different_names(machine: Machine) -> None:
    # Two nodes of one platform device get one by-path name; what their driver calls their bus differs.
    machine.plug("video0", port="vivid.0", by_path="platform-vivid.0-video-index0", bus="platform:vivid-000")
    machine.plug("video4", port="vivid.0/b", by_path="platform-vivid.0-video-index0", bus="platform:vivid-001")
    machine.plug("video5", port="bare", bus="same")
    machine.plug("video6", port="bare/b", bus="same")
    names = machine.names()
    assert names == [
        *("platform:vivid-000#0", "platform-vivid.0-video-index0"),
        *(str(machine.dev / "video5"), str(machine.dev / "video6")),
    ]
    assert [machine.resolved(name).name for name in names] == ["video0", "video4", "video5", "video6"]


def test_a_node_that_may_not_be_opened_is_listed_with_the_remedy(machine: Machine) -> None:
    machine.plug("video0", by_path=BY_PATH)
    machine.identities["video0"] = None
    (found,) = list_nodes(machine.sysfs, machine.dev, machine.ask)
    assert found.name == BY_PATH
    assert "usermod -aG video" in found.note


def test_missing_and_other_devices_are_not_cameras(tmp_path: Path) -> None:
    for path in (tmp_path / "video0", Path("/dev/null")):
        identity = probe_node(path)
        assert identity is not None
        assert not identity.captures


def test_a_machine_without_cameras_has_none(tmp_path: Path) -> None:
    assert list_nodes(tmp_path / "none", tmp_path) == ()


def test_a_missing_camera_is_refused_with_a_list_of_connected_ones(machine: Machine) -> None:
    machine.plug("video0", by_path=BY_PATH)
    with pytest.raises(DeviceGoneError, match=f"usb-other.*{BY_PATH}"):
        machine.resolved("usb-other")
    with pytest.raises(DeviceGoneError, match="video9"):
        machine.resolved(str(machine.dev / "video9"))
