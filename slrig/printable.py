"""Text that is safe to print.

Control characters move a terminal's cursor, change its colours and its title, or end a line of a log. Unicode's
overrides and isolates of direction (U+202A to U+202E, U+2066 to U+2069) make text look like other text: see
CVE-2021-42574. Direction marks and joiners, which Arabic, Hebrew and Hindi need, are allowed.
"""

from __future__ import annotations

import re

UNSAFE = r"\u0000-\u001f\u007f-\u009f\u2028-\u202e\u2066-\u2069"
"""Characters that affect a terminal, as a class of a regular expression."""

unsafe = re.compile(rf"[{UNSAFE}\ud800-\udfff]")
"""The same, and half surrogate pairs, which JSON can hold and UTF-8 cannot."""


_FOREIGN_LENGTH = 2000


def foreign_text(value: object) -> str:
    r"""Text of an object of foreign code, such as an error: lines and tabs stay, other characters that
    affect a terminal are escaped, and it has an end. An object without a text of its own gives its type.

    >>> foreign_text(ValueError("a\x1b[2J\ud800\nb"))
    'a\\u001b[2J\\ud800\nb'
    """
    try:
        text = str(value)
    except BaseException:  # noqa: BLE001 - of a foreign class
        text = type(value).__name__
    lines = [[printable(part) for part in line.split("\t")] for line in text[: _FOREIGN_LENGTH + 1].split("\n")]
    found = "\n".join("\t".join(parts) for parts in lines)
    return found if len(text) <= _FOREIGN_LENGTH else f"{found[:_FOREIGN_LENGTH]} …"


def printable(text: str) -> str:
    r"""Return the text with an escape for each character that affects a terminal or that UTF-8 cannot hold.

    >>> printable("a\x1b[2Jb\u202e"), printable("\ud800")
    ('a\\u001b[2Jb\\u202e', '\\ud800')
    """
    return unsafe.sub(lambda match: f"\\u{ord(match[0]):04x}", text)
