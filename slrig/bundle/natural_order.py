"""The order in which a person counts files: scan-2 before scan-10."""

from __future__ import annotations

import re
from pathlib import Path


def natural(path: Path) -> tuple[list[str | int], str]:
    """A key to sort by. Capitals count only where nothing else tells two paths apart.

    >>> [path.name for path in sorted(map(Path, ("Scan-2", "scan-10", "scan-1", "scan-2")), key=natural)]
    ['scan-1', 'Scan-2', 'scan-2', 'scan-10']
    """
    parts = re.split(r"([0-9]+)", str(path))
    return [int(part) if place % 2 else part.casefold() for place, part in enumerate(parts)], str(path)
