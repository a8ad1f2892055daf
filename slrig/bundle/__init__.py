"""The scan bundle: a folder with a description, frames, and a calibration, written by us or by someone else."""

from slrig.bundle.calibration import (
    check_calibration,
    read_calibration,
    read_opencv_calibration,
    write_calibration,
    write_opencv_calibration,
)
from slrig.bundle.reading import Bundle, read_bundle, read_capture
from slrig.bundle.sidecars import BundleTruth, read_truth, write_truth
from slrig.bundle.writing import BundleWriter, write_bundle

__all__ = [
    "Bundle",
    "BundleTruth",
    "BundleWriter",
    "check_calibration",
    "read_bundle",
    "read_calibration",
    "read_capture",
    "read_opencv_calibration",
    "read_truth",
    "write_bundle",
    "write_calibration",
    "write_opencv_calibration",
    "write_truth",
]
