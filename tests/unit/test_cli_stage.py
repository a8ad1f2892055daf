"""`slrig stage planes`, and what `slrig stage` refuses; `slrig stage axis` is in tests/golden/test_stage.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slrig.bundle.stage_file import AxisSource, StageRecord, encode_stage, read_stage
from slrig.combine.stage import with_axis
from slrig.model import MeasuredAxis, PlaneKind
from slrig.scan.artefacts import encode_mesh_ply
from tests.unit.command import done, refused, slrig
from tests.unit.views.test_stage_planes import AXIS, PLATE, WALL, joined


def test_planes_are_added_to_what_the_file_says_of_the_axis(tmp_path: Path) -> None:
    scan, file = tmp_path / "scan", tmp_path / "stage.json"
    scan.mkdir()
    (scan / "mesh.ply").write_bytes(encode_mesh_ply(joined(PLATE, WALL)))
    axis = MeasuredAxis(AXIS.point_mm, AXIS.direction, 1e-4 * np.eye(6))
    record = with_axis(StageRecord(), axis, source=AxisSource.BOARD, of="board")
    file.write_bytes(encode_stage(record))
    shown = done("stage", "planes", scan, "--stage", file, COLUMNS="160")
    assert [line.split()[0] for line in shown.splitlines()] == ["plane", "backdrop", "plate", "stage"]
    after = read_stage(file)
    assert [plane.kind for plane in after.planes] == [PlaneKind.BACKDROP, PlaneKind.PLATE]
    assert after.history == record.history
    file.write_text("{}")
    assert "is not a valid stage" in refused(slrig("stage", "planes", scan, "--stage", file))
    assert file.read_text() == "{}"
