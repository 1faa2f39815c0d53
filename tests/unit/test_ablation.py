"""Disabling a rule of the diagnosis reaches every place that calls it, for a time."""

import sys

import pytest

from benchmarks.ablation import BY_NAME, RULES, has_fired, replaced
from flytrack_sysid.diagnosis import diagnose, vetoes

IMPORTER = sys.modules[diagnose.__module__]  # of a rule that another module defines


@pytest.mark.parametrize(
    ("rule", "module"),
    [*((rule, rule.module) for rule in RULES), (BY_NAME["with_changes"], IMPORTER)],
)
def test_a_rule_is_replaced_where_it_is_imported_and_comes_back(rule, module):
    original, listed = getattr(module, rule.name), vetoes.VETOES
    with replaced(rule, rule.disabled):
        assert getattr(module, rule.name) is rule.disabled
        assert original not in vetoes.VETOES
    assert getattr(module, rule.name) is original and listed == vetoes.VETOES


@pytest.mark.parametrize(
    ("result", "disabled", "expected"),
    [
        ([], [], False),
        (["wind"], [], True),
        (("later", None), ("state", None), False),
        (("later", "model"), ("state", None), True),
        (False, True, True),
    ],
)
def test_a_rule_has_fired_if_its_result_is_not_that_of_the_disabled_one(result, disabled, expected):
    assert has_fired(result, disabled) is expected
