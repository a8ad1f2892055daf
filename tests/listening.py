"""Where a process of this machine can be reached."""

from __future__ import annotations

from importlib import import_module


def listening_at(pid: int | None = None) -> set[str]:
    """Addresses, HOST:PORT, at which a process, or one that it started, takes TCP connections. pid : else this one."""
    psutil = import_module("psutil")  # comes with distributed
    process = psutil.Process(pid)
    ends = [end for each in (process, *process.children(recursive=True)) for end in each.net_connections("tcp")]
    return {f"{end.laddr.ip}:{end.laddr.port}" for end in ends if end.status == psutil.CONN_LISTEN}
