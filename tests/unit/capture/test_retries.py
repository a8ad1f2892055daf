"""What comes alike in three exposures is how the rig or the scene is: it counts, or its message blames no cable."""

from __future__ import annotations

from slrig.capture.frame_checks import are_exposures_alike
from slrig.capture.retries import describe_causes, have_same_cause
from slrig.capture.sequencer import capture
from slrig.capture.verifier import Evidence, Sampler
from slrig.model import Pixels
from tests.unit.capture.fake_rig import Scene, fake_rig
from tests.unit.capture.test_sequencer import SHORT


class StrayLight(Scene):
    """Patterns light a part of the image more than white does: light by another path."""

    def image(self, profile: Pixels | None) -> Pixels:
        found = super().image(profile)
        if profile is not None and profile.size > 1:
            found[:, 60:90] = 250
        return found


def test_unusual_light_counts_if_it_comes_alike() -> None:
    fake = fake_rig(cameras=["left"])
    scene = StrayLight(noise_dn=1.0)
    fake.cameras["left"].scene = scene
    evidence = Evidence(SHORT.patterns, {"left": scene.format})
    latest = {shot.pattern for shot in capture(fake.rig, SHORT, evidence=evidence)}
    assert latest == set(range(len(SHORT)))
    summary = evidence.summary()
    assert 1 <= len(summary.faults) <= 3
    assert summary.wrong == {}
    assert summary.shot_again > 0


def test_exposures_are_alike_but_for_noise() -> None:
    scene = Scene(noise_dn=2.0)
    sampler = Sampler.from_size(scene.camera)
    first, again = (sampler.take(scene.image(None)) for _ in range(2))
    assert are_exposures_alike(first, again)
    other = again.copy()
    other[: len(other) // 20] += 60
    assert not are_exposures_alike(first, other)


def test_a_cable_is_not_blamed_for_what_comes_alike() -> None:
    cause = "{}% of the lit pixels are damaged; check the cable, and scan again"
    alike = describe_causes([cause.format(share) for share in (15, 16, 15)])
    assert alike.startswith("it failed 3 times, each time alike: 15% of")
    assert "check the cable" not in alike
    assert "the rig or the scene causes it" in alike
    assert "check the cable" in describe_causes([cause.format(share) for share in (15, 80, 3)])
    assert have_same_cause(["rows 10 to 20"] * 2)
    assert not have_same_cause(["rows 10 to 20", "columns 10 to 20"])
