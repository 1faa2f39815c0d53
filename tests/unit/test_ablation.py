"""Disabling a rule of the diagnosis reaches every place that calls it, for a time."""

import pytest

from benchmarks.ablation import RULES, has_fired, replaced
from flytrack_sysid.diagnosis import diagnose, vetoes


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_rule_is_replaced_where_it_is_imported_and_comes_back(rule):
    original, listed = getattr(rule.module, rule.name), vetoes.VETOES
    with replaced(rule, rule.disabled):
        assert getattr(rule.module, rule.name) is rule.disabled
        assert all(original is not one for one in vetoes.VETOES)
    assert getattr(rule.module, rule.name) is original and listed == vetoes.VETOES


def test_a_rule_is_replaced_in_modules_that_import_its_name():
    (rule,) = (one for one in RULES if one.name == "with_changes")
    module = __import__(diagnose.__module__, fromlist=["with_changes"])
    with replaced(rule, rule.disabled):
        assert module.with_changes is rule.disabled


@pytest.mark.parametrize(
    ("result", "disabled", "expected"),
    [
        ([], [], False),
        (["wind"], [], True),
        ((), (), False),
        (("cause",), (), True),
        (("later", None), ("state", None), False),
        (("later", "model"), ("state", None), True),
        (False, True, True),
        ({}, {}, False),
    ],
)
def test_a_rule_has_fired_if_its_result_is_not_that_of_the_disabled_one(result, disabled, expected):
    assert has_fired(result, disabled) is expected
