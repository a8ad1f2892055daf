"""The first half of a scan: play the plan's patterns on a rig and record a bundle.

Apart from the pipeline because the process that owns the rig needs none of the mathematics, and does not load it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from slrig.bundle import BundleWriter, write_truth
from slrig.capture.sequencer import capture
from slrig.devices import Rig
from slrig.scan.holding import pattern_sequence
from slrig.scan.plan import Progress, ScanPlan


def capture_bundle(
    rig: Rig, plan: ScanPlan, folder: Path, *, progress: Progress, cancelled: Callable[[], bool]
) -> None:
    """Play the plan's patterns on the rig and record a bundle in `folder`, which must not exist.

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
        for count, shot in enumerate(capture(rig, sequence, cancelled=cancelled), start=1):
            writer.add(shot)
            progress("capture", count / total, f"frame {count} of {total}")
    truth = rig.truth()
    if truth is not None:
        write_truth(folder, truth)
