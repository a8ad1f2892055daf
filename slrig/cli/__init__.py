"""The command line. Only typer is loaded here; each command loads what it needs when it is called."""

from slrig.cli.commands import main

__all__ = ["main"]
