"""Measured flights, imported one by one, as their clocks are corrected by an import."""

import re
import tempfile
from functools import cache
from pathlib import Path

from benchmarks.real.crazyflie import DATA
from flytrack_sysid import Imported, import_log

# Folder, files, format, and a mapping: of a name, of the folder, or none.
SETS = (
    ("crazyflie_rate_flights", "seed*.csv.gz", "csv", "crazyflie_phoenix"),
    ("nanobench", "*.csv.gz", "csv", "nanobench"),
    ("cf_utias_angle", "*.csv.gz", "csv", "crazyflie_fmpc"),
    ("eth_quadrotor_model", "*.csv", "csv", "eth.toml"),
    ("px4_h520", "*.ulg", "ulog", None),
    ("betaflight_acro_log", "*.BFL", "betaflight", None),
    ("bf_gecko", "*.bbl", "betaflight", "gecko.toml"),
)
ARPL = {"log15": (14.0, 52.0), "log16": (16.0, 31.0)}  # s in the air
NEWER_LEE = 180  # from this log on the thrust has another name


@cache
def measured_flights() -> dict[str, Imported]:
    """Return the measured flights by folder and file; none if there are no data."""
    flights: dict[str, Imported] = {}
    for folder, files, log_format, mapping in SETS:
        for path in sorted((DATA / folder).glob(files)):
            mapping_of_folder = DATA / folder / (mapping or "")
            source = mapping_of_folder if mapping_of_folder.is_file() else mapping
            flights[f"{folder}/{path.name}"] = import_log(path, log_format, source)
    with tempfile.TemporaryDirectory() as temporary:
        changed = Path(temporary) / "map.toml"
        for name, (start, end) in ARPL.items():
            rows = f"[rows]\nfrom_s = {start}\nto_s = {end}\n"
            changed.write_text(f'extends = "crazyflie_motors"\n{rows}')
            path = DATA / "cf_arpl_motors" / name
            if path.exists():
                flights[f"cf_arpl_motors/{name}"] = import_log(path, "usd", changed)
        for path in sorted(DATA.glob("cf_lee_*/log*")):
            number = int(path.name.removeprefix("log"))
            stated = path.with_name(f"info{number}.yaml").read_text()
            mass = float(re.findall(r"^mass:\s*(\S+)", stated, re.MULTILINE)[0])
            thrust = "thrustSI" if number > NEWER_LEE else "thrustSi"
            changed.write_text(
                f'extends = "crazyflie_lee"\n[thrust_command]\ncolumn = "ctrlLee.{thrust}"\n'
                f"[craft]\nmass_kg = {mass}\n"
            )
            flights[f"{path.parent.name}/{path.name}"] = import_log(path, "usd", changed)
    return flights
