"""Tests of which most cases are slow."""

import pytest


def slow_but(fast, values):
    """Return the cases of a test, marked as slow but for the fast ones."""
    return [
        pytest.param(value, marks=[] if value in fast else pytest.mark.slow) for value in values
    ]
