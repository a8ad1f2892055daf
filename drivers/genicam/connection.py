"""What the driver asks of a library for GenICam cameras, whichever it is: Aravis, or a GenTL producer."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from slrig.devices import CameraState
from slrig.errors import DeviceGoneError, UnsupportedByDeviceError
from slrig.model import Size

TOLERANCE = 0.01
"""How far a number may be from what was asked, as a fraction: cameras round to their steps."""


class Features:
    """The features of a device. Every call may raise what `GenICamConnection.access` raises.

    Parameters
    ----------
    name
        The camera's, for messages.
    asking
        Gives the `Aravis.Camera` for one question; its registers must not be cached, so that what is read back comes
        from the camera.
    kind
        Of a feature: see `Connection`.
    """

    def __init__(
        self, name: str, access: Callable[[str], AbstractContextManager[Any]], kind: Callable[[str], str]
    ) -> None:
        self._name = name
        self._access_camera = access
        self._kind = kind

    def has(self, feature: str) -> bool:
        """Whether the device has the feature, and offers it as it is set now."""
        with self._access(feature) as camera:
            return bool(camera.is_feature_available(feature))

    def choices(self, feature: str) -> tuple[str, ...]:
        """The entries of an enumeration that can be chosen now."""
        with self._access(feature) as camera:
            return tuple(camera.dup_available_enumerations_as_strings(feature) or ())

    def text(self, feature: str) -> str:
        """The value of an enumeration or a string."""
        with self._access(feature) as camera:
            return str(camera.get_string(feature))

    def integer(self, feature: str) -> int:
        """The value of an integer."""
        with self._access(feature) as camera:
            return int(camera.get_integer(feature))

    def number(self, feature: str) -> float:
        """The value of a number with decimals."""
        with self._access(feature) as camera:
            return float(camera.get_float(feature))

    def execute(self, feature: str) -> None:
        """Execute a command."""
        with self._access(feature) as camera:
            camera.execute_command(feature)

    def choose(self, feature: str, entry: str) -> None:
        """Set an enumeration.

        Raises
        ------
        UnsupportedByDeviceError
            It has no such entry, or reads back another.
        """
        offered = self.choices(feature)
        if entry not in offered:
            raise self._refusal(
                feature, entry, f"it offers {', '.join(offered) or 'nothing now'}", "choose one of these"
            )
        if self.text(feature) == entry:
            # Some cameras offer one entry only, and do not let it be written.
            return
        with self._access(feature) as camera:
            camera.set_string(feature, entry)
        self._require_equal(feature, entry, self.text(feature))

    def set_integer(self, feature: str, value: int) -> None:
        """Set an integer. Raises UnsupportedByDeviceError: out of range, between steps, or it reads back another."""
        with self._access(feature) as camera:
            least, most = camera.get_integer_bounds(feature)
            step = camera.get_integer_increment(feature)
        if not least <= value <= most or (step > 1 and (value - least) % step):
            steps = f" in steps of {step}" if step > 1 else ""
            raise self._refusal(feature, value, f"it takes {least} to {most}{steps}", "ask for such a value")
        with self._access(feature) as camera:
            camera.set_integer(feature, value)
        self._require_equal(feature, value, self.integer(feature))

    def set_any(self, feature: str, value: bool | int | float | str) -> None:
        """Set a feature of whatever kind it is. Raises UnsupportedByDeviceError: missing, another kind, not taken."""
        if not self.has(feature):
            message = (
                f"camera '{self._name}' has no feature {feature}, or does not offer it as it is set now; remove it "
                "from features, or set what enables it before"
            )
            raise UnsupportedByDeviceError(message)
        match value, self._kind(feature):
            case bool(), "Boolean":
                with self._access(feature) as camera:
                    camera.set_boolean(feature, value)
                    got = bool(camera.get_boolean(feature))
                self._require_equal(feature, value, got)
            case str(), "Enumeration":
                self.choose(feature, value)
            case str(), "String":
                with self._access(feature) as camera:
                    camera.set_string(feature, value)
                self._require_equal(feature, value, self.text(feature))
            case int(), "Integer" if not isinstance(value, bool):
                self.set_integer(feature, value)
            case int() | float(), "Float" if not isinstance(value, bool):
                self._set_number(feature, float(value))
            case _, kind:
                raise self._refusal(feature, value, f"it is a feature of the kind {kind}", "write a value of that kind")

    def _set_number(self, feature: str, value: float) -> None:
        with self._access(feature) as camera:
            least, most = camera.get_float_bounds(feature)
        if not least <= value <= most:
            raise self._refusal(feature, value, f"it takes {least:g} to {most:g}", "ask for such a value")
        with self._access(feature) as camera:
            camera.set_float(feature, value)
            got = float(camera.get_float(feature))
        if differs(got, value):
            raise self._refusal(feature, value, f"it gives {got:g}", "ask for a value that it can give")

    def _require_equal(self, feature: str, asked: object, got: object) -> None:
        if got != asked:
            raise self._refusal(feature, asked, f"it gives {got}", "ask for a value that it can give")

    def _refusal(self, feature: str, asked: object, found: str, remedy: str) -> UnsupportedByDeviceError:
        return UnsupportedByDeviceError(f"camera '{self._name}': asked for {feature} {asked}, {found}; {remedy}")

    def _access(self, feature: str) -> AbstractContextManager[Any]:
        return self._access_camera(f"feature {feature}")


def differs(got: float, asked: float) -> bool:
    """Whether a number that was read back is not the one that was asked for.

    >>> differ(0.01001, 0.01), differ(0.0, 0.0), differ(2.0, 1.5)
    (False, False, True)
    """
    return abs(got - asked) > TOLERANCE * abs(asked) + 1e-12


@dataclass(frozen=True, slots=True)
class RawImage:
    """An image as it lies in memory; so many bytes follow each row."""

    data: bytes
    size: Size
    padding_bytes: int


@dataclass(frozen=True, slots=True)
class RawFrame:
    """What a library delivered of a frame.

    block_id : the camera's number of it. arrived_ns : when it came, CLOCK_MONOTONIC; not before it did. stamp_ns : the
    camera's own time, 0 if there is none. image : None if it is not whole.
    """

    block_id: int
    arrived_ns: int
    stamp_ns: int
    image: RawImage | None


class GenICamStream(Protocol):
    """A running acquisition."""

    def take(self, max_s: float) -> RawFrame | None:
        """Return the next frame, waiting for it no longer than that; None if none came."""
        ...

    def end(self) -> None:
        """Stop, whatever state the camera is in. What has not been taken is gone."""
        ...


class GenICamConnection(ABC):
    """An open device. One thread uses it; one of the library may tell that it is lost.

    Parameters
    ----------
    name
        The camera's, for messages.
    """

    _camera: Any
    """`Aravis.Camera`, or what does the same calls."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.state = CameraState(name)
        self._lost = threading.Event()
        self.features = Features(name, self.access, self.feature_type)

    @property
    def is_lost(self) -> bool:
        """Whether the device has gone since it was opened."""
        return self._lost.is_set()

    @contextmanager
    def access(self, doing: str) -> Iterator[Any]:
        """The camera as `Aravis.Camera` presents it, for the block.

        Raises
        ------
        DeviceStateError
            It was closed.
        DeviceGoneError
            It is lost, before or by what the block asked.
        DeviceError
            What `translate_errors` makes of the library's errors.
        """
        self.state.require_open()
        if self._lost.is_set():
            raise self.gone_error(doing)
        try:
            with self.translate_errors(doing):
                yield self._camera
        except DeviceGoneError:
            self._lost.set()
            raise

    def gone_error(self, doing: str) -> DeviceGoneError:
        """The error of a device that is lost."""
        message = f"camera '{self.name}' is gone ({doing}); check its cable and power, and open the rig again"
        return DeviceGoneError(message)

    def latch(self) -> tuple[int, int, int] | None:
        """Host's time, the device's, host's time again, ns; None if it has no clock that can be looked at."""
        command, value = "TimestampLatch", "TimestampLatchValue"
        try:
            if not (self.features.has(command) and self.features.has(value)):
                return None
            before_ns = time.monotonic_ns()
            self.features.execute(command)
            after_ns = time.monotonic_ns()
            return before_ns, self.features.integer(value), after_ns
        except UnsupportedByDeviceError:
            return None

    @property
    def has_stamps(self) -> bool:
        """Whether frames may carry the device's own time."""
        return True

    @abstractmethod
    def translate_errors(self, doing: str) -> AbstractContextManager[None]:
        """Turn the library's errors within the block into slrig's."""

    @abstractmethod
    def feature_type(self, feature: str) -> str:
        """Boolean, Enumeration, String, Integer, Float, or what else the library calls a feature that it has."""

    @abstractmethod
    def start(self, buffers: int) -> GenICamStream:
        """Start the acquisition, with room for so many frames. No frame of an earlier one comes out of it."""

    @abstractmethod
    def close(self) -> None:
        """Let the device go. Idempotent; works after it is lost."""
