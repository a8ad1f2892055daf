"""Scans of an object on a turntable become one model over HTTP: the mesh is right, and a kill costs nothing."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest

from slrig.bundle.options import read_poses
from slrig.client import Client
from slrig.client.errors import ConflictError, ModelFailedError
from slrig.jobs.records import JobKind, JobProgress, JobRecord, JobState, utc_now, write_record
from slrig.model_jobs.plan import MEDIA_TYPES
from slrig.scan.artefacts import decode_mesh_ply, encode_mesh_ply
from slrig.scan.job import plan_json
from slrig.scan.plan import ScanPlan
from tests.e2e.conftest import Start, write_rig
from tests.turned_views import AXIS, AXIS_POINT_MM, bumpy, displacement_mm, off_surface_mm, seen

ANGLES = [0.0, 40.0, 80.0]
TURNTABLE = {"point_mm": np.add(AXIS_POINT_MM, [0.3, 0.0, -0.2]).tolist(), "direction": AXIS.tolist()}


def on_a_turntable(data: Path) -> tuple[list[str], list[np.ndarray]]:
    """Write scans as if they had been shot at `ANGLES`, and return their ids and true poses."""
    turned, scans = seen(bumpy, ANGLES, pitch_mm=1.5), []
    for angle, view in zip(ANGLES, turned.noisy(0, length_mm=2.0), strict=True):
        scan_id = uuid4()
        folder = data / "scans" / str(scan_id)
        folder.mkdir(parents=True)
        (folder / "mesh.ply").write_bytes(encode_mesh_ply(view))
        (folder / "report.json").write_text(
            json.dumps({"format": "slrig-report", "turntable": {"angle_deg": angle, "turned_by": "table"}})
        )
        now, plan = utc_now(), plan_json(ScanPlan())
        progress = JobProgress("", 0.0, "")
        write_record(
            folder,
            JobRecord(
                0, scan_id, JobKind.SCAN, JobState.SUCCEEDED, None, "small", plan, now, now, now, progress, None, {}
            ),
        )
        scans.append(str(scan_id))
    return scans, turned.poses


def followed_to(client: Client, model: str, stage: str) -> None:
    assert any(getattr(event, "stage", None) == stage for event in client.models.follow(model))


@pytest.mark.slow
def test_scans_become_a_model_over_http_and_a_kill_while_it_is_made_costs_nothing(start: Start, tmp_path: Path) -> None:
    rig, data = write_rig(tmp_path / "rig"), tmp_path / "data"
    scans, true = on_a_turntable(data)
    first = start(rig, data)
    with first.client() as client:
        made = client.models.wait(client.models.start(scans, axis=TURNTABLE, label="bumpy")["id"])
        assert set(made["links"]["files"]) == set(MEDIA_TYPES)
        for name, link in made["links"]["files"].items():
            client.fetch(link, tmp_path / name)
        poses = read_poses(tmp_path / "poses.json").poses
        assert list(poses) == scans
        views = [decode_mesh_ply((data / "scans" / scan / "mesh.ply").read_bytes()) for scan in scans]
        report = json.loads((tmp_path / "report.json").read_bytes())
        for view, pose, wanted, stated in zip(views, poses.values(), true, report["views"], strict=True):
            assert displacement_mm(view, pose, wanted) < 3 * stated["sigma_mm"] + 1e-6
            assert stated["sigma_mm"] < 0.03
        # Edges of 1.9 mm cut the bumps by so much.
        whole = decode_mesh_ply((tmp_path / "model.ply").read_bytes())
        assert np.sqrt(np.mean(off_surface_mm(bumpy, whole) ** 2)) < 0.06
        assert (tmp_path / "model.glb").read_bytes()[:4] == b"glTF"
        assert report["axis"]["turntable_error_deg"] == pytest.approx([0, 0, 0], abs=0.05)
        with pytest.raises(ModelFailedError, match="share more than 2%"):
            client.models.wait(client.models.start(scans, axis=TURNTABLE, angles_deg=[0, 180, 270])["id"])
        worker = first.worker_id()
        for _ in range(5):
            cut_off = client.models.start(scans, axis=TURNTABLE)["id"]
            followed_to(client, cut_off, "registering")
            os.kill(worker, signal.SIGSTOP)
            if client.models.get(cut_off)["state"] == "computing":
                break
            # A busy machine has told it late.
            os.kill(worker, signal.SIGCONT)
        waiting = client.models.start(scans[:2], axis=TURNTABLE)["id"]
        with pytest.raises(ConflictError, match="needed by model"):
            client.scans.delete(scans[0])
        assert client.models.get(cut_off)["state"] == "computing"
        first.kill()
        os.kill(worker, signal.SIGKILL)
    assert not {cut_off, waiting} & {each.name for each in (data / "models").iterdir()}
    second = start(rig, data)
    with second.client() as client:
        for model in (cut_off, waiting):
            assert set(client.models.wait(model)["links"]["files"]) == set(MEDIA_TYPES)
        assert client.models.file(cut_off, "model.ply") == (tmp_path / "model.ply").read_bytes()
        assert list((data / ".incoming").iterdir()) == []
        client.scans.delete(scans[0])
        client.models.delete(cut_off)
        assert {each["id"] for each in client.models.list()["models"]} >= {made["id"], waiting}
    assert second.stop() == 0
