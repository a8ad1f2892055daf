"""A camera's features through GenApi's node map, by the calls of `Aravis.Camera` that this driver makes."""

# ruff: noqa: D102 - each does what the call of that name does in Aravis

from __future__ import annotations

import importlib
from typing import Any

from slrig.errors import UnsupportedByDeviceError

EXPOSURE_US = ("ExposureTime", "ExposureTimeAbs")
GAIN = ("Gain", "GainAbs", "GainRaw")
_KINDS = ("Boolean", "Enumeration", "String", "Integer", "Float", "Command", "Register", "Category")


def feature_type(node: Any) -> str:
    """Boolean, Enumeration, String, Integer, Float, or another kind of GenApi's interfaces."""
    genapi = importlib.import_module("genicam.genapi")
    principal = node.node.principal_interface_type
    return next((kind for kind in _KINDS if principal == getattr(genapi.EInterfaceType, f"intfI{kind}")), "unknown")


class NodeMapCamera:
    """The calls of `Aravis.Camera`, each of which may raise GenApi's and GenTL's errors.

    Parameters
    ----------
    name
        The camera's, for messages.
    nodes
        Its `NodeMap`.
    device
        The producer's description of it.
    """

    def __init__(self, name: str, nodes: Any, device: Any) -> None:
        self._name = name
        self._nodes = nodes
        self._device = device
        self._access = importlib.import_module("genicam.genapi").EAccessMode

    def node(self, feature: str) -> Any:
        """The feature's node. Raises UnsupportedByDeviceError: the camera has no such feature."""
        if not self._nodes.has_node(feature):
            message = (
                f"camera '{self._name}' has no feature {feature}, which the gentl driver needs; use another camera"
            )
            raise UnsupportedByDeviceError(message)
        return self._nodes.get_node(feature)

    def is_feature_available(self, feature: str) -> bool:
        return self._nodes.has_node(feature) and self._offered(self.node(feature))

    def dup_available_enumerations_as_strings(self, feature: str) -> list[str]:
        return [entry.symbolic for entry in self.node(feature).entries if self._offered(entry)]

    def get_string(self, feature: str) -> str:
        return str(self._read(feature))

    def set_string(self, feature: str, value: str) -> None:
        self.node(feature).value = value

    def get_boolean(self, feature: str) -> bool:
        return bool(self._read(feature))

    set_boolean = set_integer = set_float = set_string

    def get_integer(self, feature: str) -> int:
        return int(self._read(feature))

    def get_integer_bounds(self, feature: str) -> tuple[int, int]:
        node = self.node(feature)
        return int(node.min), int(node.max)

    def get_integer_increment(self, feature: str) -> int:
        return int(self.node(feature).inc)

    def get_float(self, feature: str) -> float:
        return float(self._read(feature))

    def get_float_bounds(self, feature: str) -> tuple[float, float]:
        node = self.node(feature)
        return float(node.min), float(node.max)

    def execute_command(self, feature: str) -> None:
        self.node(feature).execute()

    def stop_acquisition(self) -> None:
        for feature, stop in (("AcquisitionStop", self.execute_command), ("TLParamsLocked", self._unlock)):
            if self.is_feature_available(feature):
                stop(feature)

    def get_width_bounds(self) -> tuple[int, int]:
        return self.get_integer_bounds("Width")

    def get_height_bounds(self) -> tuple[int, int]:
        return self.get_integer_bounds("Height")

    def get_exposure_time(self) -> float:
        return self.get_float(self._first(EXPOSURE_US))

    def get_exposure_time_bounds(self) -> tuple[float, float]:
        return self.get_float_bounds(self._first(EXPOSURE_US))

    def set_exposure_time(self, exposure_us: float) -> None:
        self._set_number(self._first(EXPOSURE_US), exposure_us)

    def is_gain_available(self) -> bool:
        return any(map(self.is_feature_available, GAIN))

    def get_gain(self) -> float:
        return self.get_float(self._first(GAIN))

    def get_gain_bounds(self) -> tuple[float, float]:
        return self.get_float_bounds(self._first(GAIN))

    def set_gain(self, gain: float) -> None:
        self._set_number(self._first(GAIN), gain)

    def is_software_trigger_supported(self) -> bool:
        source = "TriggerSource"
        return (
            self._nodes.has_node("TriggerSoftware")
            and self.is_feature_available(source)
            and "Software" in self.dup_available_enumerations_as_strings(source)
        )

    def software_trigger(self) -> None:
        self.execute_command("TriggerSoftware")

    def get_payload(self) -> int:
        return self.get_integer("PayloadSize")

    def get_vendor_name(self) -> str:
        return str(self._device.vendor)

    def get_model_name(self) -> str:
        return str(self._device.model)

    def get_device_serial_number(self) -> str:
        return str(self._device.serial_number)

    def get_device_id(self) -> str:
        return str(self._device.id_)

    def _read(self, feature: str) -> Any:
        # Not from the node map's cache: a camera may have taken a value otherwise than it was written.
        verify, ignore_cache = False, True
        return self.node(feature).get_value(verify, ignore_cache)

    def _unlock(self, feature: str) -> None:
        self.node(feature).value = 0

    def _set_number(self, feature: str, value: float) -> None:
        node = self.node(feature)
        node.value = round(value) if feature_type(node) == "Integer" else value

    def _first(self, features: tuple[str, ...]) -> str:
        """The first feature that the camera offers; the first of all if it offers none."""
        return next(filter(self.is_feature_available, features), features[0])

    def _offered(self, node: Any) -> bool:
        return node.get_access_mode() in {self._access.WO, self._access.RO, self._access.RW}
