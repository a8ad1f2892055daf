"""The first half of a scan: play the plan's patterns on a rig and record a bundle.

Apart from the pipeline because the process that owns the rig needs none of the mathematics, and does not load it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from slrig.bundle import BundleWriter, write_truth
from slrig.capture.evidence import Evidence
from slrig.capture.sequencer import capture
from slrig.devices import Rig
from slrig.scan.feed import FrameSink
from slrig.scan.holding import pattern_sequence
from slrig.scan.outline import Outline
from slrig.scan.plan import Progress, ScanPlan


def capture_bundle(
    rig: Rig,
    plan: ScanPlan,
    folder: Path,
    *,
    progress: Progress,
    cancelled: Callable[[], bool],
    frames: FrameSink | None = None,
) -> None:
    """Play the plan's patterns on the rig and record a bundle in `folder`, which must not exist.

    `frames` is shown each frame that has passed its test, before it is written.

    Raises
    ------
    PatternError
        The plan does not fit the projector.
    DeviceError, ScanEvidenceError
        The rig failed, or the frames contradict the patterns.
    ScanCancelledError
        `cancelled()` became true.
    StorageError
        The disk refused. In every case nothing is left in `folder` and the projector is dark.
    """
    sequence = pattern_sequence(plan.patterns, rig.projector.info.size)
    if plan.exposure_s is not None:
        asked = plan.exposure_s
        rig = replace(rig, settings={name: replace(each, exposure_s=asked) for name, each in rig.settings.items()})
    formats = {name: camera.info.format for name, camera in rig.cameras.items()}
    total = len(sequence) * len(formats)
    with BundleWriter(folder, rig.projector.info.size, sequence.patterns, formats, rig.calibration) as writer:
        evidence = Evidence(sequence.patterns, formats)
        if frames is not None:
            listed = tuple((index, name) for index in range(len(sequence)) for name in formats)
            frames.begin(Outline(sequence.projector, sequence.patterns, formats, listed), rig.calibration)
        for count, shot in enumerate(capture(rig, sequence, cancelled=cancelled, evidence=evidence), start=1):
            if frames is not None:
                frames.take(shot)
            writer.add(shot)
            progress("capture", count / total, f"frame {count} of {total}")
        if frames is not None:
            frames.end(evidence.summary())
    truth = rig.truth()
    if truth is not None:
        write_truth(folder, truth)
