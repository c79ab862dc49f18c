"""What all tests share."""

import pytest

from tests.parity.patience import Patience


@pytest.fixture(scope="session")
def patience() -> Patience:
    """How often a run that was late may be repeated."""
    return Patience()
