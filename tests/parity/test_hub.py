"""A rig of processes on the timed hub, held against lock-step. At 100 Hz, so that a busy machine is late rarely."""

import pytest

from tests.parity.parity import Parity
from tests.parity.patience import Patience
from tests.parity.walks import Bench, Walks, make_walks

pytestmark = pytest.mark.realtime

HUB = Bench(None, 100)


@pytest.fixture(scope="module")
def walks(patience: Patience) -> Walks:
    """On the hub."""
    return make_walks(HUB, patience)


class TestHub(Parity):
    """Timed mode, the default of a rig without interfaces."""

    bench = HUB
