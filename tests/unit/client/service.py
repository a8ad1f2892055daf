"""A service that answers from a table, and a client of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import httpx2

from slrig.client import Client

URL = "http://127.0.0.1:1"
HERE = "/scan/5f"
SCAN: dict[str, Any] = {
    "id": "5f",
    "state": "queued",
    "label": "cup",
    "rig": "bench",
    "summary": None,
    "error": None,
    "links": {"self": HERE, "events": f"{HERE}/events", "cancel": f"{HERE}/cancel", "series": None, "files": {}},
}
Handler = Callable[[httpx2.Request], httpx2.Response]


def client_of(handler: Handler, *, pauses: list[float] | None = None) -> Client:
    """A client of a service. pauses : gets the seconds that the client waits, which takes no time."""
    pause = (lambda _: None) if pauses is None else pauses.append
    return Client(URL, "key", pause=pause, transport=httpx2.MockTransport(handler))


def stream(*events: dict[str, Any]) -> bytes:
    blocks = []
    for event in events:
        data = {name: value for name, value in event.items() if name not in {"id", "kind"}}
        blocks.append(f"id: {event['id']}\nevent: {event['kind']}\ndata: {json.dumps(data)}\n\n")
    return "".join(blocks).encode()


def event_answer(content: bytes | Broken) -> httpx2.Response:
    body: dict[str, Any] = {"stream" if isinstance(content, Broken) else "content": content}
    return httpx2.Response(200, headers={"Content-Type": "text/event-stream"}, **body)


class Broken(httpx2.SyncByteStream):
    """A body that breaks off after its first piece."""

    def __init__(self, piece: bytes) -> None:
        self._piece = piece

    def __iter__(self) -> Iterator[bytes]:
        yield self._piece
        raise httpx2.ReadError("the connection broke")


def failing(error: Exception) -> Handler:
    """A service that is not there."""

    def handler(_request: httpx2.Request) -> httpx2.Response:
        raise error

    return handler


class Walk:
    """A service that takes one scan to an end. asked : the method and path of each request, with its body."""

    def __init__(self, state: str = "succeeded", error: dict[str, Any] | None = None, **files: bytes) -> None:
        self.files = {name.replace("__", "-").replace("_", "."): content for name, content in files.items()}
        links = {**SCAN["links"], "files": {name: f"{HERE}/{name}" for name in self.files}}
        self.scan = {**SCAN, "state": state, "error": error, "links": links}
        self.asked: list[tuple[str, str, Any]] = []

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        path = request.url.path
        self.asked.append((request.method, path, json.loads(request.content) if request.content else None))
        if path == "/scan":
            return httpx2.Response(202, json=SCAN)
        if path.endswith("/events"):
            if request.headers["Last-Event-ID"] != "0":
                return httpx2.Response(204)
            return event_answer(
                stream(
                    {"id": 1, "kind": "state", "state": "queued"},
                    {"id": 2, "kind": "progress", "stage": "capture", "fraction": 0.25, "detail": "frame 1 of 4"},
                    {"id": 3, "kind": "captured"},
                    {"id": 4, "kind": "file", "name": "mesh.ply"},
                    {"id": 5, "kind": "of a later version", "what": 1},
                    {"id": 6, "kind": "state", "state": self.scan["state"]},
                )
            )
        if request.method == "DELETE":
            return httpx2.Response(204)
        name = path.rpartition("/")[2]
        return (
            httpx2.Response(200, content=self.files[name])
            if name in self.files
            else httpx2.Response(200, json=self.scan)
        )
