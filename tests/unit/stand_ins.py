"""Functions put in place of slrig's own while a bench lives; benches may end in any order."""

from __future__ import annotations

import importlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

_ORIGINALS: dict[str, Any] = {}
_STANDING: dict[str, list[tuple[object, Any]]] = defaultdict(list)


@contextmanager
def stand_ins(functions: Mapping[str, Callable[..., Any]]) -> Iterator[None]:
    """Put functions in place of others within the block, by "module.name" below slrig; the newest counts."""
    marks = {place: (object(), function) for place, function in functions.items()}
    for place, mark in marks.items():
        module, name = _found(place)
        _ORIGINALS.setdefault(place, getattr(module, name))
        _STANDING[place].append(mark)
        setattr(module, name, mark[1])
    try:
        yield
    finally:
        for place, mark in marks.items():
            module, name = _found(place)
            _STANDING[place].remove(mark)
            newest = _STANDING[place][-1][1] if _STANDING[place] else _ORIGINALS[place]
            setattr(module, name, newest)


def _found(place: str) -> tuple[Any, str]:
    module, _, name = place.rpartition(".")
    try:
        return importlib.import_module(f"slrig.{module}"), name
    except ModuleNotFoundError:
        # Of a class.
        above, _, owner = module.rpartition(".")
        return getattr(importlib.import_module(f"slrig.{above}"), owner), name
