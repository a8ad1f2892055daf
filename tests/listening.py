"""Where a process of this machine can be reached."""

from __future__ import annotations

import socket

import psutil


def free_port() -> int:
    """A port of loopback that is free."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port


def listening_at(pid: int | None = None) -> set[str]:
    """Addresses, HOST:PORT, at which a process, or one that it started, takes TCP connections. pid : else this one."""
    process = psutil.Process(pid)
    ends = [end for each in (process, *process.children(recursive=True)) for end in each.net_connections("tcp")]
    return {f"{end.laddr.ip}:{end.laddr.port}" for end in ends if end.status == psutil.CONN_LISTEN}
