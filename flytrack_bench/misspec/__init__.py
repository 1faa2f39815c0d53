"""The benchmark ``misspec-v1``: name what a simulator gets wrong, from a log and a model.

A method is a function ``(FlightLog, ModelParameters) -> Answer``.
"""

from flytrack_bench.misspec.answer import KNOWN, Answer, AnswerError, diagnose_log
from flytrack_bench.misspec.door import run_method
from flytrack_bench.misspec.scores import SHARES, summarize
from flytrack_bench.misspec.suite import Flights, LogSuite, is_log_suite, load_log_suite

__all__ = [
    "KNOWN",
    "SHARES",
    "Answer",
    "AnswerError",
    "Flights",
    "LogSuite",
    "diagnose_log",
    "is_log_suite",
    "load_log_suite",
    "run_method",
    "summarize",
]
