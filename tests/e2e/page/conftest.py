"""A page that is looked at in a browser, and must not complain."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

from slrig.api.auth import KeyRing
from slrig.api.scopes import KeyScope
from slrig.config import ServiceSettings
from tests.e2e.conftest import KEY, ServiceProcess
from tests.npm import npm_package

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ConsoleMessage, Locator, Page

LIMIT_MS = 60_000
DESK, PHONE = (1280, 800), (390, 844)
_AXE = "axe-core@4.14.1"

Visit = Callable[..., "Page"]


@pytest.fixture
def visit(browser: Browser) -> Iterator[Visit]:
    """Open the page of a service, logged in unless `key` is None. At the end no page may have complained."""
    complaints: list[str] = []
    contexts = []

    def opened(
        service: ServiceProcess,
        place: str = "",
        *,
        key: str | None = KEY,
        size: tuple[int, int] = DESK,
        dark: bool = False,
        ignored: str | None = None,
    ) -> Page:
        context = browser.new_context(
            viewport={"width": size[0], "height": size[1]}, color_scheme="dark" if dark else "light"
        )
        contexts.append(context)
        context.set_default_timeout(LIMIT_MS)
        page = context.new_page()

        def note(what: str) -> None:
            if ignored is None or not re.search(ignored, what):
                complaints.append(what)

        def heard(message: ConsoleMessage) -> None:
            if message.type in {"error", "warning"}:
                note(f"{message.text} ({message.location['url']})")

        page.on("console", heard)
        page.on("pageerror", lambda error: note(str(error)))
        page.on("request", lambda request: note(request.url) if foreign(request.url, service.url) else None)
        if key is not None:
            sent = context.request.post(f"{service.url}/session", headers={"Authorization": f"Bearer {key}"})
            assert sent.status == 201
        page.goto(f"{service.url}/#/{place}")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert complaints == []


def foreign(url: str, service: str) -> bool:
    return not url.startswith((service, "blob:", "data:"))


def violations(page: Page) -> list[str]:
    """What axe finds wrong with a page as it is now: the rule, and where."""
    axe = npm_package(_AXE, "to look for what keeps people from using a page") / "axe.min.js"
    page.evaluate(axe.read_text(encoding="utf-8"))
    found: list[dict[str, Any]] = page.evaluate("() => axe.run().then((found) => found.violations)")
    return [f"{each['id']}: {node['html'][:200]}" for each in found for node in each["nodes"]]


def fits(page: Page) -> None:
    """Nothing lies beyond the right edge of the window, and axe finds nothing wrong."""
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert violations(page) == []


def looking(service: ServiceProcess) -> str:
    return KeyRing(ServiceSettings(data_dir=service.data).key_path).add("Ann", [KeyScope.LOOK])


def count(found: Locator, number: int) -> None:
    """Wait until so many are there: what a page shows comes by more than one answer."""
    from playwright.sync_api import expect

    expect(found).to_have_count(number, timeout=LIMIT_MS)


def disabled(button: Locator) -> None:
    """Wait until a button cannot be pressed."""
    from playwright.sync_api import expect

    expect(button).to_be_disabled(timeout=LIMIT_MS)
