"""Find what a simulation gets wrong from a flight log.

A diagnosis names causes, says which of them cannot be told apart, and what is left unexplained.
"""

from flytrack_sysid.diagnosis.before import diagnose_change
from flytrack_sysid.diagnosis.diagnose import DiagnosisError, diagnose, first_look, joined
from flytrack_sysid.diagnosis.first_look import NOT_CHECKED
from flytrack_sysid.diagnosis.motion_choice import motion_of
from flytrack_sysid.diagnosis.report import text_of, write_diagnosis
from flytrack_sysid.diagnosis.result import (
    Cause,
    Diagnosis,
    Estimated,
    NotIdentifiable,
    Unexplained,
)

__all__ = [
    "NOT_CHECKED",
    "Cause",
    "Diagnosis",
    "DiagnosisError",
    "Estimated",
    "NotIdentifiable",
    "Unexplained",
    "diagnose",
    "diagnose_change",
    "first_look",
    "joined",
    "motion_of",
    "text_of",
    "write_diagnosis",
]
