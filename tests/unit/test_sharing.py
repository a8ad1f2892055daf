"""How tests are shared between processes (tests/conftest.py) when one of them kills its process."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("processes", [1, 2])
@pytest.mark.parametrize(
    ("files", "deadly"),
    [
        ({"test_one.py": 1}, [("test_one.py", 0)]),
        ({"test_one.py": 12, "test_two.py": 12, "test_three.py": 12}, [("test_two.py", 5)]),
        # The last of all, alone in its file; and the first, with all files behind it.
        ({"test_one.py": 3, "test_two.py": 1}, [("test_two.py", 0)]),
        ({"test_one.py": 1, "test_three.py": 1, "test_two.py": 1}, [("test_one.py", 0), ("test_two.py", 0)]),
    ],
)
def test_a_test_that_kills_its_process_fails_alone(
    tmp_path: Path, files: dict[str, int], deadly: list[tuple[str, int]], processes: int
) -> None:
    for name, count in files.items():
        kills = [number for file, number in deadly if file == name]
        (tmp_path / name).write_text(
            "import os, pytest\n\n"
            f"@pytest.mark.parametrize('number', range({count}))\n"
            "def test_it(number):\n"
            f"    if number in {kills}:\n        os._exit(3)\n"
        )
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    arguments = ["-q", "-p", "tests.conftest", "-p", "no:cacheprovider", "-n", str(processes)]
    run = subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-m", "pytest", *arguments, "--rootdir", tmp_path, tmp_path],
        cwd=ROOT, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert run.returncode == 1, run.stdout + run.stderr
    passed = sum(files.values()) - len(deadly)
    for count, word in ((len(deadly), "failed"), (passed, "passed")):
        assert not count or re.search(rf"\b{count} {word}", run.stdout), run.stdout
    for file, number in deadly:
        assert f"crashed while running '{file}::test_it[{number}]'" in run.stdout
