"""The service's client for other people's Python: light to load, and typed."""

from slrig.client.client import Client
from slrig.client.results import Cloud, ScanJob, ScanResult

__all__ = ["Client", "Cloud", "ScanJob", "ScanResult"]
