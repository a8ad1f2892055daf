"""Entry points of plug-ins: what is found, and a package that cannot be loaded."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator

import pytest

from slrig import plugins
from slrig.config import ServiceSettings
from slrig.errors import ConfigError, DriverBrokenError
from slrig.scan.formats import camera_prefixes, missing_for, on_demand, requested_forms
from slrig.schedule.notices import wanted_kinds


@pytest.fixture
def entries(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[importlib.metadata.EntryPoint]]:
    """Entry points of one group in place of the installed ones."""
    found: list[importlib.metadata.EntryPoint] = []
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [e for e in found if e.group == group])
    plugins.load.cache_clear()
    yield found
    plugins.load.cache_clear()


def test_a_format_of_a_plugin_is_offered_and_names_what_it_needs(entries: list[importlib.metadata.EntryPoint]) -> None:
    entries.append(importlib.metadata.EntryPoint("stl", f"{__name__}:FORMAT", plugins.FORMATS))
    assert "cloud-{camera}.xyz" in requested_forms()
    assert on_demand("cloud-left.xyz", ["right", "left"]) == ("cloud-{camera}.xyz", "left")
    assert missing_for("cloud-left.xyz") == "pip install xyz"
    assert FORMAT.encode("a cloud") == b"xyz"
    assert "cloud-left.xyz".startswith(camera_prefixes())
    # Another file with the same ending needs nothing.
    assert missing_for("points-left.xyz") is None


def test_a_plugin_that_cannot_be_loaded_is_named(entries: list[importlib.metadata.EntryPoint]) -> None:
    entries.append(importlib.metadata.EntryPoint("broken", "slrig.no_such_module:x", plugins.RECEIVERS))
    with pytest.raises(ConfigError, match=r"slrig\.receivers: 'broken' .* cannot be loaded: ModuleNotFoundError"):
        plugins.load(plugins.RECEIVERS)


@pytest.mark.parametrize(
    ("group", "target", "words"),
    [
        (plugins.RECEIVERS, "ends", "SystemExit: it ended"),
        (plugins.OBSERVERS, "interrupts", "GeneratorExit"),
        (plugins.OBSERVERS, "speaks", r"RuntimeError: a\\udcff"),
        (plugins.FORMATS, "encode", "it is function"),
        (plugins.RECEIVERS, "FORMAT", "it is FileFormat"),
    ],
)
def test_whatever_loading_a_plugin_raises_or_gives_is_told_in_words(
    entries: list[importlib.metadata.EntryPoint], group: str, target: str, words: str
) -> None:
    errors = {"ends": SystemExit("it ended"), "interrupts": GeneratorExit(), "speaks": RuntimeError("a\udcff")}

    class Entry(importlib.metadata.EntryPoint):
        def load(self) -> object:
            if target in errors:
                raise errors[target]
            return globals()[target]

    entries.append(Entry("odd", "m:f", group))
    with pytest.raises(ConfigError, match=rf"{group}: 'odd' of the package 'unknown' cannot be loaded: .*{words}"):
        plugins.load(group)


@pytest.mark.parametrize("given", [SystemExit(3), GeneratorExit(), ValueError("\udcff"), None, "text"])
def test_an_encoder_with_a_defect_is_named(monkeypatch: pytest.MonkeyPatch, given: object) -> None:
    def odd(_cloud: object) -> object:
        if isinstance(given, BaseException):
            raise given
        return given

    monkeypatch.setitem(globals(), "encode", odd)
    with pytest.raises(DriverBrokenError, match=r"cloud-\{camera\}\.xyz: its encoder .*:encode failed"):
        FORMAT.encode("a cloud")


def test_a_receiver_that_settings_name_is_not_left_out_in_silence(
    entries: list[importlib.metadata.EntryPoint],
) -> None:
    assert entries == []
    with pytest.raises(ConfigError, match=r"^mqtt_url: no installed package sends notices there"):
        wanted_kinds(ServiceSettings(mqtt_url="mqtt://127.0.0.1/rigs"))


def encode(_cloud: object) -> bytes:
    return b"xyz"


FORMAT = plugins.FileFormat(
    "cloud-{camera}.xyz", "text/plain", "no_such_library", "pip install xyz", f"{__name__}:encode"
)
