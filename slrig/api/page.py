"""/: the page of the service, the files of the folder slrig/page. It asks for a key itself, so it needs none."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Response
from starlette.middleware.gzip import GZipMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

FOLDER = Path(__file__).resolve().parents[1] / "page"
FILES_PATH = "/page"

_INDEX = (FOLDER / "index.html").read_text(encoding="utf-8")
_INLINE = re.compile(r"<script[^>]*>(.+?)</script>", re.DOTALL)

router = APIRouter(include_in_schema=False)


def policy(html: str) -> str:
    """What a page of ours may load: what comes from here, and those scripts within it that are there now.

    An import map has to stand within a page: browsers take none from a file.
    """
    digests = (hashlib.sha256(script.encode()).digest() for script in _INLINE.findall(html))
    scripts = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return (
        f"default-src 'none'; script-src 'self' {scripts}; style-src 'self'; img-src 'self' blob: data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    )


@router.get("/")
def show_page() -> Response:
    """Show the page of the service."""
    return Response(_INDEX, media_type="text/html", headers={"Content-Security-Policy": policy(_INDEX)})


class _Checked(StaticFiles):
    """Files that a browser keeps, and asks after at each visit: with a new service the page is a new one, too."""

    def file_response(self, *args: Any, **options: Any) -> Response:
        """See `StaticFiles.file_response`."""
        response = super().file_response(*args, **options)
        response.headers["Cache-Control"] = "no-cache"
        return response


def page_files() -> ASGIApp:
    """What the page loads, packed for the way."""
    # Smaller ones fit one packet as they are.
    return GZipMiddleware(_Checked(directory=FOLDER), minimum_size=1400)
