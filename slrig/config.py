"""Rig files and service settings: TOML in, validated values out, all faults in one message."""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args
from urllib.parse import urlsplit

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SecretStr,
    ValidationError,
    field_validator,
    model_validator,
)

from slrig import data_home
from slrig.bundle import (
    CameraName,
    ExposureSeconds,
    Preset,
    PresetName,
    ScanDefaults,
    Strict,
    describe_errors,
    embed_masks,
    parse_toml,
    read_text,
    read_toml,
    validate,
)
from slrig.errors import ConfigError

MAX_CONFIG_BYTES = 2**20


LineSeconds = Annotated[float, Field(ge=0, le=0.1)]
Gain = Annotated[float, Field(gt=0, le=1000)]
DriverName = Annotated[str, Field(min_length=1)]
NoticeKind = Literal[
    "run.missed", "run.skipped", "run.failed", "run.interrupted", "health.changed", "job.ended"
]  # fmt: skip

_PATHS = (
    "data_dir", "rig", "webhook_secret_file", "mqtt_login_file", "compute_certificates", "compute_login_file",
    "catalogue_login_file", "catalogue_authority",
)  # fmt: skip


class DriverTable(Strict, use_attribute_docstrings=True):
    """A device: the driver that opens it; every other key is an option of that driver, validated by the driver."""

    model_config = ConfigDict(extra="allow")

    driver: DriverName
    """Driver that opens the device. `slrig devices` lists the installed ones."""

    @property
    def options(self) -> Mapping[str, object]:
        """The keys that belong to the driver."""
        return dict(self.model_extra or {})


class HeadTable(DriverTable):
    """One instrument that is projector and cameras. Exposure and gain hold for each of its cameras."""

    exposure_s: ExposureSeconds | None = None
    """Exposure of each frame. Default: 1/60 s or the nearest that the camera can. On a video projector, whole refresh
    periods."""

    gain: Gain = 1.0
    """A factor; 1 is the minimum of the sensor."""


class CameraTable(DriverTable):
    """One camera."""

    name: CameraName
    """The rig's name for it."""

    exposure_s: ExposureSeconds | None = None
    """Exposure of each frame. Default: 1/60 s or the nearest that the camera can. On a video projector, whole refresh
    periods."""

    gain: Gain = 1.0
    """A factor; 1 is the minimum of the sensor."""


class SynchronisationTable(Strict):
    """Results of `slrig latency`: delay of the light after the stated instant, and line time of rolling shutters."""

    latency_s: Annotated[float, Field(ge=-10, le=10)] = 0.0
    latency_error_s: Annotated[float, Field(ge=-10, le=10)] = 0.0
    earliest_s: Annotated[float, Field(ge=-10, le=10)] | None = None
    """Shortest time from the stated instant to a change of the light. With it, scans by free-running cameras show the
    next pattern without waiting for the frame."""

    line_time_s: Annotated[dict[CameraName, LineSeconds], Field(default_factory=dict)]

    stamp_error_s: Annotated[dict[CameraName, Annotated[float, Field(ge=0, le=10)]], Field(default_factory=dict)]
    """Error of each camera's time stamps when the latency was measured. Where it is another one in a scan, as at
    another exposure, frames keep as much more distance from changes of the light."""

    trigger_period_s: Annotated[float, Field(gt=0, le=10)] | None = None
    """By wire: the shortest time from one trigger pulse to the next, if the cameras need more than they declare."""

    @model_validator(mode="after")
    def _check_latency_keys(self) -> Self:
        given = {"latency_s", "latency_error_s"} & self.model_fields_set
        if len(given) == 1 or (not given and self.trigger_period_s is None):
            message = "expected latency_s and latency_error_s, as slrig latency prints them, or trigger_period_s alone"
            raise ValueError(message)
        return self


class VerificationTable(Strict):
    """Effect of the health of the calibration on scans."""

    refuse_when_stale: Annotated[
        bool, Field(description="refuse scans while the calibration is stale; they are stamped with it in any case")
    ] = False


class AccuracyTable(Strict, use_attribute_docstrings=True):
    """Required accuracy."""

    tolerance_mm: Annotated[float, Field(gt=0, le=1000)] | None = None
    """Largest error of 95 % of the points of a scan. Calibrations are graded by it, and the limits of an acceptance
    test follow it."""


