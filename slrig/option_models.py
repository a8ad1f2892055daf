"""The options that a driver declares by a pydantic model.

The group is slrig.options. Nothing but writing rig files needs it, so a driver may do without, and neither the driver
nor the library of its vendor is loaded.
"""

from __future__ import annotations

import importlib.metadata

from pydantic import BaseModel

from slrig.discovery import GROUPS
from slrig.errors import DriverBrokenError, DriverNotFoundError

OPTIONS_GROUP = "slrig.options"


def kinds_of(driver: str) -> tuple[str, ...]:
    """What a driver of that name opens: "camera", "projector", "head", "positioner".

    Raises
    ------
    DriverNotFoundError
        No installed package provides a driver of that name.
    """
    names = {
        kind: {entry.name for entry in importlib.metadata.entry_points(group=group)}
        for kind, group in GROUPS.items()
        if kind != "finder"
    }
    kinds = tuple(kind for kind, known in names.items() if driver in known)
    if not kinds:
        installed = ", ".join(sorted(set().union(*names.values()))) or "none"
        message = (
            f"no installed package provides a driver '{driver}'; installed: {installed}; correct the name or install "
            "the driver's package"
        )
        raise DriverNotFoundError(message)
    return kinds


def option_model(driver: str) -> type[BaseModel] | None:
    """The model of a driver's options; None where its package declares none.

    Raises
    ------
    DriverBrokenError
        It cannot be loaded, is no pydantic model, or several packages declare one.
    """
    entries = list(importlib.metadata.entry_points(group=OPTIONS_GROUP, name=driver))
    if not entries:
        return None
    packages = ", ".join(sorted(map(_package, entries)))
    if len(entries) > 1:
        message = f"the options of driver '{driver}' come from several packages: {packages}; uninstall all but one"
        raise DriverBrokenError(message)
    try:
        model: object = entries[0].load()
    except (Exception, SystemExit) as cause:  # a package must not end the command, whatever it does at import
        message = (
            f"the options of driver '{driver}' of {packages} cannot be loaded ({entries[0].value}): "
            f"{type(cause).__name__}: {cause}; report it there"
        )
        raise DriverBrokenError(message) from cause
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        message = f"the options of driver '{driver}' of {packages} are no pydantic model; report it there"
        raise DriverBrokenError(message)
    return model


def described_drivers(package: str) -> tuple[str, ...]:
    """The drivers of which a package declares an option model, sorted."""
    entries = importlib.metadata.entry_points(group=OPTIONS_GROUP)
    return tuple(sorted({entry.name for entry in entries if _package(entry) == package}))


def _package(entry: importlib.metadata.EntryPoint) -> str:
    return "an unknown package" if entry.dist is None else entry.dist.name
