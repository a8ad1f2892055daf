"""Tables of a rig or scene file, checked strictly: unknown keys are faults, and all faults come in one message."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from slrig.errors import ConfigError

Pair = Annotated[tuple[float, float], Field(strict=False)]
Triple = Annotated[tuple[float, float, float], Field(strict=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
NotNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]


class Table(BaseModel):
    """A TOML table: no unknown keys, no silent conversion of text to numbers, no NaN or infinity; frozen."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


Item = TypeVar("Item")
TableT = TypeVar("TableT", bound=Table)


def checked(model: type[TableT], table: Mapping[str, object], *, source: str) -> TableT:
    """Return `table` as a `model`.

    Raises
    ------
    ConfigError
        Names `source` and lists every fault: where it is, what is wrong, what was found.
    """
    try:
        return model.model_validate(dict(table))
    except ValidationError as error:
        faults = [
            f"  {_dotted(fault['loc'])}: {_cause(fault['type'], fault['msg'])}{_found(fault['input'])}"
            for fault in error.errors(include_url=False)
        ]
        count = "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
        message = "\n".join([f"{source} has {count}; correct each and try again:", *faults])
        raise ConfigError(message) from None


def at_least_one(items: tuple[Item, ...]) -> tuple[Item, ...]:
    """Return `items`, or raise ValueError. A length rule of pydantic's own would also count items with faults."""
    if not items:
        message = "at least one is needed"
        raise ValueError(message)
    return items


def read_toml(path: Path) -> dict[str, object]:
    """Return the tables of a TOML file. Raises ConfigError when it is missing or not TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        message = f"{path}: expected a TOML file, found none that can be read ({error.strerror}); check the path"
        raise ConfigError(message) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        message = f"{path}: not a TOML file: {error}"
        raise ConfigError(message) from error


def _dotted(location: tuple[int | str, ...]) -> str:
    parts = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in location]
    return "".join(parts).lstrip(".") or "the table"


def _cause(kind: str, sentence: str) -> str:
    if kind == "extra_forbidden":
        return "unknown key"
    sentence = sentence.removeprefix("Value error, ")
    return sentence[:1].lower() + sentence[1:]


def _found(value: object) -> str:
    if isinstance(value, Mapping):
        return ""
    text = repr(value)
    return f", found {text if len(text) <= 60 else text[:57] + '...'}"
