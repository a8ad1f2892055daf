"""A hundred folders of rendered images as other programs leave them: how many `slrig import` understands by itself."""

from __future__ import annotations

import shutil
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.rendered_folders import understand_folder_of

FOLDERS = 100
LEAST = 97


def test_a_hundred_folders_are_understood(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    verdicts: Counter[str] = Counter()
    lines = []
    for seed in range(FOLDERS):
        path = tmp_path / str(seed)
        folder, verdict = understand_folder_of(seed, path)
        verdicts[verdict] += 1
        if verdict not in ("right", "named"):
            lines.append(f"{seed:3} {verdict}: {', '.join(folder.kinds)}")
        shutil.rmtree(path)
    with capsys.disabled():
        sys.stdout.write("\n".join([*lines, str(dict(verdicts)), ""]))
    assert verdicts["wrong in silence"] == 0
    assert verdicts["right"] + verdicts["named"] >= LEAST
