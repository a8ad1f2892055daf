"""What devices declare about themselves: protocols, names, ranges, calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager

from slrig.conformance.bench import RigBench, at, check, expect, refused
from slrig.devices import Camera, Projector, ScannerHead, Trigger
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Size

_INFO = "keep what info declares in the driver's own memory, and ask the device once, when it is opened"


@check()
def devices_implement_the_protocols(bench: RigBench) -> None:
    """The devices have every method of their protocol, and the cameras their names."""
    rig = bench.rig
    expect(
        rig.cameras,
        asked="a rig has a camera",
        found="none",
        do="add a [[camera]] table to the rig file, or return the head's cameras",
    )
    parts: list[tuple[str, object, type]] = [("projector", rig.projector, Projector)]
    parts += [(f"camera '{name}'", camera, Camera) for name, camera in rig.cameras.items()]
    if rig.head is not None:
        parts.append(("head", rig.head, ScannerHead))
        heads = sorted(rig.head.cameras)
        expect(
            heads == sorted(rig.cameras),
            asked="a head's cameras are those of the rig",
            found=f"{heads} and {sorted(rig.cameras)}",
            do="return the same cameras every time",
        )
        expect(
            rig.head.projector.info == rig.projector.info,
            asked="a head's projector is that of the rig",
            found=rig.head.projector.info,
            do="return the same projector every time",
        )
    for what, device, protocol in parts:
        lacking = [name for name in vars(protocol) if not name.startswith("_") and not hasattr(device, name)]
        expect(
            isinstance(device, protocol),
            asked=f"{what} implements slrig.devices.{protocol.__name__}",
            found=f"{type(device).__name__} without {', '.join(lacking) or 'its methods'}",
            do="write the missing methods",
        )
    for name, camera in rig.cameras.items():
        expect(
            camera.info.name == name,
            asked=f"camera '{name}' declares the name that it was opened under",
            found=f"'{camera.info.name}'",
            do="put the name that the factory is given into CameraInfo",
        )


@check(fresh=True)
def info_is_readable_in_every_state(bench: RigBench) -> None:
    """What is declared can be read in every state, and does not change."""
    rig = bench.rig
    devices: dict[str, Camera | Projector] = {"projector": rig.projector}
    devices |= {f"camera '{name}'": camera for name, camera in rig.cameras.items()}
    before = {what: device.info for what, device in devices.items()}

    def unchanged(state: str) -> None:
        for what, device in devices.items():
            with at(what):
                found = device.info
                expect(
                    found == before[what],
                    asked=f"info {state} is {before[what]}, as after opening",
                    found=found,
                    do=_INFO,
                )

    rig.projector.load(bench.opening)
    for name, camera in rig.cameras.items():
        camera.configure(bench.settings(name))
        camera.arm(1, min(camera.info.triggers))
    rig.projector.show(0)
    unchanged("of an armed camera and a projector that shows")
    bench.rest()
    unchanged("after disarm and blank")
    bench.close()
    unchanged("after close")


@check()
def declared_ranges_are_sound(bench: RigBench) -> None:
    """The ranges that are declared make sense."""
    for name, camera in bench.rig.cameras.items():
        with at(f"camera '{name}'"):
            info = camera.info
            low_s, high_s = info.exposure_range_s
            expect(
                0 < low_s <= high_s < math.inf,
                asked="exposure_range_s is (shortest, longest), both above 0 s and finite",
                found=info.exposure_range_s,
                do="ask the device for its limits",
            )
            least, most = info.gain_range
            expect(
                0 <= least <= most < math.inf,
                asked="gain_range is (least, most), a factor each, finite",
                found=info.gain_range,
                do="ask the device for its limits; (1, 1) if its gain is fixed",
            )
            expect(
                info.triggers and all(isinstance(trigger, Trigger) for trigger in info.triggers),
                asked="triggers names one way to start an exposure, or more",
                found=info.triggers,
                do="declare slrig.devices.Trigger members",
            )
    projector = bench.rig.projector.info
    expect(
        0 <= projector.latency_s < math.inf,
        asked="the projector's latency_s is 0 s or more, and finite",
        found=projector.latency_s,
        do="declare the typical time from show to light; 0.05 for a display that nobody has measured",
    )


@check()
def calibration_and_truth_fit_the_devices(bench: RigBench) -> None:
    """A calibration or truth that the rig carries fits its devices."""
    rig = bench.rig
    sizes = {name: camera.info.format.size for name, camera in rig.cameras.items()}
    carried = {"rig": rig.calibration, "head": None if rig.head is None else rig.head.calibration}
    for what, calibration in carried.items():
        if calibration is None:
            continue
        calibrated = {name: pinhole.size for name, pinhole in calibration.cameras.items()}
        expect(
            calibrated == sizes,
            asked=f"the {what}'s calibration is for {_extents(sizes)}",
            found=_extents(calibrated),
            do="calibrate at the extent that the cameras deliver",
        )
        projector = calibration.projector
        expect(
            projector is None or projector.size == rig.projector.info.size,
            asked=f"the {what}'s calibration is for a projector of {rig.projector.info.size}",
            found=None if projector is None else projector.size,
            do="calibrate with this projector",
        )
    truth = rig.truth()
    if truth is not None:
        shapes = {name: seen.depth_mm.shape for name, seen in truth.cameras.items()}
        expect(
            shapes == {name: size.shape for name, size in sizes.items()},
            asked=f"the truth is for {_extents(sizes)}",
            found=shapes,
            do="render the truth at the extent of the cameras",
        )


@check()
def triggers_that_are_not_declared_are_refused(bench: RigBench) -> None:
    """Triggers that a camera does not declare are refused, and no frames as well."""
    for name, camera in bench.rig.cameras.items():
        with at(f"camera '{name}'"):
            camera.configure(bench.settings(name))
            for trigger in sorted(set(Trigger) - camera.info.triggers):
                with _arm_refused(camera, 1, trigger):
                    camera.arm(1, trigger)
            trigger = min(camera.info.triggers)
            for count in (0, -1):
                with _arm_refused(camera, count, trigger):
                    camera.arm(count, trigger)


def _arm_refused(camera: Camera, count: int, trigger: Trigger) -> AbstractContextManager[None]:
    offered = ", ".join(sorted(camera.info.triggers))
    return refused(
        UnsupportedByDeviceError,
        asked=f"arm({count}, {trigger}) of a camera that declares {offered}",
        do="check count ≥ 1 and the trigger in arm, before the device is touched",
    )


def _extents(sizes: Mapping[str, Size]) -> str:
    return ", ".join(f"'{name}' {size}" for name, size in sorted(sizes.items())) or "no camera"
