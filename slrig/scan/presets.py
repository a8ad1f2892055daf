"""Presets: options of a scan by the name of what they are for, shipped, of the rig file, or kept in the data folder.

A name that is kept stands for what is kept, one of the rig file before one that is shipped.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from slrig.bundle import PRESET_NAME, Preset, PresetDocument, json_bytes, read_json_model, write_file
from slrig.disk import storage_errors
from slrig.errors import ConfigError, PresetNotFoundError
from slrig.model import SequenceName

MOST_PRESET_BYTES = 2**20

SHIPPED: Mapping[str, Preset] = {
    "matt": Preset(description="matt and light: plaster, paint, 3-D prints", exposure_factors=(1.0,)),
    "dark": Preset(description="dark, with lighter parts: rubber, black plastic", exposure_factors=(1.0, 8.0)),
    "shiny": Preset(description="glossy: machined metal, varnish", exposure_factors=(0.25, 2.0)),
    "mixed": Preset(description="dark here and shining there", exposure_factors=(0.0625, 0.5, 4.0)),
    "fast": Preset(
        description="least time, for matt and light objects", exposure_factors=(0.5,), sequence=SequenceName.FAST
    ),
    "precise": Preset(
        description="least noise, for objects that stand still",
        exposure_factors=(0.0625, 0.25, 1.0, 4.0),
    ),
}
"""Factors, because seconds mean nothing on another rig: they are of the exposure at which a light matt object comes
near full scale, as a rig's own is set. Chosen by `tests/bench/preset_sweep.py`; README.md has what they measured.
"""


class PresetSource(StrEnum):
    """Where a preset comes from."""

    SHIPPED = "shipped"
    RIG = "rig"
    KEPT = "kept"


_WORDS = {PresetSource.SHIPPED: "slrig itself", PresetSource.RIG: "the rig file"}


@dataclass(frozen=True, slots=True)
class NamedPreset:
    """A preset by its name. digest : of its options; see `PresetDocument`. fault : what is wrong with its file; there
    are no options then.
    """

    name: str
    source: PresetSource
    description: str | None = None
    digest: str | None = None
    fault: str | None = None


class Presets:
    """The presets of a service. Any thread may call.

    folder : where those are kept that were put, one file each; made when there is need. of_rig : those of the rig file.
    """

    def __init__(self, folder: Path, of_rig: Mapping[str, Preset]) -> None:
        self._folder = folder
        self._given = {
            **{name: (PresetSource.SHIPPED, preset) for name, preset in SHIPPED.items()},
            **{name: (PresetSource.RIG, preset) for name, preset in of_rig.items()},
        }

    def listed(self) -> list[NamedPreset]:
        """All that there are, by name."""
        kept = self._kept()
        found = []
        for name in sorted(kept | set(self._given)):
            source = PresetSource.KEPT if name in kept else self._given[name][0]
            try:
                document = self.get(name)
            except PresetNotFoundError:
                # It was deleted meanwhile.
                continue
            except ConfigError as error:
                found.append(NamedPreset(name, source, fault=str(error)))
            else:
                found.append(NamedPreset(name, source, document.scan.description, document.digest))
        return found

    def get(self, name: str) -> PresetDocument:
        """The preset of a name.

        Raises
        ------
        PresetNotFoundError
            There is none.
        ConfigError
            Its file was changed and is none any more, or is of another version.
        """
        path = self._path(name)
        if path.is_file():
            return read_json_model(path, PresetDocument, "preset", max_bytes=MOST_PRESET_BYTES, error=ConfigError)
        if name not in self._given:
            names = ", ".join(sorted(self._kept() | set(self._given)))
            message = f"There is no preset '{name}' here. There are: {names}."
            raise PresetNotFoundError(message)
        return PresetDocument(scan=self._given[name][1])

    def put(self, name: str, document: PresetDocument) -> None:
        """Keep a preset, in place of what has its name. Raises StorageError."""
        with storage_errors(self._folder):
            self._folder.mkdir(mode=0o750, exist_ok=True)
        write_file(self._path(name), json_bytes(document.model_dump(mode="json", exclude_none=True)))

    def delete(self, name: str) -> None:
        """Remove a preset that was put; one of the rig file or a shipped one of its name is then seen again.

        Raises
        ------
        PresetNotFoundError
            None was put by that name.
        StorageError
            The disk refused.
        """
        path = self._path(name)
        if not path.is_file():
            self.get(name)
            message = (
                f"Preset '{name}' is not kept here, but comes from {_WORDS[self._given[name][0]]}, and cannot be "
                "deleted. One that is PUT by its name takes its place."
            )
            raise PresetNotFoundError(message)
        with storage_errors(path):
            path.unlink(missing_ok=True)

    def _kept(self) -> set[str]:
        """The names of those that were put; a file of another name was put there by hand, and nobody can ask for it."""
        return {path.stem for path in self._folder.glob("*.json") if re.fullmatch(PRESET_NAME, path.stem)}

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.json"
