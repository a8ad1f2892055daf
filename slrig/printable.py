r"""Text as it may be printed.

Control characters move a terminal's cursor, change its colours and its title, or end a line of a log. Unicode's
overrides and isolates of direction (U+202A to U+202E, U+2066 to U+2069) have a text read as what it is not: see
CVE-2021-42574. Marks of direction and joiners, which Arabic, Hebrew and Hindi need, are text.
"""

from __future__ import annotations

import re

UNSAFE = r"\u0000-\u001f\u007f-\u009f\u2028-\u202e\u2066-\u2069"
"""What does something to a terminal, as a class of a regular expression."""

unsafe = re.compile(rf"[{UNSAFE}\ud800-\udfff]")
"""The same, and what UTF-8 cannot hold: half a surrogate pair, which JSON can."""


def printable(text: str) -> str:
    r"""The text with an escape for each character that does something to a terminal or that UTF-8 cannot hold.

    >>> printable("a\x1b[2Jb\u202e"), printable("\ud800")
    ('a\\u001b[2Jb\\u202e', '\\ud800')
    """
    return unsafe.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
