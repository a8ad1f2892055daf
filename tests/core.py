"""Which cases of a test run in the core, that is by the README's test command."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import pytest


def parametrize_core(
    names: str | tuple[str, ...], cases: Iterable[Any], *, core: Sequence[int] = (0,), ids: Any = None
) -> pytest.MarkDecorator:
    """`pytest.mark.parametrize` whose cases are slow, except those at the places `core`: one promise, many kinds."""

    def slow(case: Any) -> Any:
        if hasattr(case, "marks"):
            return case._replace(marks=[*case.marks, pytest.mark.slow])
        return pytest.param(*([case] if isinstance(names, str) else case), marks=pytest.mark.slow)

    return pytest.mark.parametrize(
        names, [case if place in core else slow(case) for place, case in enumerate(cases)], ids=ids
    )
