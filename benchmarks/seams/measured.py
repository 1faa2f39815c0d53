"""Measured flights, imported one by one, as their clocks are corrected by an import."""

import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

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


def measured_flights(data: Path) -> Iterator[tuple[str, Imported]]:
    """Yield the name and the import of each flight below a folder."""
    for folder, files, form, mapping in SETS:
        for path in sorted((data / folder).glob(files)):
            own = data / folder / (mapping or "")
            where = own if own.is_file() else mapping
            yield f"{folder}/{path.name}", import_log(path, form, where)
    with tempfile.TemporaryDirectory() as temporary:
        changed = Path(temporary) / "map.toml"
        for name, (start, end) in ARPL.items():
            rows = f"[rows]\nfrom_s = {start}\nto_s = {end}\n"
            changed.write_text(f'extends = "crazyflie_motors"\n{rows}')
            path = data / "cf_arpl_motors" / name
            if path.exists():
                yield f"cf_arpl_motors/{name}", import_log(path, "usd", changed)
        for path in sorted(data.glob("cf_lee_*/log*")):
            number = int(path.name.removeprefix("log"))
            stated = path.with_name(f"info{number}.yaml").read_text()
            mass = float(re.findall(r"^mass:\s*(\S+)", stated, re.MULTILINE)[0])
            thrust = "thrustSI" if number > NEWER_LEE else "thrustSi"
            changed.write_text(
                f'extends = "crazyflie_lee"\n[thrust_command]\ncolumn = "ctrlLee.{thrust}"\n'
                f"[craft]\nmass_kg = {mass}\n"
            )
            yield f"{path.parent.name}/{path.name}", import_log(path, "usd", changed)
