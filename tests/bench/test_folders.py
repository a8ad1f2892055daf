"""Folders of rendered images as other programs leave them: how many `slrig import` understands by itself."""

from __future__ import annotations

import shutil
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests.rendered_folders import Folder, make_folder, make_sinusoid_folder, understand_folder_of


@pytest.mark.parametrize(
    ("make", "seeds", "least"),
    [(make_folder, range(100), 97), (make_sinusoid_folder, range(1000, 1030), 29)],
    ids=["codes", "sinusoids alone"],
)
def test_folders_are_understood(
    make: Callable[[int, Path], Folder],
    seeds: Sequence[int],
    least: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    verdicts: Counter[str] = Counter()
    lines = []
    for seed in seeds:
        path = tmp_path / str(seed)
        folder, verdict = understand_folder_of(seed, path, make)
        verdicts[verdict] += 1
        if verdict not in ("right", "named"):
            lines.append(f"{seed:4} {verdict}: {', '.join(folder.kinds)}")
        shutil.rmtree(path)
    with capsys.disabled():
        sys.stdout.write("\n".join([*lines, str(dict(verdicts)), ""]))
    assert verdicts["wrong in silence"] == 0
    assert verdicts["right"] + verdicts["named"] >= least
