"""HTML and SVG put together from Python: every text and attribute is escaped unless it is markup already."""

from __future__ import annotations

import html
from base64 import b64encode

_VOID = frozenset({"br", "img", "meta", "hr"})


class Markup(str):
    """Text that is markup, and goes in as it is."""

    __slots__ = ()


def tag(name: str, /, *content: str | float | None, **attributes: str | float | bool | None) -> Markup:
    """One element. Of an attribute's name a closing underscore falls off, and other underscores become hyphens.

    Content None and attributes None or False are left out; an attribute True stands without a value.

    >>> tag("p", "2 < 3", class_="note")
    '<p class="note">2 &lt; 3</p>'
    """
    written = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in _VOID:
        return Markup(f"<{name}{written}>")
    return Markup(f"<{name}{written}>{joined(*content)}</{name}>")


def joined(*content: str | float | None) -> Markup:
    """Several pieces as one, each escaped unless it is markup."""
    return Markup("".join(_escaped(each) for each in content if each is not None))


def picture_uri(jpeg: bytes) -> str:
    """A JPEG file as the address of a picture that travels in the page itself."""
    return "data:image/jpeg;base64," + b64encode(jpeg).decode("ascii")


def _attribute(key: str, value: str | float | bool | None) -> str:
    if value is None or value is False:
        return ""
    name = key.rstrip("_").replace("_", "-")
    if value is True:
        return f" {name}"
    return f' {name}="{html.escape(_text(value))}"'


def _escaped(content: str | float) -> str:
    return content if isinstance(content, Markup) else html.escape(_text(content), quote=False)


def _text(value: str | float) -> str:
    """A number in at most six digits, which is what a drawing needs; text as it is."""
    return value if isinstance(value, str) else f"{value:.6g}"
