"""The drive's firmware: loss of communication, and fault reset."""

import struct
from collections.abc import Callable

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS
from tests.joint_emulators.drive_on_bus import (
    CYCLE,
    DISABLED,
    ENABLE,
    ENABLED,
    FAULT,
    HEARTBEAT_LOST,
    NM,
    NODE,
    READY,
    RPDO_LATE,
    SYNC_LOST,
    Joint,
    enabled_joint,
)


@pytest.fixture
def enabled() -> Joint:
    return enabled_joint()


# ---- loss of communication ----------------------------------------------------------------------------------------


def lose_sync(joint: Joint) -> None:
    """SYNC stops; its loss comes 5 periods of 0x1006 after the last one."""
    joint.pass_time(10 * MS - 1)
    assert joint.drive.torque_nm == pytest.approx(500 * NM)
    joint.pass_time(1)


def lose_rpdo(joint: Joint) -> None:
    """SYNC goes on, RPDOs stop; 0x1400:5 = 20 ms after the last one, which came with the SYNC before now."""
    for _ in range(9):
        joint.sync()
    joint.pass_time(CYCLE - 1)
    assert joint.drive.torque_nm == pytest.approx(500 * NM)
    joint.pass_time(1)


def lose_heartbeat(joint: Joint) -> None:
    """The master's heartbeat stops, everything else goes on; 0x1016 = 300 ms after the last one, that of now."""
    joint.hear(0x77F, b"\x05")
    for _ in range(149):
        joint.command(0x0F, torque=500)
    joint.pass_time(CYCLE - 1)
    assert joint.drive.torque_nm == pytest.approx(500 * NM)
    joint.pass_time(1)


LOSSES = [(lose_sync, SYNC_LOST), (lose_rpdo, RPDO_LATE), (lose_heartbeat, HEARTBEAT_LOST)]


def supervised(option: int) -> Joint:
    """In Operation enabled with 500 per mille, its SYNC, RPDO and master watched; 6007 = option."""
    joint = Joint()
    assert joint.write(0x1006, 2000, 4) == 0
    assert joint.write(0x1400, 20, 2, sub=5) == 0
    assert joint.write(0x1016, 127 << 16 | 300, 4, sub=1) == 0
    assert joint.write(0x6007, option, 2) == 0
    joint.command(*ENABLE)
    joint.sync()
    joint.rpdo(0x0F, 500)  # at the very instant of the SYNC that applies it: both count from here
    joint.counter = joint.counter % 240 + 1
    joint.hear(0x080, bytes((joint.counter,)))
    return joint


@pytest.mark.parametrize(("lose", "code"), LOSSES)
@pytest.mark.parametrize(
    ("option", "state"),
    [
        (0, ENABLED),  # no action
        (1, FAULT),  # fault signal
        (2, DISABLED),  # disable voltage command
        (3, DISABLED),  # quick stop command, with 605A = 0
    ],
)
def test_lost_connection_acts_as_6007_says_at_its_exact_time(
    lose: Callable[[Joint], None], code: int, option: int, state: int
) -> None:
    """CiA 402-2, 0x6007 abort connection option code, for each of the three ways to lose the master."""
    joint = supervised(option)
    lose(joint)
    assert joint.state == state
    assert joint.drive.torque_nm == pytest.approx(500 * NM if option == 0 else 0.0)
    assert joint.read(0x603F) == code


@pytest.mark.parametrize(("lose", "code"), LOSSES)
def test_lost_connection_is_told_by_one_emcy(lose: Callable[[Joint], None], code: int) -> None:
    """Device table: EMCY with the code, error register 0x11 (generic, communication), once."""
    joint = supervised(2)
    lose(joint)
    messages = [frame for frame in joint.sink.sent if frame.can_id == 0x080 + NODE]
    assert messages == [Frame(0x080 + NODE, struct.pack("<HB5x", code, 0x11))]
    assert joint.read(0x1001) == 0x11


def test_lost_connection_with_6007_0_leaves_command_and_torque_in_the_masters_hand() -> None:
    """Option 0, no action: the torque is held, and the next command acts."""
    joint = supervised(0)
    lose_sync(joint)
    joint.command(0x0F, torque=-200)
    assert joint.drive.torque_nm == pytest.approx(-200 * NM)


def test_drive_does_not_start_again_by_itself_when_the_connection_is_back() -> None:
    """Safe by default: the same 0x0F as before the loss brings no torque."""
    joint = supervised(2)
    lose_sync(joint)
    joint.command(0x0F, 0x0F, torque=500)
    assert (joint.state, joint.drive.torque_nm) == (DISABLED, 0.0)


