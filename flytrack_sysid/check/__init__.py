"""Which conventions of a log contradict each other: units, signs, frames, orders, clocks."""

from flytrack_sysid.check.commands import after_rate_curve
from flytrack_sysid.check.explain import Change
from flytrack_sysid.check.plant import check_environment, check_plant, load_layout
from flytrack_sysid.check.report import write_check
from flytrack_sysid.check.result import Check, check_log
from flytrack_sysid.check.words import describe, problems_of, text_of

__all__ = [
    "Change",
    "Check",
    "after_rate_curve",
    "check_environment",
    "check_log",
    "check_plant",
    "describe",
    "load_layout",
    "problems_of",
    "text_of",
    "write_check",
]
