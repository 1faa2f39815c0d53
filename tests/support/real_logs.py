"""Where the tests find measured flights."""

import os
from functools import cache
from pathlib import Path

import pytest

from flytrack_sysid import import_log
from tests.support.pages import ROOT

VARIABLE = "FLYTRACK_SHARED_DATA"
CRAZYFLIE, BETAFLIGHT = "crazyflie_rate_flights", "betaflight_acro_log"


def shared(name):
    """Return a folder of measured flights; skips the test where it is absent."""
    folder = Path(os.environ.get(VARIABLE, ROOT.parent / "shared" / "data")) / name
    if not folder.is_dir():
        pytest.skip(f"no measured flights at {folder}; {VARIABLE} can name the folder of {name}")
    return folder


@cache
def import_shared(where, form, mapping):
    """Return a measured flight, imported once; where: its folder and file."""
    folder, _, file = where.partition("/")
    return import_log(shared(folder) / file, form, mapping)
