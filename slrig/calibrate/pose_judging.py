"""The judgements of `slrig.calibration` as a session keeps them: plain JSON values, in the words of a person."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from slrig.bundle.storage import write_file
from slrig.calibrate.figures import baselines, device_figures
from slrig.calibrate.pose_pictures import white_frame
from slrig.calibrate.records import SessionRecord, plain
from slrig.calibrate.report import report_html
from slrig.calibrate.solving import CalibrationResult, ReadPose
from slrig.calibrate.tools import Judgement, Setting, Standing
from slrig.calibration.judging.verdict import board_words
from slrig.calibration.poses.checks import judge_pose
from slrig.calibration.poses.coverage import Coverage, coverage
from slrig.calibration.poses.next_move import Advice, next_move
from slrig.calibration.poses.rough import rig_guess
from slrig.model import Pixels

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
"""Fields of `slrig.calibration.poses.checks.PoseAnswer` that belong to the pose alone."""


def judgement(pose: ReadPose, earlier: Sequence[ReadPose], setting: Setting) -> Judgement:
    """Return what to tell of a pose, the accepted ones before it at hand."""
    observations = [each.observation for each in earlier]
    found = judge_pose(pose.observation, pose.figures, observations, setting.board, setting.sizes)
    answer = {name: plain(getattr(found, name)) for name in _ANSWER}
    return Judgement(found.refusals, answer, Standing(_coverage(found.coverage), _advice(found.advice)))


def standing(poses: Sequence[ReadPose], setting: Setting) -> Standing:
    """Return what the accepted poses cover, and what to move next."""
    observations, sizes = [each.observation for each in poses], setting.sizes
    guess = rig_guess(observations, setting.board, sizes)
    covered = coverage(observations, setting.board, sizes, guess=guess)
    advice = next_move(observations, setting.board, sizes, guess=guess, covered=covered)
    return Standing(_coverage(covered), _advice(advice))


def summary(result: CalibrationResult) -> Mapping[str, Any]:
    """Return the figures of a solve that an answer shows."""
    devices = {}
    for each in device_figures(result):
        left = each.residuals
        devices[each.name] = {
            "rms_px": left.rms_px,
            "held_out_rms_px": left.held_out_rms_px,
            "stated_rms_px": left.stated_rms_px,
            "observations": left.count,
            "outlying": left.outlying,
            "pose_rms_px": left.pose_rms_px,
            "distortion": each.terms,
            "values": {name: [figure.value, figure.sigma] for name, figure in each.values.items()},
            "centre_mm": [[figure.value, figure.sigma] for figure in each.centre_mm],
        }
    expected, bow = result.expected, result.solution.bow
    figures = {
        "devices": devices,
        "baselines": baselines(result),
        "expected": {
            "point_mm": expected.point_mm,
            "noise_mm": expected.noise_mm,
            "total_mm": expected.total_mm,
            "length_share": expected.length_share,
            "across": expected.across,
            "volume_mm": expected.volume_mm,
        },
        "verdict": {
            "grade": result.verdict.grade,
            "summary": result.verdict.summary,
            "reasons": result.verdict.reasons,
        },
        "scale": result.scale,
        "board": {
            "bowed": result.solution.board_shape_mm is not None,
            "bow_mm": None if bow is None else [bow.height_mm, bow.sigma_mm],
            "words": board_words(result.solution),
        },
        "poses": list(result.solution.poses),
        "outliers": result.solution.outliers,
    }
    told: dict[str, Any] = plain(figures)
    return told


def write_report(
    path: Path, result: CalibrationResult, poses: Sequence[ReadPose], record: SessionRecord, bundles: Mapping[str, Path]
) -> None:
    """Write the report of a solve, with a picture of each pose. bundles : of the accepted poses, by name."""
    if record.board is None:
        raise TypeError(record)
    pictures: dict[str, dict[str, Pixels]] = {
        name: {camera: white_frame(bundle, camera) for camera in record.cameras} for name, bundle in bundles.items()
    }
    refused = {pose.name: pose.fault.message for pose in record.poses if pose.refused and pose.fault}
    remarks = {pose.name: list((pose.answer or {}).get("warnings", ())) for pose in record.accepted}
    text = report_html(
        result,
        poses,
        pictures,
        board=record.board,
        title=record.label or f"Rig '{record.rig}'",
        remarks=remarks,
        refused=refused,
        machine=f"rig '{record.rig}'",
    )
    write_file(path, text.encode())


def warm() -> None:
    """Load what reading a pose needs, so that the first one is answered as fast as the others."""
    importlib.import_module("slrig.calibrate.pose_reading")


def _coverage(found: Coverage) -> Mapping[str, Any]:
    devices = {
        name: {
            "cells": each.cells,
            "reachable": each.reachable,
            "share": each.share,
            "depths": each.depths,
            "tilted": each.tilted,
            "turns": each.turns,
            "distance_mm": each.distance_mm,
        }
        for name, each in found.devices.items()
    }
    told: dict[str, Any] = plain({"poses": found.poses, "devices": devices, "missing": found.missing})
    return told


def _advice(found: Advice) -> Mapping[str, Any]:
    told: dict[str, Any] = plain(
        {
            "words": found.words,
            "enough": found.enough,
            "camera": found.camera,
            "outline_px": found.outline_px,
            "worst_px": found.worst_px,
            "expected_px": found.expected_px,
        }
    )
    return told
