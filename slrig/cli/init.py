"""`slrig init`: from what is plugged in to a rig file. What it cannot know it asks, or takes as options."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import typer

from slrig.bundle.storage import write_file
from slrig.cli.rig_draft import Draft, Part, device_key, failure_of, rig_text, split_assignment, split_device, typed
from slrig.devices import FoundDevice
from slrig.discovery import Findings, found_devices
from slrig.doctor.rig_file import refuse_existing
from slrig.errors import ConfigError, DeviceGoneError
from slrig.option_models import kinds_of

Answer = TypeVar("Answer")

_NAMES = {1: ("camera",), 2: ("left", "right")}


@dataclass(frozen=True, slots=True)
class Asked:
    """What the options of the command say. cameras : [NAME=]DRIVER[:DEVICE]; settings : TABLE.KEY=VALUE."""

    name: str
    cameras: Sequence[str]
    projector: str | None
    settings: Sequence[str]
    exposure_s: float | None


def init(asked: Asked, output: Path, *, yes: bool, force: bool) -> None:
    """Write a rig file for what is plugged in or named, and say what comes next.

    Raises
    ------
    ConfigError
        A file would be overwritten, an answer is wrong, or something is not known and there is nobody to ask.
    DeviceGoneError
        No camera or no projector is plugged in, and none is named.
    SlrigError
        A named driver is not installed or broken, or the disk refused.
    """
    refuse_existing(output, force=force)
    ask = not yes and terminal()
    found = found_devices()
    cameras = _named_cameras(asked.cameras, found) if asked.cameras else None
    projector = _named("projector", asked.projector, found, "projector") if asked.projector is not None else None
    offered = {kind: _of_kind(found, kind) for kind in ("camera", "projector", "head")}
    _refuse_nothing(offered, found, cameras=cameras is not None, projector=projector is not None)
    if cameras is None:
        cameras = _chosen_cameras(offered["camera"], ask=ask)
    if projector is None:
        projector = _chosen_projector(offered["projector"], ask=ask)
    draft = Draft(asked.name, projector, cameras, _exposure_s(asked.exposure_s, ask=ask))
    draft = draft.with_settings([split_assignment(each, draft) for each in asked.settings])
    for part in draft.parts:
        _complete(part, ask=ask)
    write_file(output, rig_text(draft, output).encode())
    _tell(draft, output)


def terminal() -> bool:
    """Whether somebody can be asked."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _of_kind(found: Findings, kind: str) -> tuple[FoundDevice, ...]:
    return tuple(device for device in found.devices if kind in kinds_of(device.driver))


def _named_cameras(texts: Sequence[str], found: Findings) -> tuple[Part, ...]:
    parts = []
    for number, text in enumerate(texts):
        name, _, rest = text.partition("=") if "=" in text.partition(":")[0] else ("", "", text)
        parts.append(_named("camera", rest, found, name or _name(number, len(texts))))
    return tuple(parts)


def _named(kind: str, text: str, found: Findings, name: str) -> Part:
    """What DRIVER:DEVICE means; a driver alone means its only device."""
    driver, device = split_device(text, kind)
    devices = [each for each in found.devices if each.driver == driver]
    if not device and len(devices) > 1:
        message = f"--{kind} {text}: {_listed(devices)}; name one of them: --{kind} {driver}:{devices[0].device}"
        raise ConfigError(message)
    label = next((each.label for each in devices if device in ("", each.device)), "")
    return _part(kind, driver, device or next((each.device for each in devices), ""), label, name)


def _part(kind: str, driver: str, device: str, label: str, name: str) -> Part:
    options: dict[str, Any] = {}
    if device:
        key, kinds = device_key(driver)
        options[key] = typed(device, kinds)
    return Part(kind, driver, label, options, name)


def _chosen_cameras(offered: Sequence[FoundDevice], *, ask: bool) -> tuple[Part, ...]:
    chosen = list(offered)
    if ask:
        _offer("Cameras", offered)
        everyone = " ".join(str(number + 1) for number in range(len(offered)))
        _say("Give the numbers of those of the rig, left to right; one that holds several cameras may be given twice.")
        chosen = _ask("Cameras", everyone, lambda text: [_numbered(offered, each) for each in text.split()])
    return tuple(
        _part("camera", each.driver, each.device, each.label, _name(number, len(chosen)))
        for number, each in enumerate(chosen)
    )


def _chosen_projector(offered: Sequence[FoundDevice], *, ask: bool) -> Part:
    if len(offered) > 1 and not ask:
        one = f"{offered[0].driver}:{offered[0].device}"
        message = f"{len(offered)} devices may be the projector: {_listed(offered)}; name it: --projector {one}"
        raise ConfigError(message)
    chosen = offered[0]
    if ask:
        _offer("Projectors", offered)
        usual = "1" if len(offered) == 1 else None
        chosen = _ask("Projector", usual, lambda text: _numbered(offered, text))
    return _part("projector", chosen.driver, chosen.device, chosen.label, "projector")