def test_held_shutdown_acts_again_after_the_drive_disabled_itself() -> None:
    """Commands of the controlword are levels (only fault reset is an edge): a master that holds 0x06 gets Ready."""
    joint = supervised(2)
    joint.command(0x06)
    assert joint.state == READY
    joint.pass_time(10 * MS)
    assert joint.state == DISABLED
    joint.command(0x06)
    assert joint.state == READY


def test_sync_that_comes_back_is_told_at_once() -> None:
    """CiA 301, 7.2.7: EMCY 0000 with the SYNC that ends the loss, not with some later timer."""
    joint = supervised(2)
    lose_sync(joint)
    assert Frame(0x080 + NODE, bytes(8)) in joint.sync()
    assert joint.read(0x1001) == 0


def find_sync(joint: Joint) -> None:
    joint.sync()


def find_rpdo(joint: Joint) -> None:
    joint.rpdo(0x00)


def find_heartbeat(joint: Joint) -> None:
    joint.hear(0x77F, b"\x05")


FOUND = [(lose_sync, find_sync), (lose_rpdo, find_rpdo), (lose_heartbeat, find_heartbeat)]


@pytest.mark.parametrize(("lose", "find"), FOUND)
@pytest.mark.parametrize("option", [0, 2, 3])
def test_error_code_is_clear_again_when_the_last_error_is_gone(
    lose: Callable[[Joint], None], find: Callable[[Joint], None], option: int
) -> None:
    """0x603F tells of an error that is there: without Fault it goes with the error, as 0x1001 and EMCY 0000 do."""
    joint = supervised(option)
    lose(joint)
    assert joint.read(0x603F) != 0
    find(joint)
    assert (joint.read(0x1001), joint.read(0x603F)) == (0, 0)


def test_error_code_stays_while_another_error_lasts() -> None:
    """SYNC and RPDO lost, RPDO back: something is still wrong, and 0x603F is not 0 before SYNC is back too."""
    joint = supervised(2)
    lose_sync(joint)
    joint.pass_time(10 * MS)
    assert joint.read(0x603F) == RPDO_LATE
    joint.rpdo(0x00)
    assert joint.read(0x1001) == 0x11
    assert joint.read(0x603F) != 0
    joint.sync()
    assert (joint.read(0x1001), joint.read(0x603F)) == (0, 0)


def test_error_code_is_clear_after_reset_communication() -> None:
    """NMT reset communication forgets all errors; what 0x603F said of them goes with them."""
    joint = supervised(2)
    lose_sync(joint)
    joint.nmt(0x82)
    joint.pass_time(10 * MS)
    assert (joint.state, joint.read(0x1001), joint.read(0x603F)) == (DISABLED, 0, 0)


def test_error_code_in_tpdo2_goes_with_the_error() -> None:
    """What the master sees without asking: 8700 is gone from TPDO2 with the SYNC that ends it."""
    joint = supervised(2)
    joint.write(0x1801, 1 << 31 | 0x280 + NODE, 4, sub=1)
    joint.write(0x1801, 1, 1, sub=2)
    joint.write(0x1801, 0, 1, sub=6)
    assert joint.write(0x1801, 0x280 + NODE, 4, sub=1) == 0
    lose_sync(joint)
    assert joint.read(0x603F) == SYNC_LOST
    (frame,) = [frame for frame in joint.sync() if frame.can_id == 0x280 + NODE]
    assert struct.unpack("<HhH", frame.data)[2] == 0


def test_unwatched_connection_does_not_end_by_silence(enabled: Joint) -> None:
    """1006 = 0, 1400:5 = 0, 1016 unused: nothing is watched, the last command stands."""
    enabled.pass_time(1000 * MS)
    assert enabled.state == ENABLED
    assert enabled.drive.torque_nm == pytest.approx(500 * NM)


@pytest.mark.parametrize(("command", "name"), [(0x80, "pre-operational"), (0x02, "stop"), (0x82, "reset")])
@pytest.mark.parametrize(("option", "state"), [(0, ENABLED), (1, FAULT), (2, DISABLED), (3, DISABLED)])
def test_leaving_operational_counts_as_a_lost_connection(command: int, name: str, option: int, state: int) -> None:
    """Without PDOs nobody commands the torque: 6007 decides, as for a lost connection."""
    joint = supervised(option)
    joint.nmt(command)
    assert joint.drive.torque_nm == pytest.approx(500 * NM if option == 0 else 0.0)
    joint.pass_time(10 * MS)
    if command == 0x02:
        joint.nmt(0x80)  # SDO is not served in Stopped
    assert joint.state == state


def test_nmt_reset_node_ends_torque_whatever_6007_says() -> None:
    """CiA 301: reset node sets everything to power-on values; the drive is in Switch on disabled."""
    joint = supervised(0)
    joint.nmt(0x81)
    assert joint.drive.torque_nm == 0.0
    joint.pass_time(10 * MS)
    assert (joint.state, joint.read(0x6040), joint.read(0x6071), joint.read(0x6007)) == (DISABLED, 0, 0, 2)


