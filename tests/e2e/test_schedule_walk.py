"""A schedule kept by the real service on the real clock: due, killed in the middle, and done the next minute."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e.conftest import Start
from tests.e2e.schedules import at_once, awaited, newest
from tests.e2e.test_calibration_walk import BOARD, SLOW, Caller, following, write_rig


def calibrated_rig(folder: Path) -> Path:
    """The rig with the board and a positioner, and with the calibration that it was rendered by."""
    rig = write_rig(folder, head=SLOW)
    rig.write_text(rig.read_text().replace("carries_calibration = false", "carries_calibration = true"))
    return rig


@pytest.mark.slow
def test_schedule_is_kept_through_a_kill_in_the_middle_of_a_run(start: Start, tmp_path: Path) -> None:
    rig = calibrated_rig(tmp_path / "rig")
    service = start(rig)
    with Caller(service) as caller:
        caller.ready()
        options = {"board": BOARD, "position": 1}
        made = caller.post("/schedule", 201, cron="* * * * *", task="verification", enabled=False, options=options)
        at_once(caller, service, made)
        assert len(caller.get(made["links"]["self"])["upcoming"]) == 5
        name = awaited(lambda: caller.get("/rig")["holder"], "the run")
        assert name.startswith(f"schedule {made['id'][:8]}, verification due ")
        refused = caller.post("/scan", 409)
        assert refused["holder"] == name
        assert name in refused["detail"]
        assert newest(caller, made, "running")
        service.kill()
    service = start(rig)
    with Caller(service) as caller:
        (cut_off,) = caller.get(made["links"]["runs"])["runs"]
        assert (cut_off["state"], cut_off["reason"]) == ("interrupted", "the service ended in the middle of it")
        assert list((service.data / ".incoming").iterdir()) == []
        # This one comes by the clock.
        caller.post(made["links"]["resume"], 200)
        run = awaited(lambda: newest(caller, made, "succeeded"), "a whole run")
        assert run["due"] > cut_off["due"]
        assert run["result"]["state"] == "good", run["result"]
        health = caller.get("/rig/health")
        assert (health["state"], health["latest"]["id"]) == ("good", run["result"]["verification"])
        figures = caller.http.get("/metrics").text
        assert 'slrig_scheduled_runs{state="interrupted",task="verification"} 1.0' in figures
        assert 'slrig_rig_health{state="good"} 1.0' in figures
        caller.post(made["links"]["pause"], 200)
        assert caller.http.delete(made["links"]["self"]).status_code == 204
    assert service.stop() == 0


@pytest.mark.slow
def test_calibration_by_schedule_solves_and_is_used_and_an_old_one_goes(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SLRIG_KEEP_CALIBRATIONS", "1")
    service = start(write_rig(tmp_path / "rig"))
    with Caller(service) as caller:
        old = caller.opened()["id"]
        # The rig has no calibration yet: somebody has to vouch for the size of the board.
        board = {**BOARD, "square_sigma": 2e-4}
        options = {"board": board, "positions": list(range(1, 11)), "activate": True}
        made = caller.post("/schedule", 201, cron="* * * * *", task="calibration", enabled=False, options=options)
        at_once(caller, service, made)
        name = awaited(lambda: caller.get("/rig")["holder"], "the run")
        assert name.startswith(f"schedule {made['id'][:8]}, calibration due ")
        refused = caller.post("/scan", 409)
        assert refused["holder"].startswith(f"schedule {made['id'][:8]}, calibration due ")
        run = awaited(lambda: newest(caller, made, "succeeded", "failed"), "the end of the run")
        assert run["state"] == "succeeded", run["reason"]
        told = run["result"]
        assert (told["poses"], told["accepted"], told["refused"], told["activated"]) == (10, 10, {}, True)
        solved = caller.get(f"/calibration/{told['calibration']}")
        assert (solved["state"], solved["label"]) == ("solved", name)
        for number, truth in (("fx", 475.0), ("fy", 475.5), ("cx", 160.6), ("cy", 126.1)):
            value, sigma = solved["result"]["devices"]["left"]["values"][number]
            assert abs(value - truth) < 5 * sigma, number
        used = caller.get("/rig")["calibration"]
        assert (used["id"], used["expected_error_mm"]) == (told["calibration"], told["expected_error_mm"])
        assert [each["id"] for each in caller.get("/calibration")["calibrations"]] == [told["calibration"]]
        assert "old calibration removed" in service.log.read_text()
        assert old in service.log.read_text()
    assert service.stop() == 0


@pytest.mark.slow
def test_schedule_finds_a_scan_at_the_rig_and_tries_again_within_its_grace(start: Start, tmp_path: Path) -> None:
    service = start(calibrated_rig(tmp_path / "rig"))
    with Caller(service) as caller, service.client() as client:
        caller.ready()
        options = {"board": BOARD, "position": 1}
        made = caller.post(
            "/schedule", 201, cron="* * * * *", task="verification", enabled=False, options=options, retry_s=1
        )
        scan = client.scans.start()
        at_once(caller, service, made)
        waiting = awaited(lambda: newest(caller, made, "waiting"), "a run that waits")
        assert waiting["attempts"] >= 1
        assert f"scan {scan['id']}" in waiting["reason"]
        following(client, scan)
        assert client.get(scan["links"]["self"])["state"] == "succeeded"
        run = awaited(lambda: newest(caller, made, "succeeded", "failed", "skipped"), "the end of the run")
        assert (run["state"], run["number"]) == ("succeeded", waiting["number"])
        assert run["reason"] == f"at try {run['attempts']}"
        assert run["attempts"] >= 2
    assert service.stop() == 0