class RigTable(Strict):
    """A rig file: either `[head]`, or `[projector]` and one `[[camera]]` or more. `[positioner]` moves the object."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    calibration: Annotated[str, Field(min_length=1, description="path, relative to the rig file")] | None = None
    head: HeadTable | None = None
    projector: DriverTable | None = None
    camera: Annotated[list[CameraTable], Field(default_factory=list)]
    positioner: DriverTable | None = None
    synchronisation: SynchronisationTable | None = None
    verification: VerificationTable = VerificationTable()
    accuracy: AccuracyTable = AccuracyTable()
    scan: ScanDefaults = ScanDefaults()
    presets: Annotated[
        dict[PresetName, Preset],
        Field(default_factory=dict, description="options for a kind of object, by the name that a request gives"),
    ]

    @model_validator(mode="after")
    def _check_kind_of_rig(self) -> Self:
        if self.head is not None and (self.projector is not None or self.camera):
            message = "expected [head] alone, found [projector] or [[camera]] as well; keep one kind"
            raise ValueError(message)
        if self.head is None and (self.projector is None or not self.camera):
            missing = "[projector]" if self.projector is None else "[[camera]]"
            message = f"expected [head], or [projector] and one [[camera]] or more, found no {missing}; add it"
            raise ValueError(message)
        names = [camera.name for camera in self.camera]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            message = f"expected each camera to have a name of its own, found {', '.join(twice)} twice; rename one"
            raise ValueError(message)
        for key in ("line_time_s", "stamp_error_s"):
            unknown = sorted(set(getattr(self.synchronisation, key, {})) - set(names)) if names else []
            if unknown:
                message = (
                    f"expected synchronisation.{key} to name cameras of this rig ({', '.join(names)}), found "
                    f"{', '.join(unknown)}; correct or remove it"
                )
                raise ValueError(message)
        return self


@dataclass(frozen=True, slots=True)
class RigConfig:
    """A validated rig file. path : absolute; paths in it are relative to its folder.

    Either `head` is given, or `projector` and `cameras`. positioner : moves the object; None if the head has one or
    there is none.
    """

    name: str
    path: Path
    calibration: Path | None
    head: HeadTable | None
    projector: DriverTable | None
    cameras: tuple[CameraTable, ...]
    scan: ScanDefaults
    synchronisation: SynchronisationTable | None = None
    refuse_when_stale: bool = False
    tolerance_mm: float | None = None
    presets: Mapping[str, Preset] = field(default_factory=dict)
    positioner: DriverTable | None = None

    @property
    def folder(self) -> Path:
        """The folder of the file."""
        return self.path.parent


def read_rig(path: Path) -> RigConfig:
    """Return the rig that a TOML file describes. Raises ConfigError: the file is missing; or see `rig_of`."""
    return rig_of(read_text(path, MAX_CONFIG_BYTES, ConfigError), path)


def rig_of(text: str, path: Path) -> RigConfig:
    """Return the rig that the text of a TOML file describes. path : of the file, which need not exist.
    Raises ConfigError: it is not TOML, or any of its keys is unknown or wrong; all faults in one message.
    """
    data = parse_toml(text, path)
    presets = data.get("presets")
    preset_names = [(presets, name) for name in presets] if isinstance(presets, dict) else []
    for tables, name in [(data, "scan"), *preset_names]:
        options = tables.get(name)
        if isinstance(options, Mapping) and isinstance(options.get("region"), Mapping):
            tables[name] = {**options, "region": embed_masks(options["region"], path.parent)}
    return parse_rig(data, path)


def parse_rig(data: Mapping[str, Any], path: Path) -> RigConfig:
    """Return the rig that the data of a TOML file describe. path : of the file, which need not exist.
    Raises ConfigError: any key is unknown or wrong; all faults in one message.
    """
    table = validate(RigTable, data, f"the rig file {path}")
    path = path.resolve()
    return RigConfig(
        name=table.name,
        path=path,
        calibration=None if table.calibration is None else path.parent / table.calibration,
        head=table.head,
        projector=table.projector,
        cameras=tuple(table.camera),
        scan=table.scan,
        synchronisation=table.synchronisation,
        refuse_when_stale=table.verification.refuse_when_stale,
        tolerance_mm=table.accuracy.tolerance_mm,
        presets=table.presets,
        positioner=table.positioner,
    )


def _require_web_address(url: str) -> str:
    try:
        parts = urlsplit(url)
        valid = parts.scheme in {"http", "https"} and bool(parts.hostname)
    except ValueError:
        valid = False
    if not valid:
        # The message does not repeat the address, which often holds a secret.
        message = "expected an address that begins with http:// or https:// and a host; correct it or leave it out"
        raise ValueError(message)
    return url


WebAddress = Annotated[str, Field(max_length=2000), AfterValidator(_require_web_address)]
"""An address of the web, such as that of a webhook."""


class ServiceSettings(BaseModel):
    """Settings of the service, from `SLRIG_…` in the environment, then a TOML file, then these defaults.

    `require_key` False opens the service to everyone who reaches it, so it is allowed on this machine only.
    `allowed_hosts` are names, in addition to `host` and those of this machine, that a request may have as its Host; in
    the environment they are separated by commas. `webhook_url` receives notices of `webhook_kinds`, all by default,
    signed with `webhook_secret` or the text in `webhook_secret_file`. `mqtt_url` is a broker that receives all notices,
    with the user and password of `mqtt_login` or `mqtt_login_file`. Without an address nothing is sent. Nothing is
    removed unless a setting sets a limit: `keep_calibrations`, `keep_models`, `keep_scans` (their numbers),
    `keep_scans_days`, `keep_scans_bytes`. Beyond it the oldest are removed, failed ones first and counted apart, except
    pinned ones, those with files requested in the last quarter of an hour, and calibrations that are in use or
    that a scan or an acceptance test names. They lie in `.trash` of the data folder for a day. `backlog_length` is the
    number of scans
    that may be reconstructed, or wait for that, while the rig captures the next one; other computations count too.
    `drain_s` is the time after SIGTERM in which the job that has the rig and those that compute may end before they are
    interrupted; jobs that wait, or have all their frames, continue at the next start. `compute` is the scheduler of a
    pool that reconstructs for this rig, `compute_store` holds bundles and results meanwhile, `compute_certificates` and
    `compute_login_file` open the two: see slrig/compute/README.md. `catalogue` is a database that rigs share,
    `catalogue_authority` the signer of its certificate: see slrig/catalogue/README.md. Only the service's own user may
    read the data, and the users of `data_group`, if it is set. `log_format` auto is text on a terminal, JSON lines
    elsewhere.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)

    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8731
    data_dir: Path = Field(default_factory=data_home)
    data_group: Annotated[str, Field(min_length=1)] | None = None
    rig: Path | None = None
    require_key: bool = True
    allowed_hosts: tuple[str, ...] = ()
    queue_length: Annotated[int, Field(ge=0, le=1000)] = 16
    backlog_length: Annotated[int, Field(ge=1, le=1000)] = 16
    max_body_bytes: Annotated[int, Field(ge=1024)] = 2**16
    min_free_bytes: Annotated[int, Field(ge=0)] = 2**30
    # Pictures, events and bundles: half of them for one key.
    max_event_streams: Annotated[int, Field(ge=1)] = 48
    requests_per_s: Annotated[float, Field(gt=0)] = 50.0
    max_connections: Annotated[int, Field(ge=16, le=1536)] = 512
    max_connections_per_address: Annotated[int, Field(ge=1)] = 64
    keepalive_s: Annotated[float, Field(gt=0)] = 15.0
    drain_s: Annotated[float, Field(ge=0)] = 0.0
    shutdown_s: Annotated[float, Field(gt=0)] = 3.0
    idempotency_keep_s: Annotated[float, Field(gt=0)] = 86400.0
    page_limit: Annotated[int, Field(ge=1, le=1000)] = 200
    keep_calibrations: Annotated[int, Field(ge=1, le=100_000)] | None = None
    keep_models: Annotated[int, Field(ge=1, le=100_000)] | None = None
    keep_scans: Annotated[int, Field(ge=1)] | None = None
    keep_scans_days: Annotated[float, Field(gt=0)] | None = None
    keep_scans_bytes: Annotated[int, Field(ge=1)] | None = None
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    log_format: Literal["auto", "text", "json"] = "auto"
    webhook_url: WebAddress | None = None
    webhook_secret: SecretStr | None = None
    webhook_secret_file: Path | None = None
    webhook_kinds: tuple[NoticeKind, ...] = get_args(NoticeKind)
    mqtt_url: Annotated[str, Field(max_length=2000)] | None = None
    mqtt_login: SecretStr | None = None
    mqtt_login_file: Path | None = None
    compute: Annotated[str, Field(max_length=2000)] | None = None
    compute_store: Annotated[str, Field(max_length=2000)] | None = None
    compute_certificates: Path | None = None
    compute_login_file: Path | None = None
    catalogue: Annotated[str, Field(max_length=2000)] | None = None
    catalogue_login: SecretStr | None = None
    catalogue_login_file: Path | None = None
    catalogue_authority: Path | None = None

    @property
    def key_path(self) -> Path:
        """The file that holds the hashes of the service's keys."""
        return self.data_dir / "keys.json"

    @field_validator(*_PATHS)
    @classmethod
    def _expand_user(cls, path: Path | None) -> Path | None:
        return None if path is None else path.expanduser()

    @field_validator("allowed_hosts", "webhook_kinds", mode="before")
    @classmethod
    def _split(cls, names: object) -> object:
        return tuple(name.strip() for name in names.split(",") if name.strip()) if isinstance(names, str) else names

    @field_validator("webhook_secret", "mqtt_login", "catalogue_login", mode="before")
    @classmethod
    def _require_text(cls, secret: object) -> object:
        if not isinstance(secret, str | SecretStr | None):
            message = "expected a text; put it in quotes"
            raise ValueError(message)  # noqa: TRY004 - pydantic collects ValueErrors only
        return secret or None

    @field_validator("mqtt_url", "catalogue", "webhook_url", mode="before")
    @classmethod
    def _empty_is_none(cls, url: object) -> object:
        return url or None

    @model_validator(mode="after")
    def _require_key_beyond_loopback(self) -> Self:
        if not self.require_key and not is_loopback(self.host):
            message = (
                f"expected require_key on a service that others can reach, found host {self.host} without it; "
                "listen on 127.0.0.1 or leave require_key on"
            )
            raise ValueError(message)
        return self


