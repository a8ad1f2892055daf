"""Entry points by which packages extend slrig. slrig's own are in `slrig.extras`; nothing else imports them.

| group | name of the entry | object |
|---|---|---|
| slrig.formats | any | a `FileFormat`: a file that is made of a finished scan on request |
| slrig.receivers | X, with the setting `X_url` | `open(settings, outbox) -> slrig.schedule.notices.Sender` |
| slrig.observers | any | `observe()`, which returns None or an object with `ended(record, events)` and `close()` |

Drivers have groups of their own: see `slrig.discovery`.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

from slrig.errors import ConfigError, DriverBrokenError, SlrigError, is_interrupt
from slrig.printable import foreign_text

FORMATS, RECEIVERS, OBSERVERS = "slrig.formats", "slrig.receivers", "slrig.observers"


@dataclass(frozen=True, slots=True)
class FileFormat:
    """A file that the worker makes of a finished scan when it is first requested.

    name : of the file, such as "scan.mcap"; with "{camera}" there is one file for each camera. media_type : for HTTP.
    library : the module that the encoder needs. install : the command that installs it. encoder : "module:function".
    With "{camera}" the function takes a `slrig.scan.clouds.OrganisedCloud`; without, the calibration, an iterator of
    such clouds, the first white image by camera, and the time of capture or None. It returns the file's bytes.
    """

    name: str
    media_type: str
    library: str
    install: str
    encoder: str

    @property
    def missing(self) -> str | None:
        """The command that installs the library; None if it is installed."""
        try:
            found = importlib.util.find_spec(self.library) is not None
        except Exception:  # noqa: BLE001 - it imports what the library lies in, which may be broken
            found = False
        return None if found else self.install

    def matches(self, name: str) -> bool:
        """True if a file of this name has this format.

        >>> FileFormat("points-{camera}.xyz", "text/plain", "json", "", "").matches("points-left.xyz")
        True
        """
        before, of_camera, after = self.name.partition("{camera}")
        if not of_camera:
            return name == self.name
        return name.startswith(before) and name.endswith(after) and len(name) > len(before) + len(after)

    def encode(self, *given: object) -> bytes:
        """Return the file's bytes. Raises SlrigError as the encoder does; DriverBrokenError: it has a defect."""
        try:
            module, _, function = self.encoder.partition(":")
            data: bytes = getattr(importlib.import_module(module), function)(*given)
            # Raises TypeError for anything else than bytes.
            memoryview(data)
        except SlrigError:
            raise
        except BaseException as error:
            if is_interrupt(error):
                raise
            message = (
                f"{self.name}: its encoder {self.encoder} failed ({type(error).__name__}: {foreign_text(error)}); "
                "report it to the maintainer of its package"
            )
            raise DriverBrokenError(message) from error
        return data


@cache
def load(group: str) -> Mapping[str, Any]:
    """Return the objects of a group by the names of their entries, in the order of names.

    Raises
    ------
    ConfigError
        One cannot be imported: the message names its package and the cause.
    """
    objects = {}
    for entry in sorted(importlib.metadata.entry_points(group=group), key=lambda entry: entry.name):
        package = "unknown" if entry.dist is None else entry.dist.name
        with plugin_errors(group, f"{entry.name}' of the package '{package}"):
            found = objects[entry.name] = entry.load()
            if not (isinstance(found, FileFormat) if group == FORMATS else callable(found)):
                message = f"it is {type(found).__name__}, which is not what this group holds"
                raise TypeError(message)
    return objects


@contextmanager
def plugin_errors(group: str, name: str) -> Iterator[None]:
    """Name a plug-in that fails within the block by a ConfigError. Its own errors of slrig pass."""
    try:
        yield
    except SlrigError:
        raise
    except BaseException as error:
        if is_interrupt(error):
            raise
        cause = f"{type(error).__name__}: {foreign_text(error)}"
        message = f"{group}: '{name}' cannot be loaded: {cause}. Update or uninstall that package."
        raise ConfigError(message) from error


def formats() -> tuple[FileFormat, ...]:
    """File formats of all installed packages. Raises ConfigError."""
    return tuple(load(FORMATS).values())
