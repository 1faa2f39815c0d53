"""Measured flights: black boxes on logs that have rates only, and the page of the records that are kept."""

import re

import pytest

from benchmarks import real_logs
from tests.support.slow import slow_but

STEP_S, LAG_S, GAIN = 0.01, 0.05, 10.0


@pytest.mark.parametrize("name", slow_but(["crazyflie"], real_logs.CRAFTS))
def test_every_record_gives_a_section_with_a_paragraph_and_its_picture(name):
    if not real_logs.kept(name).exists():
        pytest.skip(f"no record of {name}")
    text, pictures = real_logs.page()
    part = text.partition(f"## {real_logs.CRAFTS[name].title}\n")[2].partition("\n## ")[0]
    assert "From a small step of the stick" in part and not re.search(r"\bnan\b|None", part)
    shown = set(re.findall(r"\((real_.*\.png)\)", part))
    assert shown and shown <= set(pictures)