def read_settings(path: Path | None = None, **given: object) -> ServiceSettings:
    """Return the settings of the service; `given` values take precedence over the environment, and that over the file.

    Paths in the file are relative to it. Raises ConfigError: the file is missing or not TOML, or a value is wrong; all
    faults in one message.
    """
    data: dict[str, Any] = {} if path is None else read_toml(path, MAX_CONFIG_BYTES)
    for key in _PATHS:
        if path is not None and isinstance(data.get(key), str):
            data[key] = str(path.resolve().parent / Path(data[key]).expanduser())
    source = "settings" if path is None else str(path)
    try:
        in_environment = {name: f"SLRIG_{name.upper()}" for name in ServiceSettings.model_fields}
        data.update({name: os.environ[named] for name, named in in_environment.items() if named in os.environ})
        data.update(given)
        return ServiceSettings(**data)
    except ValidationError as cause:
        known = dict.fromkeys(ServiceSettings.model_fields, "")
        message = f"{source}: not valid settings of the service:\n{describe_errors(cause, data, known)}"
        raise ConfigError(message) from cause


def read_private_text(path: Path, source: str) -> str:
    """Return the text of a file that only its owner may read. source : its name in messages. Raises ConfigError."""
    try:
        mode, text = path.stat().st_mode, path.read_text("utf-8")
    except (OSError, ValueError) as cause:
        message = f"{source} cannot be read: {getattr(cause, 'strerror', None) or 'it is not text'}"
        raise ConfigError(message) from cause
    if os.name == "posix" and mode & 0o077:
        message = f"{source} may be read by others; protect it: chmod 600 {path}"
        raise ConfigError(message)
    return text


def is_loopback(host: str) -> bool:
    """True if only this machine can reach a service that listens on `host`."""
    if host == "localhost":
        return True
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False
