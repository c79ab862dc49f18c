"""What these tests share."""

import pytest

from testbench.plugin.exo import Exo


@pytest.fixture
def walking(exo: Exo) -> Exo:
    """A rig that has walked for half a second."""
    exo.run_until_motion()
    exo.run_for("0.5 s")
    return exo
