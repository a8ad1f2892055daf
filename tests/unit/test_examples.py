"""Example rigs: found by name, copied with their scenes, and copies that mean the same."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from slrig.errors import ConfigError
from slrig.examples import EXAMPLES, copy_example, example_names, is_example, rig_path
from tests.core import parametrize_core


def test_an_example_is_found_by_its_name_and_a_file_of_that_name_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()
    found = rig_path(Path("demo"))
    assert found == EXAMPLES / "rigs" / "demo.toml"
    assert is_example(found)
    (tmp_path / "sphere").write_text("own")
    for own in ("sphere", "demo.toml", "nothing", "../demo"):
        assert rig_path(Path(own)) == Path(own)
    assert rig_path(None) is None
    assert not is_example(tmp_path / "demo.toml")


@parametrize_core("name", example_names(), core=[example_names().index("mesh_file"), example_names().index("sphere")])
def test_a_copy_of_an_example_says_the_same_and_has_its_files_beside_it(name: str, tmp_path: Path) -> None:
    own, shipped = tmp_path / "own.toml", EXAMPLES / "rigs" / f"{name}.toml"
    copy_example(name, own)
    tables, original = (tomllib.loads(path.read_text(encoding="utf-8")) for path in (own, shipped))
    if "head" in tables:
        scene, shipped_scene = tmp_path / tables["head"].pop("scene"), shipped.parent / original["head"].pop("scene")
        assert scene.read_bytes() == shipped_scene.read_bytes()
        for thing in tomllib.loads(scene.read_text(encoding="utf-8"))["object"]:
            assert "file" not in thing or (scene.parent / thing["file"]).is_file()
        # Whoever changed the scene keeps it.
        scene.write_text("changed")
        copy_example(name, own)
        assert scene.read_text() == "changed"
    assert tables == original


def test_an_unknown_example_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no example 'vase'.*demo.*webcams-and-hdmi"):
        copy_example("vase", tmp_path / "rig.toml")
    assert not [*tmp_path.iterdir()]
