"""`slrig report`: what a person with a bench can send to those who have none, one ZIP file of text and JSON."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import typer

from slrig import KEY_VARIABLE
from slrig.bundle import read_text
from slrig.cli.display import progress_shown
from slrig.cli.examine import examined_by
from slrig.cli.options import ServiceOptions
from slrig.cli.rig_file import devices_document
from slrig.cli.scan import rig_service, scan_with
from slrig.client import Client
from slrig.discovery import discover_devices, installed_drivers
from slrig.disk import staging_name, storage_errors
from slrig.doctor import EXAMINATIONS, refuse_existing
from slrig.errors import ConfigError, ServiceError, SlrigError, UnsupportedByDeviceError
from slrig.jobs.listener import Listener
from slrig.jobs.records import JobKind, utc_now
from slrig.scan.formats import BUNDLE_ZIP

_MEANINGS = {
    "versions.json": "slrig, its packages, Python, the system, the kind of the session on its screen",
    "devices.json": "drivers, what is plugged in with its serial numbers, libraries that are missing",
    "tools.txt": "what lsusb, v4l2-ctl (with all controls), arv-tool-0.8 and xrandr say",
    "dmesg.txt": "the end of the kernel's log",
    "rig.toml": "the rig file",
    "rig.json": "the rig as the service has it",
    **{f"{kind}.json": f"what slrig {kind} found" for kind in (JobKind.DOCTOR, JobKind.LATENCY)},
    "conformance.json": "what slrig conform found",
    "scan-1": "one scan: report.json; pictures if requested",
    "scan-2": "a second one, of what should not have moved",
    "service.log": "what the service of this command wrote",
}
_TOOLS = ("lsusb", "lsusb -t", "v4l2-ctl --list-devices", "arv-tool-0.8 features", "xrandr --prop")
_CONTROLS = "v4l2-ctl --all --list-formats-ext --list-ctrls-menus --device"
_TOOL_LIMIT_S = 20.0
_LOG_LINES = 500
_SESSION = ("XDG_SESSION_TYPE", "XDG_CURRENT_DESKTOP", "DISPLAY", "WAYLAND_DISPLAY")
_USB_MEMORY = Path("/sys/module/usbcore/parameters/usbfs_memory_mb")
_MOST_BYTES = 2**20
_PICTURES = ("preview.png", BUNDLE_ZIP)

# A login in an address, and values of options of that name.
_LOGIN = re.compile(r"(?<=://)[^/\s\"'@]+(?=@)")
_SECRET = re.compile(r"(?im)^([ \t]*[\w.\"-]*(?:password|passphrase|secret|token|login)[\w.\"-]*[ \t]*=[ \t]*)\S.*$")

_Files = Mapping[str, str | bytes]


class _Parts:
    """The parts that were gathered into a ZIP file, and why others are missing."""

    def __init__(self, file: ZipFile, listener: Listener) -> None:
        self.missing: dict[str, str] = {}
        self._file = file
        self._listener = listener

    def add(self, name: str, gather: Callable[[Listener], _Files]) -> None:
        """Add the files of a part, or say why it is missing, and go on."""
        part = self._listener.part(list(_MEANINGS).index(name), len(_MEANINGS), name)
        part.report("gathering", 0.0, "")
        try:
            files = gather(part)
        except Exception as error:  # noqa: BLE001 - after any error the other parts can be sent
            self.missing[name] = str(error) if isinstance(error, SlrigError) else f"{type(error).__name__}: {error}"
            return
        for path, content in files.items():
            self._file.writestr(path, _without_secrets(content) if isinstance(content, str) else content)

    def contents(self) -> str:
        """README.txt of the file."""
        there = {path.partition("/")[0] for path in self._file.namelist()}
        lines = [f"A report of slrig {version('slrig')} about a bench, {utc_now():%Y-%m-%d %H:%M} UTC.", ""]
        lines += [f"{name:<18}{meaning}" for name, meaning in _MEANINGS.items() if name in there]
        lines += [f"{'missing':<18}{name}: {cause}" for name, cause in self.missing.items()]
        if not any(path.endswith(_PICTURES) for path in self._file.namelist()):
            lines += ["", "It holds no pictures: --pictures adds them."]
        return _without_secrets("\n".join(lines) + "\n")


def write_report(rig_file: Path | None, service: ServiceOptions, output: Path, *, pictures: bool, force: bool) -> None:
    """Gather all that can be had of this machine and of a rig, and print what could not.

    rig_file : of the rig, which a service of this command opens; None for the rig of the running service.
    Raises ConfigError: the file exists, there is no such rig file, or the file of the key cannot be read; StorageError.
    """
    refuse_existing(output, force=force)
    staging = staging_name(output)
    with TemporaryDirectory(prefix="slrig-") as folder, storage_errors(output), progress_shown() as display:
        scratch = Path(folder)
        try:
            with ZipFile(staging, "w", ZIP_DEFLATED) as file:
                parts = _Parts(file, Listener(report=display))
                parts.add("versions.json", lambda _: {"versions.json": _json(_versions())})
                parts.add("devices.json", lambda _: {"devices.json": _json(_devices())})
                parts.add("tools.txt", lambda _: {"tools.txt": _tools()})
                parts.add("dmesg.txt", lambda _: {"dmesg.txt": _kernel_log()})
                if rig_file is not None:
                    parts.add("rig.toml", lambda _: {"rig.toml": read_text(rig_file, _MOST_BYTES, ConfigError)})
                try:
                    with service.client() if rig_file is None else rig_service(rig_file, scratch, display) as client:
                        _add_rig(parts, client, scratch, pictures=pictures)
                except ServiceError as error:
                    parts.missing["all of the rig itself"] = str(error)
                if (log := scratch / "service.log").is_file():
                    parts.add("service.log", lambda _: {"service.log": log.read_text(errors="replace")})
                file.writestr("README.txt", parts.contents())
            staging.replace(output)
        finally:
            staging.unlink(missing_ok=True)
    for name, cause in parts.missing.items():
        typer.echo(f"{'missing':<10}{name}: {cause}", err=True)
    typer.echo(f"{'report':<10}{output}")
    typer.echo(f"{'to send':<10}check it first; its README.txt says what is what")


def _add_rig(parts: _Parts, client: Client, scratch: Path, *, pictures: bool) -> None:
    """Add what a service says and finds of its rig. Raises ServiceError: there is none."""
    rig = client.rig.get()
    parts.add("rig.json", lambda _: {"rig.json": _json(rig)})
    for kind in EXAMINATIONS:

        def examined(part: Listener, kind: JobKind = kind) -> _Files:
            return {f"{kind}.json": _json(examined_by(client, kind, {}, part)[0])}

        parts.add(f"{kind}.json", examined)
    files = ("report.json", *(_PICTURES if pictures else ()))
    for name in ("scan-1", "scan-2"):

        def scanned(part: Listener, name: str = name) -> _Files:
            scan_with(client, {"label": "slrig report"}, scratch / name, part, files=files)
            report = {f"{name}/report.json": (scratch / name / "report.json").read_text(encoding="utf-8")}
            return report | {f"{name}/{each}": (scratch / name / each).read_bytes() for each in files[1:]}

        parts.add(name, scanned)


def _versions() -> dict[str, object]:
    packages = {}
    for name in sorted({re.split(r"[^\w.-]", each)[0] for each in requires("slrig") or ()}):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "not installed"
    system = platform.uname()
    return {
        "slrig": version("slrig"),
        "python": platform.python_version(),
        "system": [system.system, system.release, system.version, system.machine],
        "distribution": platform.freedesktop_os_release().get("PRETTY_NAME"),
        "processors": os.cpu_count(),
        "session": {name: os.environ.get(name) for name in _SESSION},
        "usbfs_memory_mb": _USB_MEMORY.read_text().strip() if _USB_MEMORY.is_file() else None,
        "packages": packages,
    }


def _devices() -> dict[str, Any]:
    return devices_document(installed_drivers(), discover_devices())


def _tools() -> str:
    nodes = sorted(str(each) for each in Path("/dev").glob("video*"))
    return "\n".join(f"$ {each}\n{_said(each)[1]}" for each in (*_TOOLS, *(f"{_CONTROLS} {node}" for node in nodes)))


def _kernel_log() -> str:
    code, said = _said("dmesg")
    if code:
        message = f"{said.strip()}; run: sudo dmesg | tail -n {_LOG_LINES} > dmesg.txt, and send that file, too"
        raise UnsupportedByDeviceError(message)
    return "\n".join(said.splitlines()[-_LOG_LINES:])


def _said(command: str) -> tuple[int, str]:
    """Exit code of a tool, and its output or the cause of its failure."""
    try:
        done = subprocess.run(  # noqa: S603 - tools of the system, named above
            command.split(), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False,
            timeout=_TOOL_LIMIT_S, encoding="utf-8", errors="replace",
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        return 1, f"{error}\n"
    return done.returncode, done.stdout


def _json(document: object) -> str:
    return json.dumps(document, indent=2, ensure_ascii=False, default=str)


def _without_secrets(text: str) -> str:
    """Text without logins, keys, and the name of this user.

    >>> _without_secrets('device = "rtsp://me:pw@10.0.0.2/live"')
    'device = "rtsp://…@10.0.0.2/live"'
    >>> _without_secrets('mqtt_password = "x y" # of the broker')
    'mqtt_password = …'
    """
    for known, instead in ((os.environ.get(KEY_VARIABLE), "…"), (str(Path.home()), "~")):
        if known and known != "/":
            text = text.replace(known, instead)
    return _SECRET.sub(r"\1…", _LOGIN.sub("…", text))