# ---- fault reset --------------------------------------------------------------------------------------------------


def in_fault() -> Joint:
    joint = supervised(1)
    lose_sync(joint)
    assert joint.state == FAULT
    return joint


@pytest.mark.parametrize("word", [0x80, 0x8F, 0x86])
def test_fault_is_left_on_the_rising_edge_of_bit_7(word: int) -> None:
    """Transition 15, and 0x603F is clear again; the other bits of that word do not act."""
    joint = in_fault()
    joint.command(word, torque=500)
    assert (joint.state, joint.read(0x603F), joint.drive.torque_nm) == (DISABLED, 0, 0.0)


@pytest.mark.parametrize(("lose", "find"), FOUND)
@pytest.mark.parametrize("word", [0x80, 0x8F, 0x86])
def test_fault_reset_is_refused_while_its_cause_lasts(
    lose: Callable[[Joint], None], find: Callable[[Joint], None], word: int
) -> None:
    """CiA 402-2, transition 15: only when the fault is no longer there (0x1001 = 0); its code stays until then."""
    joint = supervised(1)
    lose(joint)
    code = joint.read(0x603F)
    for controlword in (word, 0x00, word):
        joint.write(0x6040, controlword, 2)
        assert (joint.state, joint.read(0x603F), joint.read(0x1001)) == (FAULT, code, 0x11)
    joint.write(0x6040, 0x00, 2)
    find(joint)
    assert (joint.state, joint.read(0x603F), joint.read(0x1001)) == (FAULT, code, 0)  # the fault waits for its reset
    joint.write(0x6040, word, 2)
    assert (joint.state, joint.read(0x603F)) == (DISABLED, 0)


def test_fault_reset_that_is_held_acts_when_the_cause_is_gone() -> None:
    """A master that asks in every cycle need not take the bit back: the refused edge counts once nothing is wrong."""
    joint = supervised(1)
    lose_heartbeat(joint)
    joint.command(0x80, 0x80, 0x80)
    assert (joint.state, joint.read(0x603F)) == (FAULT, HEARTBEAT_LOST)
    joint.hear(0x77F, b"\x05")
    assert joint.state == FAULT
    joint.command(0x80)
    assert (joint.state, joint.read(0x603F)) == (DISABLED, 0)


def test_bit_7_set_before_the_fault_does_not_reset_it_when_the_cause_is_gone() -> None:
    """An edge, not a level, while the error lasts as well."""
    joint = supervised(1)
    joint.command(0x8F, torque=500)
    joint.hear(0x77F, b"\x05")
    for _ in range(150):
        joint.command(0x8F, torque=500)
    assert (joint.state, joint.read(0x603F)) == (FAULT, HEARTBEAT_LOST)
    joint.hear(0x77F, b"\x05")
    joint.command(0x8F, 0x8F, torque=500)
    assert joint.state == FAULT
    joint.command(0x0F, 0x8F)
    assert joint.state == DISABLED


def test_fault_and_its_code_survive_reset_communication() -> None:
    """Reset communication is no fault reset: the application goes on as it was; then the reset is not refused."""
    joint = in_fault()
    joint.nmt(0x82)
    joint.pass_time(10 * MS)
    assert (joint.state, joint.read(0x1001), joint.read(0x603F)) == (FAULT, 0, SYNC_LOST)
    joint.write(0x6040, 0x80, 2)
    assert (joint.state, joint.read(0x603F)) == (DISABLED, 0)


@pytest.mark.parametrize("words", [(0x00,), (0x06,), (0x06, 0x07, 0x0F), (0x0F,)])
def test_fault_is_not_left_without_bit_7(words: tuple[int, ...]) -> None:
    """Fault has one way out."""
    joint = in_fault()
    joint.command(*words, torque=500)
    assert (joint.state, joint.read(0x603F), joint.drive.torque_nm) == (FAULT, SYNC_LOST, 0.0)


def test_bit_7_set_before_the_fault_does_not_reset_it() -> None:
    """An edge, not a level: it must be taken back first."""
    joint = supervised(1)
    joint.command(0x8F, torque=500)  # Enable operation with bit 7: no fault to reset, the drive stays enabled
    lose_sync(joint)
    assert joint.state == FAULT
    joint.command(0x8F, 0x8F)
    assert joint.state == FAULT
    joint.command(0x0F, 0x8F)
    assert joint.state == DISABLED


def test_drive_can_be_enabled_again_after_a_fault_reset() -> None:
    """Fault, reset, 06, 07, 0F: torque again."""
    joint = in_fault()
    joint.command(0x80, *ENABLE, torque=500)
    assert joint.state == ENABLED
    assert joint.drive.torque_nm == pytest.approx(500 * NM)
