"""What the routers work with: the parts of one running service."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request

from slrig.config import ScanDefaults, ServiceSettings
from slrig.scan.folder import DataFolder
from slrig.scan.runner import Runner
from slrig.scan.store import ScanStore


@dataclass(frozen=True, slots=True)
class Service:
    """One service: its settings, its data, and the one that scans."""

    settings: ServiceSettings
    scan_defaults: ScanDefaults
    folder: DataFolder
    store: ScanStore
    runner: Runner

    def close(self) -> None:
        """Stop scanning, then let records and data folder go. Idempotent."""
        self.runner.close(timeout_s=self.settings.shutdown_s)
        self.store.close()
        self.folder.release()


def _of_request(request: Request) -> Service:
    service = request.app.state.service
    if not isinstance(service, Service):
        raise TypeError(type(service))
    return service


Serving = Annotated[Service, Depends(_of_request)]
"""A handler's parameter: the service that it serves."""
