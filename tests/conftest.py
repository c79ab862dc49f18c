"""What all tests share."""

import pytest

pytest.register_assert_rewrite("tests.parity.parity", "tests.parity.rigs", "tests.parity.walks")  # say what was found

from tests.parity.patience import Patience  # noqa: E402 - what it imports is rewritten as well


@pytest.fixture(scope="session")
def patience() -> Patience:
    """How often a run that was late may be repeated."""
    return Patience()
