"""Free text of strangers, which reaches terminals, logs and pages: labels, names of positions."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from slrig.printable import UNSAFE, unsafe


def _refuse_unsafe(text: str) -> str:
    found = unsafe.search(text)
    if found is not None:
        message = (
            f"expected text without control characters, found U+{ord(found[0]):04X} at character {found.start() + 1}; "
            "leave it out"
        )
        raise ValueError(message)
    return text


SafeText = Annotated[str, Field(json_schema_extra={"pattern": f"^[^{UNSAFE}]*$"}), AfterValidator(_refuse_unsafe)]
"""Text of which no character does something to a terminal."""

FreeText = Annotated[SafeText, Field(min_length=1, max_length=200)]
"""The same, of 1 to 200 characters."""
