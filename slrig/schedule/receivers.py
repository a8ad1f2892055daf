"""Receivers of notices that the service's settings name: the webhook, and those of plug-ins."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import get_args

from pydantic import SecretStr

from slrig.config import NoticeKind, ServiceSettings, read_private_text
from slrig.errors import ConfigError
from slrig.jobs.outbox import Outbox
from slrig.plugins import RECEIVERS, load
from slrig.schedule.sending import Sender
from slrig.schedule.webhook import Webhook, signing_key


def wanted_kinds(settings: ServiceSettings) -> Mapping[str, Collection[NoticeKind]]:
    """Kinds of notices for each named receiver; all kinds for other receivers than the webhook. Raises ConfigError."""
    kinds = dict.fromkeys(_named_receivers(settings), get_args(NoticeKind))
    return kinds if settings.webhook_url is None else {"webhook": settings.webhook_kinds, **kinds}


def senders_of(settings: ServiceSettings, outbox: Outbox) -> list[Sender]:
    """One sender for each receiver. Raises ConfigError: an address or secret is invalid, or an extra is missing."""
    found: list[Sender] = []
    if settings.webhook_url is not None:
        secret, source = secret_of(settings.webhook_secret, settings.webhook_secret_file, "webhook_secret")
        found.append(Webhook(outbox, settings.webhook_url, None if secret is None else signing_key(secret, source)))
    return [*found, *(open_sender(settings, outbox) for open_sender in _named_receivers(settings).values())]


def _named_receivers(settings: ServiceSettings) -> Mapping[str, Callable[[ServiceSettings, Outbox], Sender]]:
    """The plug-ins of the settings `X_url`. Raises ConfigError: one is not installed, or cannot be loaded."""
    installed = load(RECEIVERS)
    found = {name: installed[name] for name in installed if getattr(settings, f"{name}_url", None) is not None}
    if settings.mqtt_url is not None and "mqtt" not in found:
        message = "mqtt_url: no installed package sends notices there; install slrig again, or leave mqtt_url out"
        raise ConfigError(message)
    return found


def secret_of(given: SecretStr | None, path: Path | None, name: str) -> tuple[str | None, str]:
    """Return a secret, or the contents of a file that only its owner may read, and its source. Raises ConfigError."""
    if given is not None or path is None:
        return None if given is None else given.get_secret_value(), name
    source = f"{name}_file: {path}"
    return read_private_text(path, source), source
