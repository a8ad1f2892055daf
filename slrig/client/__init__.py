"""The service's client for other people's Python: light to load, typed, blocking or awaited."""

from slrig.client.clients import AsyncClient, Client
from slrig.client.cloud import Cloud
from slrig.client.scans import ScanJob, ScanResult

__all__ = ["AsyncClient", "Client", "Cloud", "ScanJob", "ScanResult"]
