"""Example rigs that come with slrig: rig files, the scenes of rendered ones, and the JSON Schema of rig files.

Commands take an example by its name, as in `slrig demo sphere`.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from slrig.errors import ConfigError

EXAMPLES = Path(__file__).parent
"""Folder of `rigs/NAME.toml`, `scenes/` and `schema.json`."""
_SCENE = re.compile(r'^scene = "\.\./scenes/([^"]+)"', re.MULTILINE)
_MESH = re.compile(r'^file = "([^"]+)"', re.MULTILINE)
_SCHEMA = "#:schema ../schema.json\n"


def example_names() -> list[str]:
    """Names of the example rigs, sorted."""
    return sorted(path.stem for path in (EXAMPLES / "rigs").glob("*.toml"))


def rig_path(given: Path | None) -> Path | None:
    """The file of a rig that a person named: the path, or the example of that name where there is no such file."""
    if given is None or given.is_file() or str(given) not in example_names():
        return given
    return EXAMPLES / "rigs" / f"{given}.toml"


def is_example(rig: Path) -> bool:
    """True if a rig file is one of slrig's own, which a person must not change."""
    return rig.resolve().is_relative_to(EXAMPLES.resolve())


def copy_example(name: str, output: Path) -> None:
    """Write an example's rig file, and the files of its scene into the folder `scenes` beside it.

    Files of that folder that are there are kept: they may have been changed.

    Raises
    ------
    ConfigError
        There is no example of this name.
    OSError
    """
    if name not in example_names():
        message = f"There is no example '{name}'; there are: {', '.join(example_names())}."
        raise ConfigError(message)
    text = (EXAMPLES / "rigs" / f"{name}.toml").read_text(encoding="utf-8")
    scene = _SCENE.search(text)
    used = [] if scene is None else [scene[1], *_MESH.findall((EXAMPLES / "scenes" / scene[1]).read_text("utf-8"))]
    for each in used:
        target = output.parent / "scenes" / each
        target.parent.mkdir(parents=True, exist_ok=True)
        if not target.exists():
            shutil.copyfile(EXAMPLES / "scenes" / each, target)
    text = text.removeprefix(_SCHEMA).replace('"../scenes/', '"scenes/')
    output.write_text(text, encoding="utf-8")
