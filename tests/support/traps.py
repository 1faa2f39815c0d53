"""What only an unpickler can bring back."""

import pytest


class Trap:
    """Fails the test that unpickles it."""

    def __reduce__(self) -> tuple:
        return (pytest.fail, ("a pickle was read",))
