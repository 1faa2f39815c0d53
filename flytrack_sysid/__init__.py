"""System identification: fly an excitation, fit a model, validate it and diagnose what it lacks."""

from flytrack_env.extras import check_installed

check_installed(
    "sysid", "identification and diagnosis", "scipy", "threadpoolctl", "matplotlib", "tqdm"
)

from flytrack_sysid.collect import CollectError, collect
from flytrack_sysid.diagnosis import Diagnosis, DiagnosisError, diagnose, diagnose_change
from flytrack_sysid.estimate import FitError
from flytrack_sysid.fit import Fit, fit
from flytrack_sysid.importing import Imported, import_log
from flytrack_sysid.log import FlightLog, LogError, log_of_states
from flytrack_sysid.log_file import load_log, save_log
from flytrack_sysid.script_file import Script, ScriptError, load_script, save_script
from flytrack_sysid.split import held_out_rows
from flytrack_sysid.validate import Validation, validate

__all__ = [
    "CollectError",
    "Diagnosis",
    "DiagnosisError",
    "Fit",
    "FitError",
    "FlightLog",
    "Imported",
    "LogError",
    "Script",
    "ScriptError",
    "Validation",
    "collect",
    "diagnose",
    "diagnose_change",
    "fit",
    "held_out_rows",
    "import_log",
    "load_log",
    "load_script",
    "log_of_states",
    "save_log",
    "save_script",
    "validate",
]
