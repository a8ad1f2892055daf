"""YAML of strangers: maps, lists, texts and numbers, small and not deep, without anchors and without a key twice."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from slrig.bundle.validation import read_text
from slrig.errors import CalibrationError

MOST_BYTES = 2**18
MOST_DEPTH = 12


_Loader: Any = type("_Loader", (yaml.SafeLoader,), {})
# YAML 1.1 asks for a point in a number with an exponent; other programs write 1e-05.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def read_yaml(path: Path) -> Any:
    """Return the data of a YAML file. Raises CalibrationError, with the line: it is cut, too large, too deep, or has
    anchors, which can make a short file an endless one.
    """
    text = read_text(path, MOST_BYTES, CalibrationError)
    depth = 0
    try:
        # Events are read one by one: nothing is built before the whole was looked at.
        for event in yaml.parse(text, _Loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MOST_DEPTH or isinstance(event, yaml.AliasEvent):
                mark: Any = event.start_mark
                message = f"{path}: expected YAML without anchors, and maps not deep in each other, found otherwise"
                raise CalibrationError(f"{message} at line {mark.line + 1}; export it again")
        _require_single_keys(yaml.compose(text, _Loader), path)
        return yaml.load(text, _Loader)  # noqa: S506 - a safe loader
    except (yaml.YAMLError, ValueError) as cause:
        mark = getattr(cause, "problem_mark", None)
        where = "" if mark is None else f" at line {mark.line + 1}"
        what = getattr(cause, "problem", None) or str(cause)
        raise CalibrationError(f"{path}: expected YAML, found {what}{where}; correct it") from cause


def _require_single_keys(node: Any, path: Path) -> None:
    """Refuse a key that is twice in one map: PyYAML would keep the last."""
    if isinstance(node, yaml.MappingNode):
        keys = [str(key.value) for key, _ in node.value]
        if len(set(keys)) < len(keys):
            line = node.start_mark.line + 1
            raise CalibrationError(f"{path}: expected each key once, found one twice in the map at line {line}")
    for part in node.value if isinstance(node, yaml.CollectionNode) else ():
        for each in part if isinstance(part, tuple) else (part,):
            _require_single_keys(each, path)


def yaml_bytes(data: object) -> bytes:
    """A YAML text in the order of the data, lists of numbers in a line; numbers are written so that they read back."""
    text: str = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=2**16, allow_unicode=True)
    return text.encode()
