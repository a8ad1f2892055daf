"""Examination of a rig: findings with remedies, and a rig file with the measured values."""

from slrig.doctor.doctor import Diagnosis, doctor_sequence, examine, latency_from_document
from slrig.doctor.job import DoctorJob, LatencyJob
from slrig.doctor.light import Severity
from slrig.doctor.rig_file import refuse_existing, toml_value, write_rig_file

__all__ = [
    "Diagnosis",
    "DoctorJob",
    "LatencyJob",
    "Severity",
    "doctor_sequence",
    "examine",
    "latency_from_document",
    "refuse_existing",
    "toml_value",
    "write_rig_file",
]
