"""The READMEs: links lead somewhere, and the first one can be read to its end."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.e2e.readmes.commands import ROOT, readmes

MOST_LINES = 200
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)


def anchors(path: Path) -> set[str]:
    """The anchors that GitHub gives the headings of a page."""
    headings = _HEADING.findall(path.read_text(encoding="utf-8"))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_first_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= MOST_LINES


@pytest.mark.parametrize("readme", readmes(), ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(readme: Path) -> None:
    links = _LINK.findall(readme.read_text(encoding="utf-8"))
    lost = []
    for link in links:
        place, _, anchor = link.partition("#")
        if "://" in place:
            continue
        target = readme if not place else readme.parent / place
        if not target.exists() or (anchor and anchor not in anchors(target)):
            lost.append(link)
    assert lost == []


def test_every_readme_is_linked_from_the_first() -> None:
    linked = {(ROOT / link.partition("#")[0]).resolve() for link in _LINK.findall((ROOT / "README.md").read_text())}
    assert [str(path.relative_to(ROOT)) for path in readmes()[1:] if path not in linked] == []
