"""A campaign over vcan0 and vcan1."""

from pathlib import Path

import pytest

from tests.parity.six_runs import make_six_runs
from tests.vcan.inside.programs import VCAN

pytestmark = [pytest.mark.realtime, pytest.mark.usefixtures("nothing_left")]


def test_campaign_of_six_runs_on_vcan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`campaign run --realtime --controller-bus ... --drive-bus ...`: the file that the hub runs."""
    make_six_runs(VCAN, tmp_path, capsys)
