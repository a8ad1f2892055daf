"""The judgements of `slrig.calibration` as a session keeps them: plain JSON values, in the words of a person."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

from slrig.bundle import write_file
from slrig.calibrate.figures import baselines, device_figures
from slrig.calibrate.pose_pictures import white_frame
from slrig.calibrate.records import SessionRecord, Setting, plain
from slrig.calibrate.report import report_html
from slrig.calibrate.solving import CalibrationResult, ReadPose
from slrig.calibration.judgement import describe_board
from slrig.calibration.poses import Advice, Coverage, advise_pose, check_pose, coverage, estimate_rig


@dataclass(frozen=True, slots=True)
class SessionGuidance:
    """Where a session stands: what its poses cover, and what to move next and why; JSON values."""

    coverage: Mapping[str, Any]
    next_move: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Judgement:
    """Judgement of a pose. refusals : why it cannot be used, in words; none if it can. answer : its figures, as JSON
    values. standing : where the session stands with it, None where it could not be read.
    """

    refusals: tuple[str, ...]
    answer: Mapping[str, Any]
    standing: SessionGuidance | None


_ANSWER = (
    "warnings",
    "corners_found",
    "corners_expected",
    "filled",
    "tilt_deg",
    "distance_mm",
    "sharpness_px",
    "saturated",
    "moved_px",
)
"""Fields of `slrig.calibration.poses.checks.PoseAssessment` that belong to the pose alone."""

_CHECK = ("poses", "difference_mm", "stated_mm", "ratio", "chance", "fits", "words")
"""Fields of `slrig.calibration.accuracy.OddEven`, whose `motion` stands beside them."""


def judgement(pose: ReadPose, earlier: Sequence[ReadPose], setting: Setting) -> Judgement:
    """Return what to tell of a pose, the accepted ones before it at hand."""
    observations = [each.observation for each in earlier]
    found = check_pose(pose.observation, pose.figures, observations, setting.board, setting.sizes)
    return Judgement(found.refusals, _fields(found, *_ANSWER), _standing(found.coverage, found.advice))


def standing(poses: Sequence[ReadPose], setting: Setting) -> SessionGuidance:
    """Return what the accepted poses cover, and what to move next."""
    observations = [each.observation for each in poses]
    guess = estimate_rig(observations, setting.board, setting.sizes)
    covered = coverage(observations, setting.board, setting.sizes, rig=guess)
    return _standing(covered, advise_pose(observations, setting.board, setting.sizes, rig=guess, covered=covered))


def summary(result: CalibrationResult) -> Mapping[str, Any]:
    """Return the figures of a solve that an answer shows."""
    solution, bow, checked = result.solution, result.solution.bow, result.odd_even
    figures = {
        "devices": {
            each.name: {
                **_fields(each.residuals, "rms_px", "held_out_rms_px", "stated_rms_px", "outlying", "pose_rms_px"),
                "observations": each.residuals.count,
                "distortion": each.terms,
                "values": {name: astuple(figure) for name, figure in each.values.items()},
                "centre_mm": [astuple(figure) for figure in each.centre_mm],
            }
            for each in device_figures(result)
        },
        "baselines": baselines(result),
        "expected": _fields(
            result.expected, "point_mm", "noise_mm", "total_mm", "length_share", "across", "volume_mm", "board_mm"
        ),
        "odd_even": None if checked is None else {**_fields(checked, *_CHECK), **checked.motion._asdict()},
        "verdict": _fields(result.verdict, "grade", "summary", "reasons", "remarks", "unattended", "tolerance_mm"),
        "board": {
            "bowed": solution.board_shape_mm is not None,
            "bow_mm": None if bow is None else [bow.height_mm, bow.sigma_mm],
            "words": describe_board(solution),
            "scale_sigma": solution.size.scale_sigma,
            "stretch": [solution.size.stretch, solution.size.stretch_sigma],
        },
        "poses": list(solution.poses),
        "outliers": solution.outliers,
    }
    told: dict[str, Any] = plain(figures)
    return told


def write_report(
    path: Path, result: CalibrationResult, poses: Sequence[ReadPose], record: SessionRecord, bundles: Mapping[str, Path]
) -> None:
    """Write the report of a solve, with a picture of each pose. bundles : of the accepted poses, by name."""
    if record.board is None:
        raise TypeError(record)
    text = report_html(
        result,
        poses,
        {name: {camera: white_frame(bundle, camera) for camera in record.cameras} for name, bundle in bundles.items()},
        board=record.board,
        title=record.label or f"Rig '{record.rig}'",
        remarks={pose.name: list((pose.answer or {}).get("warnings", ())) for pose in record.accepted},
        refused={pose.name: pose.fault.message for pose in record.poses if pose.refused and pose.fault},
        machine=f"rig '{record.rig}'",
    )
    write_file(path, text.encode())


def warm() -> None:
    """Load what reading a pose needs, so that the first one is answered as fast as the others."""
    importlib.import_module("slrig.calibrate.pose_reading")


def _standing(found: Coverage, advice: Advice) -> SessionGuidance:
    shown = ("cells", "reachable", "share", "depths", "tilted", "turns", "distance_mm")
    devices = {name: _fields(each, *shown) for name, each in found.devices.items()}
    told = _fields(advice, "enough", "camera", "outline_px", "worst_px", "expected_px")
    return SessionGuidance({**_fields(found, "poses", "missing"), "devices": devices}, {"words": advice.text, **told})


def _fields(value: object, *names: str) -> dict[str, Any]:
    """Some fields of a value as JSON values."""
    return {name: plain(getattr(value, name)) for name in names}
