"""The description of the interface, kept as config/openapi.json: `python -m slrig.api` prints it."""

from __future__ import annotations

import json
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from slrig.api.problems import MEDIA_TYPE, Problem
from slrig.api.scopes import needed_scope

_PROBLEM = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
_EVERYWHERE = (400, 401, 403, 413, 429, 500)

BYTES = {"type": "string", "format": "binary"}
"""A body that is neither JSON nor text."""

_TEXTS = {
    "application/json": {"type": "object"},
    **{kind: {"type": "string"} for kind in ("application/xml", "application/yaml", "image/svg+xml", "text/html")},
}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that may answer with problems of these statuses. `describe` adds those of every route
    of its kind: 404 where the path names something, 422 where a request may say something.
    """
    return {status: {"description": HTTPStatus(status).phrase, "content": _PROBLEM} for status in statuses}


def file_of(media_type: str, *statuses: int) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that answers with a file, or with problems of these statuses."""
    content = {media_type: {"schema": _TEXTS.get(media_type, BYTES)}}
    return {200: {"description": "the file", "content": content}, **problems(*statuses)}


def describe(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document of the service: every refusal is a problem, and what needs a key says what for."""
    if app.openapi_schema:
        return app.openapi_schema
    document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
    components = document.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    definition = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas.update(definition.pop("$defs", {}))
    schemas["Problem"] = definition
    components["securitySchemes"] = {
        "bearer": {"type": "http", "scheme": "bearer"},
        "header": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
    }
    components["securitySchemes"]["session"] = {"type": "apiKey", "in": "cookie", "name": "slrig_session_PORT"}
    document["security"] = [{"bearer": []}, {"header": []}, {"session": []}]
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            answers = operation["responses"]
            for status, found in list(answers.items()):
                if "HTTPValidationError" in json.dumps(found):
                    del answers[status]
            needed = [status for status in _EVERYWHERE if status != 401 or operation.get("security") != []]
            if "parameters" in operation or "requestBody" in operation:
                needed.append(422)
            if "{" in path:
                needed.append(404)
            if method not in {"get", "head"}:
                needed.append(415)
            for status in needed:
                answers.setdefault(str(status), problems(status)[status])
            operation["responses"] = dict(sorted(answers.items()))
            if operation.get("security") != []:
                operation["x-scope"] = str(needed_scope(method.upper(), path))
    app.openapi_schema = document
    return document


def text(app: FastAPI) -> str:
    """The document as it is kept in config/openapi.json."""
    return json.dumps(describe(app), indent=2, ensure_ascii=False) + "\n"
