"""Which receivers the service's settings name, and what each of them is told."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import get_args

from pydantic import SecretStr

from slrig.config import NoticeKind, ServiceSettings, read_private_text
from slrig.jobs.outbox import Outbox
from slrig.schedule.mqtt import Broker
from slrig.schedule.sending import Sender
from slrig.schedule.webhook import Webhook, signing_key


def wanted_kinds(settings: ServiceSettings) -> Mapping[str, Collection[NoticeKind]]:
    """The kinds of notices that each receiver wants, by its name. Those who subscribe at a broker choose by topic."""
    kinds = {"webhook": settings.webhook_kinds, "mqtt": get_args(NoticeKind)}
    return {name: kinds[name] for name in kinds if getattr(settings, f"{name}_url") is not None}


def senders_of(settings: ServiceSettings, outbox: Outbox) -> list[Sender]:
    """One for each receiver. Raises ConfigError: an address or a secret is none, or an extra is not installed."""
    found: list[Sender] = []
    if settings.webhook_url is not None:
        secret, source = secret_of(settings.webhook_secret, settings.webhook_secret_file, "webhook_secret")
        found.append(Webhook(outbox, settings.webhook_url, None if secret is None else signing_key(secret, source)))
    if settings.mqtt_url is not None:
        login, _ = secret_of(settings.mqtt_login, settings.mqtt_login_file, "mqtt_login")
        found.append(Broker(outbox, settings.mqtt_url, login))
    return found


def secret_of(given: SecretStr | None, path: Path | None, name: str) -> tuple[str | None, str]:
    """A secret, or what a file holds that nobody but its owner may read; and which it was. Raises ConfigError."""
    if given is not None or path is None:
        return None if given is None else given.get_secret_value(), name
    source = f"{name}_file: {path}"
    return read_private_text(path, source), source
