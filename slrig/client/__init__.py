"""The service's client for other people's Python: light to load, and typed."""

from slrig.client.client import Client, Cloud, ScanJob, ScanResult
from slrig.client.connection import Captured, Event, FileReady, PoseChange, Progress, StateChange
from slrig.client.live import LiveFrame, read_recording

__all__ = [
    "Captured",
    "Client",
    "Cloud",
    "Event",
    "FileReady",
    "LiveFrame",
    "PoseChange",
    "Progress",
    "ScanJob",
    "ScanResult",
    "StateChange",
    "read_recording",
]
