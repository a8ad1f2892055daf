"""/docs: the description of the interface as a page, by Swagger UI, which the package fastapi-offline brings along."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from fastapi import APIRouter, Response
from fastapi.responses import FileResponse
from starlette.exceptions import HTTPException

_ASSETS = {"swagger-ui-bundle.js": "text/javascript", "swagger-ui.css": "text/css", "favicon.png": "image/png"}
_START = """SwaggerUIBundle({
  url: "/openapi.json", dom_id: "#docs", deepLinking: true, validatorUrl: null,
  presets: [SwaggerUIBundle.presets.apis], layout: "BaseLayout",
});
"""
_PAGE = """<!doctype html>
<html lang="en">
<head>
  <meta charset="utf-8"><title>slrig: the interface</title>
  <link rel="icon" href="/docs/favicon.png"><link rel="stylesheet" href="/docs/swagger-ui.css">
</head>
<body><div id="docs"></div>
  <script src="/docs/swagger-ui-bundle.js"></script><script src="/docs/start.js"></script>
</body>
</html>
"""

router = APIRouter(prefix="/docs", include_in_schema=False)


@router.get("")
def show_interface() -> Response:
    """Show the description of the interface as a page."""
    return Response(_PAGE, media_type="text/html")


@router.get("/start.js")
def start_page() -> Response:
    """What the page does at its start, in a file of its own: scripts within the page are forbidden."""
    return Response(_START, media_type="text/javascript")


@router.get("/{name}")
def fetch_asset(name: str) -> Response:
    """Return a part of Swagger UI."""
    found = find_spec("fastapi_offline")
    if name not in _ASSETS or found is None or found.origin is None:
        raise HTTPException(404)
    return FileResponse(Path(found.origin).parent / "static" / name, media_type=_ASSETS[name])
