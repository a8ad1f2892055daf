"""Values of the tables of rig and scene files."""

from __future__ import annotations

from typing import Annotated, TypeVar

from pydantic import Field

Pair = Annotated[tuple[float, float], Field(strict=False)]
Triple = Annotated[tuple[float, float, float], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
NotNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]


Item = TypeVar("Item")


def require_one(items: tuple[Item, ...]) -> tuple[Item, ...]:
    """Return `items`, or raise ValueError. A length rule of pydantic's own would also count items with faults."""
    if not items:
        message = "at least one is needed"
        raise ValueError(message)
    return items
