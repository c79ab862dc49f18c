"""What drives and controller do when the other side falls silent."""

import pytest

from canopen_exo.cia402 import DriveState
from canopen_exo.plan import EMCY, RPDO1, SYNC
from testbench.plugin.exo import Exo
from testbench.plugin.observer import ControllerState


@pytest.mark.requirement("SAFE-1")
def test_a_drive_without_commands_drops_its_torque(walking: Exo) -> None:
    """Ten cycles without RPDO1: EMCY 8250, and the drive disables itself."""
    knee = walking.drives["right_knee"]
    walking.gateway.inject(
        target={"bus": "to_drives", "node": "right_knee", "pdo": "RPDO1"}, fault={"type": "drop"}, name="silence"
    )
    walking.expect(EMCY + knee.node_id, data="50 82 .. .. .. .. .. ..", within="15 cycles")
    walking.run_until(lambda: knee.state is DriveState.SWITCH_ON_DISABLED, within="15 cycles")


@pytest.mark.requirement("SAFE-1", "SAFE-2")
def test_one_disabled_drive_ends_the_motion_of_all(walking: Exo) -> None:
    """The controller sees that a drive has left Operation enabled, and disables the others."""
    walking.gateway.inject(
        target={"bus": "to_drives", "node": "left_hip", "pdo": "RPDO1"}, fault={"type": "drop"}
    )
    walking.run_until(lambda: walking.controller.state is ControllerState.STOPPED, within="60 cycles")
    walking.run_for("60 cycles")
    assert DriveState.OPERATION_ENABLED not in {drive.state for drive in walking.drives.values()}


@pytest.mark.requirement("SAFE-3")
def test_drives_notice_that_sync_has_stopped(walking: Exo) -> None:
    """Five cycles without SYNC: every drive reports 8700 by itself."""
    walking.gateway.inject(target={"bus": "to_drives", "cob_id": SYNC}, fault={"type": "drop"})
    walking.expect_none(SYNC, within="3 cycles")
    walking.run_for("10 cycles")
    assert all(0x8700 in {one.code for one in drive.emergencies} for drive in walking.drives.values())


@pytest.mark.requirement("SAFE-4")
def test_a_few_lost_commands_are_ridden_out(walking: Exo) -> None:
    """Half of the knee's commands lost for 0.2 s: no emergency, the walk goes on."""
    fault = walking.gateway.inject(
        target={"bus": "to_drives", "cob_id": RPDO1 + 5}, fault={"type": "drop", "probability": 0.5}, duration="0.2 s"
    )
    walking.expect_none(EMCY + 5, within="0.3 s")
    assert fault.row.manifested > 0
    assert walking.controller.state is ControllerState.MOTION
