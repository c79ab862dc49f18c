"""A campaign over vcan0 and vcan1."""

from pathlib import Path

import pytest

from tests.parity.six_runs import make_six_runs
from tests.vcan.inside.programs import VCAN
from tests.vcan.inside.test_rig import BUS_OPTIONS

pytestmark = [pytest.mark.realtime, pytest.mark.usefixtures("nothing_left")]

IN_UML = "User Mode Linux" in Path("/proc/cpuinfo").read_text(encoding="utf-8")


@pytest.mark.skipif(IN_UML, reason="seven rigs are too many for User Mode Linux; needs a vcan of the kernel")
def test_campaign_of_six_runs_on_vcan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`campaign run --realtime --controller-bus ... --drive-bus ...`: the file that the hub runs."""
    make_six_runs(VCAN, list(BUS_OPTIONS), tmp_path, capsys)
