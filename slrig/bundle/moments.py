"""Dates in what strangers send."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated

from pydantic import AwareDatetime, BeforeValidator, Field

_number = re.compile(r"\s*[+-]?[\d._]+(e[+-]?\d+)?\s*", re.IGNORECASE | re.ASCII)


def _refuse_number(sent: object) -> object:
    """Pydantic takes a text of digits for seconds since 1970."""
    if isinstance(sent, (int, float)) or (isinstance(sent, str) and _number.fullmatch(sent)):
        message = (
            f"expected a date and time with the offset from UTC, as 2026-11-20T06:00:00Z, found the number {sent}; "
            "write it as ISO 8601 does"
        )
        raise ValueError(message)
    return sent


Moment = Annotated[datetime, Field(strict=False), BeforeValidator(_refuse_number)]
"""A date and time as ISO 8601 text. A number is none."""

AwareMoment = Annotated[AwareDatetime, Field(strict=False), BeforeValidator(_refuse_number)]
"""The same, with its offset from UTC."""
