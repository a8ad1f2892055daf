"""The service's client for other people's Python: light to load, and typed."""

from slrig.client.client import Client, Cloud, ScanJob, ScanResult
from slrig.client.connection import Captured, Event, FileReady, PoseChange, Progress, StateChange

__all__ = [
    "Captured",
    "Client",
    "Cloud",
    "Event",
    "FileReady",
    "PoseChange",
    "Progress",
    "ScanJob",
    "ScanResult",
    "StateChange",
]
