"""A rig of processes over vcan0 (controller side) and vcan1 (drive side), held against lock-step."""

import pytest

from tests.parity.parity import Parity
from tests.parity.patience import Patience
from tests.parity.walks import Walks, make_walks
from tests.vcan.inside.programs import VCAN

pytestmark = [pytest.mark.realtime, pytest.mark.usefixtures("nothing_left")]


@pytest.fixture(scope="module")
def walks(patience: Patience) -> Walks:
    """On vcan."""
    return make_walks(VCAN, patience)


class TestVcan(Parity):
    """SocketCAN."""

    bench = VCAN
