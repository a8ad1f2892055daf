"""`slrig schedule`: what a running service does by the clock."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slrig.cli.options import AsJson, ServiceOptions, by_beginning, given, grouped
from slrig.errors import ScheduleError, ScheduleNotFoundError

if TYPE_CHECKING:
    from slrig.client import Client

app = typer.Typer(no_args_is_help=True, help="Work for the rig at set times.")

ScheduleId = Annotated[
    str, typer.Argument(metavar="ID", help="Id of the schedule, or the beginning of it that no other has.")
]


@app.command()
@grouped
def add(
    *,
    cron: Annotated[
        str, typer.Argument(metavar="CRON", help="Five fields: '30 6 * * mon-fri' is 06:30 on working days.")
    ],
    task: Annotated[str, typer.Argument(metavar="TASK", help="verification, calibration or acceptance.")],
    time_zone: Annotated[str, typer.Option(help="Time zone of the expression, such as Europe/Berlin.")] = "UTC",
    label: Annotated[str | None, typer.Option(help="Free text, to find the schedule again.")] = None,
    option: Annotated[
        list[str] | None, typer.Option(help="Of the task, as name=value; the value is JSON or text. May be repeated.")
    ] = None,
    grace_s: Annotated[float | None, typer.Option(help="How late a run may start, seconds. Default 3600.")] = None,
    retry_s: Annotated[
        float | None, typer.Option(help="How often a rig that is busy, or fails, is tried again, s. Default 60.")
    ] = None,
    catch_up: Annotated[
        bool, typer.Option("--catch-up/--no-catch-up", help="After a long pause, run once for what was missed.")
    ] = True,
    paused: Annotated[bool, typer.Option("--paused", help="Put it on record without starting it.")] = False,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """Schedule work of a service.

    Shows the next five times.
    """
    request = {
        "cron": cron,
        "task": task,
        "time_zone": time_zone,
        "catch_up": catch_up,
        "enabled": not paused,
        "options": _options(option or []),
        **given(label=label, grace_s=grace_s, retry_s=retry_s),
    }
    with service.client() as client:
        _print_schedule(client.post("/schedule", request), as_json=as_json)


@app.command(name="list")
@grouped
def list_schedules(service: ServiceOptions, as_json: AsJson = False) -> None:
    """List schedules with the time that each is due next."""
    from slrig.cli.display import print_json, print_table

    with service.client() as client:
        found = client.get("/schedule")
    if as_json:
        print_json(found)
        return
    if not found["schedules"]:
        typer.echo("no schedules; add one with: slrig schedule add '30 6 * * mon-fri' verification")
        return
    rows = [
        (
            each["id"][:8],
            each["task"],
            each["cron"],
            f"{_clock(each['upcoming'][0]) if each['enabled'] else 'paused'}  {each['time_zone']}",
            each["label"] or "",
        )
        for each in found["schedules"]
    ]
    print_table(("id", "task", "when", "next", "label"), rows)


@app.command()
@grouped
def runs(
    *,
    schedule: ScheduleId,
    limit: Annotated[int, typer.Option(min=1, max=200, help="How many, from the newest.")] = 20,
    service: ServiceOptions,
    as_json: AsJson = False,
) -> None:
    """List what became of a schedule's due times, from new to old."""
    from slrig.cli.display import print_json, print_table

    with service.client() as client:
        chosen = _chosen(client, schedule)
        found = client.get(f"{chosen['links']['runs']}?limit={limit}")
    if as_json:
        print_json(found)
        return
    if not found["runs"]:
        typer.echo("nothing was due yet")
        return
    rows = [
        (
            _clock(run["due"]),
            run["state"] + (f" × {run['count']}" if run["count"] > 1 else ""),
            run["reason"] or "",
        )
        for run in found["runs"]
    ]
    print_table((f"due ({chosen['time_zone']})", "what became of it", "why"), rows)


@app.command()
@grouped
def pause(schedule: ScheduleId, service: ServiceOptions) -> None:
    """Pause a schedule until it is resumed."""
    with service.client() as client:
        client.post(f"{_path(client, schedule)}/pause", None)
    typer.echo("paused")


@app.command()
@grouped
def resume(schedule: ScheduleId, service: ServiceOptions) -> None:
    """Go on after a pause."""
    with service.client() as client:
        _print_schedule(client.post(f"{_path(client, schedule)}/resume", None))


@app.command()
@grouped
def cancel(schedule: ScheduleId, service: ServiceOptions) -> None:
    """Request the early end of the run under way. The schedule stays as it is."""
    with service.client() as client:
        client.post(f"{_path(client, schedule)}/cancel", None)
    typer.echo("the end of the run was requested")


@app.command()
@grouped
def remove(schedule: ScheduleId, service: ServiceOptions) -> None:
    """Forget a schedule and its runs."""
    with service.client() as client:
        client.delete(_path(client, schedule))
    typer.echo("removed")


def _options(given: list[str]) -> dict[str, Any]:
    options: dict[str, Any] = {}
    for each in given:
        name, equals, value = each.partition("=")
        if not name or not equals:
            message = f"--option: expected name=value, found '{each}'"
            raise ScheduleError(message)
        try:
            options[name] = json.loads(value)
        except ValueError:
            options[name] = value
    return options


def _path(client: Client, beginning: str) -> str:
    return str(_chosen(client, beginning)["links"]["self"])


def _chosen(client: Client, beginning: str) -> Mapping[str, Any]:
    """The schedule with this beginning of its id."""
    return by_beginning(client.get("/schedule")["schedules"], beginning, "schedule", ScheduleNotFoundError)


def _print_schedule(schedule: Mapping[str, Any], *, as_json: bool = False) -> None:
    if as_json:
        from slrig.cli.display import print_json

        print_json(schedule)
        return
    state = "" if schedule["enabled"] else ", paused"
    typer.echo(f"{schedule['id']}: {schedule['task']} at '{schedule['cron']}' in {schedule['time_zone']}{state}")
    for due in schedule["upcoming"]:
        typer.echo(f"  {datetime.fromisoformat(due):%a %Y-%m-%d %H:%M %z}")


def _clock(stamp: str) -> str:
    """A time as the service states it: by the clocks of the schedule's own time zone."""
    return f"{datetime.fromisoformat(stamp):%a %Y-%m-%d %H:%M}"
