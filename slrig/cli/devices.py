"""`slrig devices`: what is installed, what is plugged in."""

from __future__ import annotations

import json
from dataclasses import asdict

import typer
from rich.console import Console
from rich.table import Table

from slrig.discovery import found_devices, installed_drivers


def list_devices(*, as_json: bool) -> None:
    """Print the drivers that are installed and the devices that are plugged in."""
    drivers = installed_drivers()
    found = found_devices()
    if as_json:
        document = {
            "drivers": [asdict(driver) for driver in drivers],
            "devices": [asdict(device) for device in found.devices],
            "faults": [str(fault) for fault in found.faults],
        }
        typer.echo(json.dumps(document, indent=2))
        return
    console = Console()
    table = Table("driver", "for a", "package", "state", title="Installed drivers", title_justify="left", box=None)
    for driver in drivers:
        package = f"{driver.package} {driver.version}".strip()
        table.add_row(driver.name, driver.kind, package, "ok" if driver.fault is None else driver.fault)
    console.print(table)
    console.print()
    if found.devices:
        plugged = Table("driver", "device", "what it is", title="Plugged-in devices", title_justify="left", box=None)
        for device in found.devices:
            plugged.add_row(device.driver, device.device, device.label)
        console.print(plugged)
    else:
        console.print(
            "No device is plugged in that an installed driver can find. A rendered rig needs none: slrig demo"
        )
    for fault in found.faults:
        console.print(f"[red]fault[/red] {fault}")
