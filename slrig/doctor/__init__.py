"""Examination of a rig: findings with remedies, and a rig file with the measured values."""

from slrig.doctor.doctor import Diagnosis, doctor_sequence, examine, latency_from_document
from slrig.doctor.job import (
    EXAMINATIONS,
    DoctorJob,
    Examination,
    Examinations,
    LatencyJob,
    keep,
    last_examination,
)
from slrig.doctor.light import Severity
from slrig.doctor.rig_file import (
    known_stamp_errors_s,
    put_value,
    refuse_existing,
    toml_value,
    with_diagnosis,
    with_synchronisation,
    write_rig_file,
)

__all__ = [
    "EXAMINATIONS",
    "Diagnosis",
    "DoctorJob",
    "Examination",
    "Examinations",
    "LatencyJob",
    "Severity",
    "doctor_sequence",
    "examine",
    "keep",
    "known_stamp_errors_s",
    "last_examination",
    "latency_from_document",
    "put_value",
    "refuse_existing",
    "toml_value",
    "with_diagnosis",
    "with_synchronisation",
    "write_rig_file",
]
