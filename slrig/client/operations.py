"""Operations as attributes: declared once, called and returned on a `Client`, awaited on an `AsyncClient`."""

from __future__ import annotations

import inspect
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Iterator, Mapping
from dataclasses import dataclass
from functools import wraps
from types import MethodType
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar, overload
from urllib.parse import quote

from slrig.client.core import Core, Json, W
from slrig.client.wire import Awaited, Blocking

P = ParamSpec("P")
T = TypeVar("T")
Called = TypeVar("Called")
Asked = TypeVar("Asked")


class Remote(Generic[W]):
    """Something of a service that is reached over a wire."""

    def __init__(self, core: Core[W]) -> None:
        self.core = core


@dataclass(frozen=True, slots=True)
class Spec:
    """The request of an operation. line : method and path. query : what goes there, all there is of a GET. content :
    the parameter that is the body as it is. once : see `Core.send`. kind : what comes back, by the name of its type;
    or "stream".
    """

    line: str
    declared: Callable[..., Any]
    query: tuple[str, ...] = ()
    content: str | None = None
    once: bool = False
    kind: str = "Json"

    def request(self, remote: object, args: Any, options: Any) -> Json:
        """What `Core.send` takes, of the arguments of a call; None stands for what is not given."""
        signature = inspect.signature(self.declared)
        bound = signature.bind(remote, *args, **options)
        _self, *names = signature.parameters
        given: Json = {}
        for name in names:
            if signature.parameters[name].kind is inspect.Parameter.VAR_KEYWORD:
                given |= bound.arguments.get(name, {})
            else:
                given[name] = bound.arguments.get(name)
        method, _, path = self.line.partition(" ")
        # The parameters that the path names come first, in its order.
        head, *rest = path.split("{")
        for part, name in zip(rest, names, strict=False):
            head += quote(str(given.pop(name)), safe="") + part.partition("}")[2]
        request: Json = {"method": method, "path": head, **({"once": True} if self.once else {})}
        has_body = method in {"POST", "PUT"} and bool(given.keys() - set(self.query))
        told = {name: value for name, value in given.items() if value is not None}
        if params := {name: told.pop(name) for name in (self.query if has_body else tuple(told)) if name in told}:
            request["params"] = params
        if self.content is not None:
            return request | _document(told[self.content])
        return request | ({"json": told} if has_body else {})


class Operation(Generic[P, Called, Asked]):
    """A function as an attribute of what is remote: a coroutine function, or an asynchronous generator function for a
    stream. spec : its request, if it is one. doc : in place of the function's own.
    """

    @overload
    def __init__(
        self: Operation[P, T, Coroutine[Any, Any, T]],
        function: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]],
        spec: Spec | None = None,
        doc: str | None = None,
    ) -> None: ...
    @overload
    def __init__(
        self: Operation[P, Iterator[T], AsyncIterator[T]],
        function: Callable[Concatenate[Any, P], AsyncGenerator[T]],
        spec: Spec | None = None,
        doc: str | None = None,
    ) -> None: ...
    def __init__(self, function: Callable[..., Any], spec: Spec | None = None, doc: str | None = None) -> None:
        self.function = function
        self.spec = spec
        self.__doc__ = doc or function.__doc__

    @overload
    def __get__(self, owner: None, kind: type) -> Self: ...
    @overload
    def __get__(self, owner: Remote[Blocking], kind: type) -> Callable[P, Called]: ...
    @overload
    def __get__(self, owner: Remote[Awaited], kind: type) -> Callable[P, Asked]: ...
    def __get__(self, owner: Remote[Any] | None, kind: type) -> Any:
        if owner is None:
            return self
        method, wire = MethodType(self.function, owner), owner.core.wire

        @wraps(method)
        def call(*args: Any, **options: Any) -> Any:
            steps = method(*args, **options)
            return wire.drive_each(steps) if isinstance(steps, AsyncGenerator) else wire.drive(steps)

        call.__doc__ = self.__doc__
        return call


class Fetched(Generic[T]):
    """A value that is fetched when it is asked for: an attribute on a `Client`, to be awaited on an `AsyncClient`."""

    def __init__(self, function: Callable[[Any], Coroutine[Any, Any, T]], doc: str | None = None) -> None:
        self.function = function
        self.__doc__ = doc or function.__doc__

    @overload
    def __get__(self, owner: None, kind: type) -> Self: ...
    @overload
    def __get__(self, owner: Remote[Blocking], kind: type) -> T: ...
    @overload
    def __get__(self, owner: Remote[Awaited], kind: type) -> Coroutine[Any, Any, T]: ...
    def __get__(self, owner: Remote[Any] | None, kind: type) -> Any:
        return self if owner is None else owner.core.wire.drive(self.function(owner))


def entry(
    line: str, declared: Callable[Concatenate[Any, P], T], doc: str | None = None, **details: Any
) -> Operation[P, T, Coroutine[Any, Any, T]]:
    """One request as an operation. declared : a function that says its parameters and what it answers, and does
    nothing. doc : in place of that function's own. details : see `Spec`.
    """
    spec = Spec(line, declared, kind=inspect.get_annotations(declared)["return"], **details)

    @wraps(declared)
    async def call(remote: Remote[Any], /, *args: P.args, **options: P.kwargs) -> T:
        result: T = await remote.core.content(spec.kind, **spec.request(remote, args, options))
        return result

    return Operation(call, spec, doc)


def endpoint(
    line: str, **details: Any
) -> Callable[[Callable[Concatenate[Any, P], T]], Operation[P, T, Coroutine[Any, Any, T]]]:
    """`entry` as a decorator."""
    return lambda declared: entry(line, declared, **details)


def stream(
    line: str, of: Callable[..., AsyncGenerator[T]]
) -> Callable[[Callable[Concatenate[Any, P], T]], Operation[P, Iterator[T], AsyncIterator[T]]]:
    """One request as a stream of what `of`, a method of `Core`, makes of its answer; declared as for `entry`."""

    def made(declared: Callable[Concatenate[Any, P], T]) -> Operation[P, Iterator[T], AsyncIterator[T]]:
        spec = Spec(line, declared, kind="stream")

        @wraps(declared)
        def call(remote: Remote[Any], /, *args: P.args, **options: P.kwargs) -> AsyncGenerator[T]:
            request = spec.request(remote, args, options)
            del request["method"]
            return of(remote.core, **request)

        return Operation(call, spec)

    return made


def _document(document: Mapping[str, Any] | str | bytes) -> Json:
    """A calibration as a body: slrig's own as JSON, OpenCV's files by how they begin."""
    if isinstance(document, Mapping):
        return {"json": document}
    begin = document[:1] if isinstance(document, str) else document[:1].decode("latin-1")
    kind = {"{": "json", "<": "xml"}.get(begin, "yaml")
    return {"content": document, "headers": {"Content-Type": f"application/{kind}"}}
