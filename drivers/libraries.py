"""Loading of the libraries that drivers need: every failure becomes one error that states how to install them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from slrig.errors import LibraryMissingError


@contextmanager
def loading(driver: str, library: str, *, install: str, packages: str, where: str = "") -> Iterator[None]:
    """Turn any exception of the imports in the block into LibraryMissingError.

    A library that is installed may raise anything: ValueError ("numpy.dtype size changed") and AttributeError where it
    was built for another version of numpy or glib, ImportError and OSError where a library beneath it is missing.

    driver : its name in rig files. library : its name, for the message. install : the command that installs it.
    packages : names by which pip builds it again. where : remark on how to run the command.
    """
    try:
        yield
    except Exception as cause:
        state = "is not installed"
        if not isinstance(cause, ModuleNotFoundError):
            state = "is installed and cannot be loaded, perhaps because it was built for other versions"
            install = f"{install} && pip install --force-reinstall --no-deps --no-cache-dir {packages}"
        found = f"{type(cause).__name__}: {cause}"
        message = f"driver '{driver}' needs {library}, which {state} ({found}): {install}{where}"
        raise LibraryMissingError(message, install=install) from cause
