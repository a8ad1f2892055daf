"""`slrig demo`: the whole walk on a rendered rig, through the real service in a process of its own."""

from __future__ import annotations

import json
import os
import secrets
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

import slrig
from slrig import KEY_VARIABLE
from slrig.cli.display import counted, progress_shown
from slrig.cli.scan import scan_with, tell_result
from slrig.client import Client
from slrig.disk import storage_errors
from slrig.errors import ConfigError, ServiceError
from slrig.scan.plan import ProgressCallback
from slrig.scan.soundness import truth_notes

START_LIMIT_S = 120.0
STOP_LIMIT_S = 10.0
_POLL_S = 0.05
_SERVICE_SHARE = 0.05
LABEL = "demo"


def run_demo(rig: Path | None, output: Path) -> None:
    """Start a service, scan, fetch, compare, tell; the service is gone afterwards.

    Raises ConfigError where there is no such rig file, ServiceError where no service starts or the scan fails.
    """
    rig = _rig_file(rig)
    data = output / "service"
    with storage_errors(data):
        data.mkdir(parents=True, exist_ok=True)
    key = secrets.token_urlsafe(32)
    with progress_shown() as display:
        display("starting the service", 0.0, str(rig))
        with _service(rig, data, key) as process, Client(_url(process, data), key) as client:
            _await_ready(process, client, data, display)

            def shown(stage: str, fraction: float, detail: str) -> None:
                display(stage, _SERVICE_SHARE + (1 - _SERVICE_SHARE) * fraction, detail)

            scan = scan_with(client, {"label": LABEL}, output, display=shown)
            removed = remove_earlier(client, scan)
    tell_result(scan, output)
    if removed:
        typer.echo(f"{'removed':<10}{counted(removed, 'earlier demo scan')} of rig '{scan['rig']}' from {data}")
    bundle = data / "scans" / scan["id"] / "bundle"
    _tell_next(rig, bundle, output)
    require_sound(scan)


def require_sound(scan: Mapping[str, Any]) -> None:
    """End with exit code 1 if the mesh is not the surface that is known to be there. Its notes say what is wrong."""
    if truth_notes((scan.get("summary") or {}).get("truth") or {}):
        raise typer.Exit(1)


def _rig_file(given: Path | None) -> Path:
    wanted = given or Path("config/rigs/demo.toml")
    checkout = Path(slrig.__file__).resolve().parent.parent
    for folder in (Path(), checkout) if given is None else (Path(),):
        if (folder / wanted).is_file():
            return folder / wanted
    message = f"There is no rig file {wanted}. Run the demo in slrig's checkout, or name a rig file: slrig demo RIG."
    raise ConfigError(message)


@contextmanager
def _service(rig: Path, data: Path, key: str) -> Iterator[subprocess.Popen[bytes]]:
    (data / "service.json").unlink(missing_ok=True)
    command = [sys.executable, "-m", "slrig.cli", "serve", str(rig), "--port", "0", "--until-eof"]
    with (data / "service.log").open("wb") as log:
        process = subprocess.Popen(  # noqa: S603 - our own command
            [*command, "--host", "127.0.0.1", "--data", str(data)],
            # Nothing is ever written: the pipe ends with this process, and the service with the pipe.
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={"SLRIG_LOG_FORMAT": "text", **os.environ, KEY_VARIABLE: key},
            # Ctrl-C is for the client: it cancels the scan, and then ends the service.
            start_new_session=True,
        )
    try:
        yield process
    finally:
        if process.stdin is not None:
            process.stdin.close()
        process.terminate()
        try:
            process.wait(STOP_LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _url(process: subprocess.Popen[bytes], data: Path) -> str:
    address = data / "service.json"
    deadline = time.monotonic() + START_LIMIT_S
    while not address.is_file():
        _require_alive(process, data, deadline)
        time.sleep(_POLL_S)
    url: str = json.loads(address.read_text(encoding="utf-8"))["url"]
    return url


def _await_ready(process: subprocess.Popen[bytes], client: Client, data: Path, display: ProgressCallback) -> None:
    deadline = time.monotonic() + START_LIMIT_S
    told = ""
    while (missing := still_missing(client)) is not None:
        if missing != told:
            # A slow machine is no reason to give up, as long as it gets on.
            told, deadline = missing, time.monotonic() + START_LIMIT_S
            display("opening the rig", 0.0, missing)
        _require_alive(process, data, deadline)
        time.sleep(_POLL_S)


def still_missing(client: Client) -> str | None:
    """What the service's rig waits for, None once it is open. Raises ServiceError with what is wrong.

    The reconstruction is not waited for: its kernels are prepared while the frames are taken. How far they are is told.
    """
    try:
        now = client.system.readiness()
    except ServiceError:
        return "the service is starting"
    found: str = now["checks"].get("rig", "")
    if found == "ok":
        return None
    if "rig" not in now["pending"]:
        message = f"The rig cannot be opened: {found}"
        raise ServiceError(message)
    return f"{found}; {now['checks'].get('reconstruction', '')}" if "reconstruction" in now["pending"] else found


def remove_earlier(client: Client, scan: Mapping[str, Any]) -> int:
    """Delete the scans that earlier demos made with the same rig, and no others; return how many."""
    page: dict[str, Any] = {"next": "/scan?limit=200"}
    scans: list[dict[str, Any]] = []
    while page["next"] is not None:
        page = client.get(page["next"])
        scans += page["scans"]
    ours = [each for each in scans if (each["label"], each["rig"]) == (LABEL, scan["rig"]) and each["id"] != scan["id"]]
    for old in ours:
        client.delete(old["links"]["self"])
    return len(ours)


def _require_alive(process: subprocess.Popen[bytes], data: Path, deadline: float) -> None:
    log = data / "service.log"
    if process.poll() is not None:
        tail = "\n".join(log.read_text(encoding="utf-8", errors="replace").splitlines()[-8:])
        message = f"The service ended before it was ready, with exit code {process.returncode}. Its last words:\n{tail}"
        raise ServiceError(message)
    if time.monotonic() > deadline:
        message = f"The service was not ready within {START_LIMIT_S:.0f} s. Its log is {log}."
        raise ServiceError(message)


def _tell_next(rig: Path, bundle: Path, output: Path) -> None:
    live, again = (shlex.quote(str(output.parent / f"{output.name}-{end}")) for end in ("live", "again"))
    # Paths in a rig file are relative to it, so that a copy belongs beside it.
    rig_text, own, bundle_text = (shlex.quote(str(path)) for path in (rig, rig.with_name("my-rig.toml"), bundle))
    # As it was called: in a fresh checkout that is .venv/bin/slrig, and no slrig is on the path.
    program = shlex.quote(sys.argv[0]) if Path(sys.argv[0]).name == "slrig" else "slrig"
    typer.echo(
        f"""
Next:
  1. Your own rig: copy a rig file, change it, and run it.
       cp {rig_text} {own}
       {program} demo {own}
  2. A live service: start it, and scan with it from another terminal, with the key that it prints.
       {program} serve {rig_text}
       {KEY_VARIABLE}=KEY {program} scan --output {live}
  3. A recorded bundle: reconstruct this scan, or one of yours, again.
       {program} reconstruct {bundle_text} --output {again}"""
    )
