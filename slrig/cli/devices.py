"""`slrig devices`: what is installed, what is plugged in, what is missing, and the commands that put it right."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict, dataclass

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from slrig.cli.display import print_json
from slrig.discovery import DiscoveredDevices, InstalledDriver, discover_devices, installed_drivers

_STDOUT, _STDERR = 1, 2


@dataclass(frozen=True, slots=True)
class BrokenPackage:
    """An installed package with a driver that cannot be loaded: why, and the command that removes the package."""

    package: str
    drivers: tuple[str, ...]
    fault: str
    remove: str


def list_devices(*, as_json: bool) -> None:
    """Print the drivers that are installed, the devices that are plugged in, and what is missing to drive more."""
    with _only_ours_on_stdout():
        drivers = installed_drivers()
        found = discover_devices()
    broken = broken_packages(drivers)
    if as_json:
        document = {
            "drivers": [asdict(driver) for driver in drivers],
            "devices": [asdict(device) for device in found.devices],
            "missing": [asdict(library) for library in found.missing],
            "broken": [asdict(package) for package in broken],
            "elsewhere": [asdict(driver) for driver in found.elsewhere],
            "faults": [str(fault) for fault in found.faults],
        }
        print_json(document)
        return
    console = Console()
    _tell_drivers(drivers, found, console)
    _tell_devices(found, console)
    _tell_remedies(found, broken, {driver.fault for driver in drivers})


def broken_packages(drivers: Sequence[InstalledDriver]) -> tuple[BrokenPackage, ...]:
    """The packages whose drivers cannot be loaded, by name, each with the first of its faults."""
    faulty = [driver for driver in drivers if driver.fault is not None]
    return tuple(
        BrokenPackage(
            package,
            tuple(sorted({driver.name for driver in faulty if driver.package == package})),
            next(driver.fault or "" for driver in faulty if driver.package == package),
            f"pip uninstall {package}",
        )
        for package in sorted({driver.package for driver in faulty})
    )


def _tell_drivers(drivers: Sequence[InstalledDriver], found: DiscoveredDevices, console: Console) -> None:
    missing = {library.driver for library in found.missing}
    elsewhere = {driver.driver for driver in found.elsewhere}
    table = _table("Installed drivers", "driver", "for a", "package", "state")
    for driver in drivers:
        if driver.kind == "finder":
            continue
        state = "ok"
        if driver.fault is not None:
            state = "broken, see below"
        elif driver.name in missing:
            state = "its library is missing, see below"
        elif driver.name in elsewhere:
            state = "not on this system, see below"
        package = f"{driver.package} {driver.version}".strip()
        table.add_row(escape(driver.name), driver.kind, escape(package), state)
    console.print(table)
    console.print()


def _tell_devices(found: DiscoveredDevices, console: Console) -> None:
    if not found.devices:
        console.print(
            "No device is plugged in that an installed driver can find. Check cable and power; if the system does see "
            "the device, check your right to open it. A rendered rig needs none: slrig demo"
        )
        return
    table = _table("Plugged-in devices", "driver", "device", "what it is")
    for device in found.devices:
        table.add_row(escape(device.driver), escape(device.device), escape(device.label))
    console.print(table)
    console.print("\nslrig init writes a rig file for them. Every option: slrig devices --options DRIVER")


def _tell_remedies(found: DiscoveredDevices, broken: Sequence[BrokenPackage], told: set[str | None]) -> None:
    # Neither wrapped nor styled: commands are there to be copied whole.
    if found.missing:
        typer.echo("\nMore devices can be used after:")
        for library in found.missing:
            typer.echo(f"  {library.driver}: {library.install}")
    if found.elsewhere:
        typer.echo("\nNot on this system:")
        for other in found.elsewhere:
            typer.echo(f"  {other.message}")
    for package in broken:
        names = ", ".join(package.drivers)
        typer.echo(f"\nBroken: package {package.package} (drivers: {names}); the others work without it.")
        typer.echo(f"  {package.fault}\n  to remove it: {package.remove}")
    # A finder that cannot be loaded was told with its package.
    for fault in map(str, found.faults):
        if fault not in told:
            typer.echo(f"\nNot looked for: {fault}")


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=None)
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


@contextmanager
def _only_ours_on_stdout() -> Iterator[None]:
    """Send what drivers and their libraries, Python or not, write on standard output to standard error."""
    sys.stdout.flush()
    ours = os.dup(_STDOUT)
    try:
        os.dup2(_STDERR, _STDOUT)
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(ours, _STDOUT)
        os.close(ours)
