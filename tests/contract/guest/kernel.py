"""Debian's kernel, fetched by apt and unpacked into a cache folder: nothing is installed, nothing is loaded here."""

from __future__ import annotations

import lzma
import os
import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_METAPACKAGE = "linux-image-amd64"
_FETCH_TIMEOUT_S = 300.0


class GuestUnavailableError(Exception):
    """The guest cannot be run here. `fixable`: a person who may install packages can change that."""

    def __init__(self, reason: str, *, fixable: bool) -> None:
        super().__init__(reason)
        self.fixable = fixable


@dataclass(frozen=True, slots=True)
class Kernel:
    """An unpacked kernel. image : the bootable file; modules : its folder under lib/modules; busybox : a static one."""

    image: Path
    modules: Path
    busybox: Path

    def module_files(self, names: Sequence[str]) -> tuple[Path, ...]:
        """The files of these modules and of all that they depend on, in the order in which they can be loaded.

        Modules that are built into the kernel have no file. Raises LookupError: the kernel has no such module.
        """
        files = {_plain(path.name.split(".", 1)[0]): path for path in self.modules.rglob("*.ko*")}
        listed = (self.modules / "modules.builtin").read_text().split()
        builtin = {_plain(Path(line).name.removesuffix(".ko")) for line in listed}
        ordered: dict[Path, None] = {}

        def add(name: str) -> None:
            if name in builtin:
                return
            if name not in files:
                message = f"the kernel {self.modules.name} has no module '{name}'"
                raise LookupError(message)
            path = files[name]
            if path in ordered:
                return
            for needed in dependencies(read_module(path)):
                add(needed)
            ordered[path] = None

        for name in names:
            add(_plain(name))
        return tuple(ordered)


def read_module(path: Path) -> bytes:
    """A kernel module as the kernel loads it: uncompressed."""
    data = path.read_bytes()
    return lzma.decompress(data) if path.suffix == ".xz" else data


def dependencies(module: bytes) -> tuple[str, ...]:
    r"""The modules that a module says it depends on (the `depends` entry of its .modinfo section).

    >>> dependencies(b"..\0license=GPL\0depends=videodev,v4l2-dv-timings\0name=vivid\0")
    ('videodev', 'v4l2_dv_timings')
    """
    found = re.search(rb"\0depends=([^\0]*)\0", module)
    return tuple(_plain(name) for name in found.group(1).decode().split(",") if name) if found else ()


def _plain(module: str) -> str:
    return module.replace("-", "_")


def fetch_kernel() -> Kernel:
    """Debian's kernel and busybox, from the cache or by `apt-get download`.
    Raises GuestUnavailableError: this is no amd64 Debian, or apt cannot fetch.
    """
    if platform.system() != "Linux" or platform.machine() != "x86_64" or shutil.which("apt-get") is None:
        message = "the guest runs Debian's amd64 kernel on the interpreter of this machine, which is no amd64 Debian"
        raise GuestUnavailableError(message, fixable=False)
    cache = _cache()
    try:
        packages = (_kernel_package(), "busybox-static")
    except GuestUnavailableError:
        # Without apt's lists, a kernel that was fetched once will do.
        older = sorted(cache.glob("linux-image-*"))
        if not older:
            raise
        return _unpacked(older[-1])
    folder = cache / packages[0]
    if not folder.is_dir():
        with tempfile.TemporaryDirectory(dir=cache) as scratch:
            whole = Path(scratch) / "unpacked"
            for package in packages:
                _unpack(package, Path(scratch), whole)
            # Whole or not at all; if another run was faster, its folder is as good.
            if not folder.is_dir():
                whole.rename(folder)
    return _unpacked(folder)


def _cache() -> Path:
    # Programs in it are run: among everybody's temporary files it must be this user's own.
    cache = Path(os.environ.get("XDG_CACHE_HOME") or tempfile.gettempdir()) / f"slrig-guest-{os.getuid()}"
    cache.mkdir(parents=True, exist_ok=True, mode=0o700)
    if cache.stat().st_uid != os.getuid():
        message = f"{cache} belongs to another user; remove it"
        raise GuestUnavailableError(message, fixable=True)
    return cache


def _unpacked(folder: Path) -> Kernel:
    image = next((folder / "boot").glob("vmlinuz-*"))
    modules = next(path for path in _first(folder, "usr/lib/modules", "lib/modules").iterdir() if path.is_dir())
    return Kernel(image, modules, _first(folder, "usr/bin/busybox", "bin/busybox"))


def _first(folder: Path, *candidates: str) -> Path:
    return next(folder / candidate for candidate in candidates if (folder / candidate).exists())


def _kernel_package() -> str:
    listed = _run(["apt-cache", "depends", _METAPACKAGE], Path.cwd())
    found = re.search(r"Depends: (linux-image-\S+)", listed)
    if found is None:
        message = f"apt knows no {_METAPACKAGE}; run: apt-get update"
        raise GuestUnavailableError(message, fixable=False)
    return found.group(1)


def _unpack(package: str, scratch: Path, target: Path) -> None:
    # As root, apt fetches as a user of its own, who may not write here.
    _run(["apt-get", "-q", "-o", f"APT::Sandbox::User={_user()}", "download", package], scratch)
    archive = next(scratch.glob(f"{package}_*.deb"))
    _run(["dpkg", "-x", str(archive), str(target)], scratch)


def _user() -> str:
    return "root" if os.getuid() == 0 else ""


def _run(command: list[str], folder: Path) -> str:
    try:
        finished = subprocess.run(  # noqa: S603 - our own words
            command, cwd=folder, capture_output=True, text=True, check=True, timeout=_FETCH_TIMEOUT_S
        )
    except (OSError, subprocess.SubprocessError) as error:
        said = getattr(error, "stderr", None) or ""
        message = f"apt cannot fetch Debian's kernel ({error}): {said.strip()[-500:]}"
        raise GuestUnavailableError(message, fixable=False) from error
    return finished.stdout
