"""The way from power-up to the first step."""

import pytest

from canopen_exo.cia402 import DriveState
from canopen_exo.master import MasterState
from canopen_exo.nmt import NmtState
from canopen_exo.plan import HEARTBEAT, HLC_STATUS, RPDO1, TPDO1
from testbench.plugin.exo import Exo
from testbench.plugin.observer import ControllerState


@pytest.mark.requirement("START-1")
def test_no_drive_is_asked_for_torque_before_it_is_enabled(exo: Exo) -> None:
    """RPDO1 of the knee asks for no torque until its statusword says Operation enabled."""
    knee = exo.drives["right_knee"]
    exo.run_until(lambda: knee.state is DriveState.OPERATION_ENABLED, within="10 s")
    commands = [row.frame.data for row in exo.frames("drive", last=100_000) if row.frame.can_id == RPDO1 + knee.node_id]
    assert commands
    assert all(data[2:4] == b"\x00\x00" for data in commands)


@pytest.mark.requirement("START-2", "START-3")
def test_everything_is_enabled_when_the_motion_begins(exo: Exo) -> None:
    """At time 0 all drives are operational and enabled, and the controller says so on the bus."""
    exo.run_until_motion()
    assert exo.master.state is MasterState.OPERATIONAL
    assert exo.controller.state is ControllerState.MOTION
    assert {drive.state for drive in exo.drives.values()} == {DriveState.OPERATION_ENABLED}
    assert {drive.nmt for drive in exo.drives.values()} == {NmtState.OPERATIONAL}
    exo.expect(HLC_STATUS, data="02 .. .. .. ..", bus="controller", within="1 s")


@pytest.mark.requirement("START-4")
def test_a_drive_that_does_not_report_stops_the_start(exo: Exo) -> None:
    """Without the knee's boot-up message the master gives up, and no drive is ever started."""
    knee = exo.drives["right_knee"].node_id
    exo.gateway.inject(target={"bus": "to_controller", "cob_id": HEARTBEAT + knee}, fault={"type": "drop"})
    exo.expect_none(TPDO1 + knee, within="2 s")
    assert exo.drives["left_hip"].nmt is NmtState.PRE_OPERATIONAL