def _exposure_s(given: float | None, *, ask: bool) -> float:
    usual = 0.0167
    if given is None and ask:
        _say("\nOn a video projector, expose for whole refresh periods: 0.0167 s, 0.0333 s and so on at 60 Hz.")
        return _ask("Exposure, s", str(usual), float)
    return usual if given is None else given


def _complete(part: Part, *, ask: bool) -> None:
    """Ask for what the driver needs and the rig file does not say."""
    for needed in part.lacking():
        if not ask:
            message = (
                f"{part.title} needs {needed.name}: {needed.told}\n  say it with --set {part.name}.{needed.name}=VALUE"
            )
            raise ConfigError(message)
        _say(f"\n{part.title} needs {needed.name}: {needed.told}")

        def answer(text: str, key: str = needed.name, kinds: frozenset[str] = needed.kinds) -> object:
            value = typed(text, kinds)
            if fault := failure_of(part.driver, {**part.options, key: value}, key):
                raise ConfigError(fault)
            return value

        part.options[needed.name] = _ask(needed.name, None, answer)


def _ask(question: str, usual: str | None, read: Callable[[str], Answer]) -> Answer:
    """Ask until the answer can be read."""
    while True:
        text = str(typer.prompt(question, default=usual)).strip()
        try:
            return read(text)
        except (ConfigError, ValueError) as error:
            _say(str(error).strip())


def _say(text: str) -> None:
    """Print a sentence that fits the terminal."""
    if text.startswith("\n"):
        typer.echo()
    typer.echo(textwrap.fill(text.strip(), min(shutil.get_terminal_size().columns, 100)))


def _numbered(offered: Sequence[FoundDevice], text: str) -> FoundDevice:
    if not text.isdigit() or not 1 <= int(text) <= len(offered):
        message = f"expected a number from 1 to {len(offered)}, found '{text}'"
        raise ConfigError(message)
    return offered[int(text) - 1]


def _name(number: int, count: int) -> str:
    return _NAMES[count][number] if count in _NAMES else f"camera{number + 1}"


def _offer(title: str, offered: Sequence[FoundDevice]) -> None:
    typer.echo(f"\n{title} that are plugged in:")
    for number, device in enumerate(offered, 1):
        typer.echo(f"  {number}  {device.label}\n     {device.driver}:{device.device}")


def _listed(devices: Sequence[FoundDevice]) -> str:
    return "".join(f"\n  {each.driver}:{each.device}  {each.label}" for each in devices) + "\n"


def _refuse_nothing(
    offered: Mapping[str, Sequence[FoundDevice]], found: Findings, *, cameras: bool, projector: bool
) -> None:
    """Raise DeviceGoneError, with what to check, where a camera or a projector is neither named nor plugged in."""
    lacking = [
        kind for kind, named in (("camera", cameras), ("projector", projector)) if not named and not offered[kind]
    ]
    if not lacking:
        return
    there = [f"{each.driver}:{each.device}" for kind in ("camera", "projector") for each in offered[kind]]
    lines = [
        f"no {' and no '.join(lacking)} is plugged in that an installed driver can find",
        *([f"  found: {', '.join(there)}"] if there else []),
        "  check cable and power, and your right to open the device: slrig devices tells what it sees",
    ]
    if "projector" in lacking:
        lines.append(
            "  a projector on HDMI must be switched on and a display of its own, in a session of X (see DISPLAY)"
        )
    lines += [f"  more can be found after, for {each.driver}: {each.install}" for each in found.missing]
    lines += [f"  not looked for: {fault}" for fault in found.faults]
    for head in offered["head"]:
        lines.append(f"  {head.driver}:{head.device} is camera and projector in one: write a [head] table for it")
    flags = " ".join(f"--{kind} DRIVER:DEVICE" for kind in lacking)
    lines.append(f"  name what cannot be found: slrig init {flags}")
    lines.append("  without any hardware there is a rendered rig: slrig demo, or slrig serve config/rigs/demo.toml")
    raise DeviceGoneError("\n".join(lines))


def _tell(draft: Draft, output: Path) -> None:
    cameras = ", ".join(f"{each.name} ({each.driver})" for each in draft.cameras)
    _say(f"\nWrote {output}: projector ({draft.projector.driver}), {cameras}. No device was opened. Next:")
    better = output.with_stem(f"{output.stem}-measured")
    steps = (
        (f"slrig doctor {output} --output {better}", "light, focus, timing; a file with what it measured"),
        (f"slrig serve {better}", "the service; it prints a key for the next steps"),
        ("slrig calibrate board --output board.pdf", "a board to print"),
        ("slrig calibrate run", "walks you through its poses"),
        ("slrig scan", "the first mesh"),
    )
    for number, (command, why) in enumerate(steps, 1):
        typer.echo(f"  {number}. {command}\n     {why}")
