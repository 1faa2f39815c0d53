"""Tests of which most cases are slow."""

from collections.abc import Container, Iterable
from typing import Any

import pytest


def slow_but(fast: Container[Any], values: Iterable[Any]) -> list[Any]:
    """Return the cases of a test, marked as slow but for the fast ones."""
    return [
        pytest.param(value, marks=[] if value in fast else pytest.mark.slow) for value in values
    ]
