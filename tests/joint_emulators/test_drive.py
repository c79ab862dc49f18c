"""The drive's firmware behind its CANopen device: what it does with frames, and what it says about itself."""

import math
import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, Out
from canopen_exo.device import Device
from canopen_exo.eds import load_eds
from canopen_exo.od import ObjectDictionary
from canopen_exo.pdo import key_of
from joint_emulators.drive import Drive
from joint_emulators.sensors import ENCODER, VELOCITY, sample

NODE = 3
RATED_MNM = 72_900
NM = RATED_MNM * 1e-6
"""One per mille of the rated torque [N m]."""
CYCLE = 2 * MS
ENTRIES = load_eds()

ENABLE = (0x06, 0x07, 0x0F)
DISABLED, READY, SWITCHED_ON, ENABLED, FAULT = 0x40, 0x21, 0x23, 0x27, 0x08
"""State coding of CiA 402-2, statusword bits 0-3, 5, 6."""

SYNC_LOST, RPDO_LATE, HEARTBEAT_LOST = 0x8700, 0x8250, 0x8130


class Sink(Out):
    def __init__(self) -> None:
        self.sent: list[Frame] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append(frame)


class Joint:
    """A drive on the bus, Operational, with a SYNC every 2 ms when asked for; sensors are fed by hand."""

    def __init__(self, *, operational: bool = True) -> None:
        unit = {key_of(0x6076, 0): RATED_MNM, key_of(0x608F, 1): 131_072}
        od = ObjectDictionary(ENTRIES).copy_for_node(NODE, unit)
        self.drive = Drive(od, ENCODER, VELOCITY)
        self.device = Device(od, NODE, self.drive)
        self.sink = Sink()
        self.now = 0
        self.counter = 0
        self.pass_time(10 * MS)
        if operational:
            self.nmt(0x01)

    def pass_time(self, duration: int) -> None:
        """Let timers run up to and including `duration` ns from now."""
        self.now += duration
        while self.device.wake_at <= self.now:
            self.device.wake(self.device.wake_at, self.sink)

    def hear(self, can_id: int, data: bytes) -> list[Frame]:
        """Give it a frame; what it answers."""
        before = len(self.sink.sent)
        self.device.receive(self.now, 0, Frame(can_id, data), self.sink)
        return self.sink.sent[before:]

    def nmt(self, command: int) -> None:
        self.hear(0x000, bytes((command, NODE)))

    def answer(self, request: bytes) -> Frame:
        """The one answer to an SDO request."""
        (answer,) = [frame for frame in self.hear(0x600 + NODE, request) if frame.can_id == 0x580 + NODE]
        return answer

    def write(self, index: int, raw: int, size: int, sub: int = 0) -> int:
        """Expedited SDO download; the abort code, 0 when it was done."""
        head = bytes((0x23 | (4 - size) << 2,)) + struct.pack("<HB", index, sub)
        data = head + (raw % (1 << 8 * size)).to_bytes(size, "little")
        answer = self.answer(data.ljust(8, b"\x00"))
        return int.from_bytes(answer.data[4:], "little") if answer.data[0] == 0x80 else 0

    def read(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        """Expedited SDO upload."""
        answer = self.answer(struct.pack("<BHBI", 0x40, index, sub, 0))
        assert answer.data[0] & 0xE3 == 0x43, answer
        return int.from_bytes(answer.data[4 : 8 - (answer.data[0] >> 2 & 3)], "little", signed=signed)

    def rpdo(self, controlword: int, torque: int = 0) -> None:
        """RPDO1; it acts with the next SYNC."""
        self.hear(0x200 + NODE, struct.pack("<Hh", controlword, torque))

    def sync(self) -> list[Frame]:
        """A cycle later, the next SYNC; what it sends."""
        self.pass_time(CYCLE)
        self.counter = self.counter % 240 + 1
        return self.hear(0x080, bytes((self.counter,)))

    def command(self, *controlwords: int, torque: int = 0) -> None:
        """Controlwords with a target torque, one a cycle."""
        for controlword in controlwords:
            self.rpdo(controlword, torque)
            self.sync()

    @property
    def state(self) -> int:
        """Statusword bits of the state (CiA 402-2, state coding): mask 0x4F, or 0x6F where bit 5 counts."""
        word = self.read(0x6041)
        return word & 0x4F if word & 0x4F in (0x00, 0x40, 0x0F, 0x08) else word & 0x6F

    @property
    def limited(self) -> bool:
        """Statusword bit 11, internal limit active."""
        return bool(self.read(0x6041) & 1 << 11)


@pytest.fixture
def joint() -> Joint:
    return Joint()


@pytest.fixture
def enabled() -> Joint:
    """In Operation enabled, with a torque of 500 per mille."""
    joint = Joint()
    joint.command(*ENABLE, torque=500)
    assert joint.drive.torque_nm == pytest.approx(500 * NM)
    return joint


# ---- torque and state ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("controlwords", "state"),
    [
        ((), DISABLED),
        ((0x00,), DISABLED),
        ((0x06,), READY),
        ((0x06, 0x07), SWITCHED_ON),
        ((0x06, 0x07, 0x0F), ENABLED),
        ((0x06, 0x0F), ENABLED),  # one step: real masters do it
        ((0x07,), DISABLED),
        ((0x0F,), DISABLED),
        ((0x06, 0x07, 0x0F, 0x07), SWITCHED_ON),
        ((0x06, 0x07, 0x0F, 0x06), READY),
        ((0x06, 0x07, 0x0F, 0x00), DISABLED),
    ],
)
def test_torque_flows_in_operation_enabled_only(joint: Joint, controlwords: tuple[int, ...], state: int) -> None:
    """CiA 402-2: drive function enabled in Operation enabled; in every other state the motor has no torque."""
    joint.command(*controlwords, torque=500)
    assert joint.state == state
    assert joint.drive.torque_nm == pytest.approx(500 * NM if state == ENABLED else 0.0)


def test_command_acts_with_the_next_sync_not_before(joint: Joint) -> None:
    """Transmission type 1: values received since the last SYNC are applied at the next one; of two, the last."""
    joint.command(*ENABLE, torque=100)
    joint.rpdo(0x0F, 200)
    joint.rpdo(0x0F, -300)
    assert joint.drive.torque_nm == pytest.approx(100 * NM)
    joint.sync()
    assert joint.drive.torque_nm == pytest.approx(-300 * NM)


def test_torque_is_held_without_new_commands(enabled: Joint) -> None:
    """A SYNC without an RPDO before it changes nothing."""
    for _ in range(3):
        enabled.sync()
    assert enabled.drive.torque_nm == pytest.approx(500 * NM)


def test_torque_comes_back_only_with_a_new_enabling_sequence(enabled: Joint) -> None:
    """Switch on disabled is left by Shutdown only (transition 2): 0x0F alone brings no torque."""
    enabled.command(0x00, 0x0F, torque=500)
    assert (enabled.state, enabled.drive.torque_nm) == (DISABLED, 0.0)
    enabled.command(*ENABLE, torque=500)
    assert enabled.drive.torque_nm == pytest.approx(500 * NM)


@pytest.mark.parametrize("controlword", [0x02, 0x0B, 0x03])
def test_quick_stop_disables_at_once(enabled: Joint, controlword: int) -> None:
    """605A = 0: a quick stop disables the drive function (transitions 11 and 12 in one)."""
    enabled.command(controlword, torque=500)
    assert (enabled.state, enabled.drive.torque_nm) == (DISABLED, 0.0)
    enabled.command(0x0F, torque=500)
    assert (enabled.state, enabled.drive.torque_nm) == (DISABLED, 0.0)


def test_back_to_back_controlwords_enable_an_asynchronous_rpdo(joint: Joint) -> None:
    """RPDO type 255 applies at once: masters that send on change may send 0x06 and 0x0F without a SYNC between."""
    assert joint.write(0x1400, 255, 1, sub=2) == 0
    for controlword in (0x06, 0x0F):
        joint.rpdo(controlword, 250)
    assert joint.state == ENABLED
    assert joint.drive.torque_nm == pytest.approx(250 * NM)


@pytest.mark.parametrize("operational", [True, False])
def test_controlword_by_sdo_acts_like_one_by_pdo(operational: bool) -> None:
    """CiA 402-2: the state machine follows 0x6040 however it is written, in any NMT state with SDO."""
    joint = Joint(operational=operational)
    assert joint.write(0x6071, 400, 2) == 0
    for controlword, state in zip(ENABLE, (READY, SWITCHED_ON, ENABLED), strict=True):
        assert joint.write(0x6040, controlword, 2) == 0
        assert joint.state == state
    assert joint.drive.torque_nm == pytest.approx(400 * NM)
    joint.write(0x6071, -100, 2)
    assert joint.drive.torque_nm == pytest.approx(-100 * NM)
    joint.write(0x6040, 0x00, 2)
    assert (joint.state, joint.drive.torque_nm) == (DISABLED, 0.0)


# ---- modes --------------------------------------------------------------------------------------------------------


def test_mode_0_gives_no_torque(enabled: Joint) -> None:
    """0x6060 = 0: no mode. Operation enabled goes on, the torque does not; 0x6061 shows it."""
    assert enabled.read(0x6061) == 10
    assert enabled.write(0x6060, 0, 1) == 0
    assert (enabled.state, enabled.read(0x6061), enabled.drive.torque_nm) == (ENABLED, 0, 0.0)
    enabled.command(0x0F, torque=700)
    assert enabled.drive.torque_nm == 0.0
    assert enabled.write(0x6060, 10, 1) == 0
    assert enabled.drive.torque_nm == pytest.approx(700 * NM)


@pytest.mark.parametrize(
    ("mode", "abort"),
    [(-1, 0x06090032), *[(mode, 0x06090030) for mode in range(1, 10)], (11, 0x06090031), (127, 0x06090031)],
)
def test_modes_that_are_not_there_are_refused(enabled: Joint, mode: int, abort: int) -> None:
    """CiA 301, 7.2.4.3.17: value range exceeded, too high, too low. The mode stays."""
    assert enabled.write(0x6060, mode, 1) == abort
    assert (enabled.read(0x6060), enabled.read(0x6061)) == (10, 10)
    assert enabled.drive.torque_nm == pytest.approx(500 * NM)


def test_mode_by_pdo_acts_without_a_new_controlword(enabled: Joint) -> None:
    """0x6060 may be mapped (rww): a mode that comes by RPDO acts like one by SDO, at its SYNC."""
    enabled.nmt(0x80)
    enabled.write(0x1600, 0, 1)
    enabled.write(0x1600, 0x60600008, 4, sub=3)
    assert enabled.write(0x1600, 3, 1) == 0
    enabled.nmt(0x01)
    for controlword, mode, expected in [(0x06, 10, 0.0), (0x0F, 10, 300 * NM), (0x0F, 0, 0.0), (0x0F, 10, 300 * NM)]:
        enabled.hear(0x200 + NODE, struct.pack("<Hhb", controlword, 300, mode))
        enabled.sync()
        assert enabled.drive.torque_nm == pytest.approx(expected)
        assert enabled.read(0x6061) == mode


# ---- torque limit -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [0, 1, 300, 1390, 32767, 32768, 65535])
def test_torque_is_clamped_at_the_limit_and_says_so(joint: Joint, limit: int) -> None:
    """CiA 402-2: 0x6072 bounds the torque both ways; statusword bit 11 tells when it acts; 0x6074 is the demand."""
    assert joint.write(0x6072, limit, 2) == 0
    joint.command(*ENABLE)
    for target in (limit - 1, limit, limit + 1, -limit + 1, -limit, -limit - 1, 0, 32767, -32768):
        if not -32768 <= target <= 32767:
            continue
        joint.command(0x0F, torque=target)
        clamped = max(-limit, min(limit, target))
        assert joint.drive.torque_nm == pytest.approx(clamped * NM)
        assert joint.limited == (clamped != target)
        assert joint.read(0x6074, signed=True) == clamped


def test_default_limit_lies_above_the_rated_torque(joint: Joint) -> None:
    """The EDS's 0x6072 = 1390 per mille: the paper's table (100 %) can be exceeded in the plant, and seen."""
    joint.command(*ENABLE, torque=1390)
    assert joint.drive.torque_nm == pytest.approx(1390 * NM)
    assert joint.limited is False
    joint.command(0x0F, torque=1391)
    assert joint.drive.torque_nm == pytest.approx(1390 * NM)
    assert joint.limited is True


def test_limit_by_sdo_acts_at_once(enabled: Joint) -> None:
    """Written while torque flows, without a new command."""
    enabled.write(0x6072, 200, 2)
    assert enabled.drive.torque_nm == pytest.approx(200 * NM)
    assert enabled.limited is True
    enabled.write(0x6072, 500, 2)
    assert enabled.drive.torque_nm == pytest.approx(500 * NM)
    assert enabled.limited is False


def test_limit_bit_is_off_where_no_torque_flows(joint: Joint) -> None:
    """Bit 11 tells of a limit that acts: not while disabled, and not after disabling."""
    joint.write(0x6072, 100, 2)
    shown = []
    for controlword in (0x06, 0x07, 0x0F, 0x07):
        joint.command(controlword, torque=500)
        shown.append(joint.limited)
    assert shown == [False, False, True, False]


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


# ---- actual values ------------------------------------------------------------------------------------------------


def counts(q: float) -> int:
    """17 bits a turn, nearest count."""
    return math.floor(q / (2 * math.pi) * 131_072 + 0.5)


def tpdo1(frames: list[Frame]) -> tuple[int, int]:
    (frame,) = [frame for frame in frames if frame.can_id == 0x180 + NODE]
    position, velocity = struct.unpack("<ii", frame.data)
    return position, velocity


def test_actual_values_change_at_sync_only(joint: Joint) -> None:
    """SYNC latches the sensors: between two SYNCs, 0x6064, 0x606C and 0x6077 show the last latched sample."""
    sample([joint.drive.sensor], [0.0], [0.0])
    joint.sync()
    sample([joint.drive.sensor], [0.25], [36.45])
    assert [joint.read(index, signed=True) for index in (0x6064, 0x606C, 0x6077)] == [0, 0, 0]
    position, velocity = tpdo1(joint.sync())
    assert position == counts(0.25)
    assert velocity > 0
    sample([joint.drive.sensor], [0.5], [-36.45])
    assert [joint.read(index, signed=True) for index in (0x6064, 0x606C, 0x6077)] == [position, velocity, 500]


def test_tpdo_carries_the_sample_latched_by_its_own_sync(joint: Joint) -> None:
    """One cycle from sample to actuation needs the newest sample in the answer to this SYNC."""
    for q in (0.1, -0.2, 0.3):
        sample([joint.drive.sensor], [q], [0.0])
        assert tpdo1(joint.sync())[0] == counts(q)


@given(q=st.floats(-1000.0, 1000.0))
def test_position_is_the_nearest_count(q: float) -> None:
    """0x6064 in counts: half a count of 48 microradians is the largest error (1e-9 for the rounding of q itself)."""
    joint = Joint()
    sample([joint.drive.sensor], [q], [0.0])
    joint.sync()
    step = 2 * math.pi / 131_072
    assert abs(joint.read(0x6064, signed=True) * step - q) <= step / 2 + 1e-9


@pytest.mark.parametrize(("q", "raw"), [(1e6, 2**31 - 1), (-1e6, -(2**31))])
def test_position_does_not_wrap(joint: Joint, q: float, raw: int) -> None:
    """16384 turns fill int32; beyond, 0x6064 stays at its end."""
    sample([joint.drive.sensor], [q], [0.0])
    assert tpdo1(joint.sync())[0] == raw


@pytest.mark.parametrize("speed", [2.0, -2.0, 0.01])
def test_velocity_is_in_counts_per_second(joint: Joint, speed: float) -> None:
    """0x606C: after many time constants (1.6 ms) of steady turning, true but for one count of jitter in a sample."""
    for k in range(200):
        sample([joint.drive.sensor], [speed * k * 1e-3], [0.0])
    _, velocity = tpdo1(joint.sync())
    assert velocity == pytest.approx(speed / (2 * math.pi) * 131_072, abs=1000)  # one count in 1 ms = 1000 counts/s


@pytest.mark.parametrize(
    ("tau", "raw"),
    [
        (0.0, 0),
        (72.9, 1000),
        (-72.9, -1000),
        (0.49 * NM, 0),
        (0.51 * NM, 1),
        (-0.49 * NM, 0),
        (-0.51 * NM, -1),
        (32766.6 * NM, 32767),
        (40_000 * NM, 32767),
        (-32767.6 * NM, -32768),
        (-40_000 * NM, -32768),
    ],
)
def test_torque_actual_is_per_mille_of_rated(joint: Joint, tau: float, raw: int) -> None:
    """0x6077 in per mille of 0x6076, nearest, saturated at int16."""
    sample([joint.drive.sensor], [0.0], [tau])
    joint.sync()
    assert joint.read(0x6077, signed=True) == raw


def test_torque_actual_is_the_plants_not_the_demand(enabled: Joint) -> None:
    """0x6077 is what the joint has; 0x6074 what was asked."""
    sample([enabled.drive.sensor], [0.0], [0.0])
    enabled.sync()
    assert enabled.read(0x6077, signed=True) == 0
    assert enabled.read(0x6074, signed=True) == 500


@pytest.mark.parametrize("every", [1, 10])
def test_tpdo2_carries_statusword_torque_and_error_code(every: int) -> None:
    """TPDO2: statusword u16, torque actual i16, error code u16, on every n-th SYNC."""
    joint = Joint(operational=False)
    for index, sub, raw, size in [(0x1801, 1, 1 << 31 | 0x280 + NODE, 4), (0x1801, 2, every, 1), (0x1801, 6, NODE, 1)]:
        assert joint.write(index, raw, size, sub=sub) == 0
    assert joint.write(0x1801, 0x280 + NODE, 4, sub=1) == 0
    joint.nmt(0x01)
    sample([joint.drive.sensor], [0.0], [-7.29])
    heard = []
    for _ in range(40):
        joint.rpdo(0x06, 0)
        for frame in joint.sync():
            if frame.can_id == 0x280 + NODE:
                heard.append((joint.counter, struct.unpack("<HhH", frame.data)))
    assert [counter for counter, _ in heard] == list(range(NODE, 41, every))
    assert heard[-1][1] == (0x0231, -100, 0)  # remote, voltage enabled, Ready to switch on; 10 % of rated


# ---- any input ----------------------------------------------------------------------------------------------------


@given(
    words=st.lists(
        st.tuples(
            st.sampled_from(["rpdo", "mode", "limit", "sync"]), st.integers(0, 0xFFFF), st.integers(-32768, 32767)
        ),
        max_size=30,
    )
)
def test_torque_stays_within_the_limit_and_off_outside_operation_enabled(
    words: list[tuple[str, int, int]],
) -> None:
    """For every sequence of commands: |torque| <= 0x6072 in Operation enabled and CST, else none."""
    joint = Joint()
    joint.command(*ENABLE)
    for what, word, torque in words:
        if what == "rpdo":
            joint.rpdo(word, torque)
        elif what == "mode":
            joint.write(0x6060, word % 12, 1)
        elif what == "limit":
            joint.write(0x6072, word, 2)
        joint.sync()
        target, limit = joint.read(0x6071, signed=True), joint.read(0x6072)
        driving = joint.state == ENABLED and joint.read(0x6061) == 10
        expected = max(-limit, min(limit, target)) if driving else 0
        assert joint.drive.torque_nm == pytest.approx(expected * NM)
        assert joint.limited == (driving and expected != target)


def test_nothing_is_due_for_a_silent_drive_without_timers() -> None:
    """`wake_at`: with heartbeat off and nothing watched the drive asks for no call."""
    joint = Joint()
    joint.write(0x1017, 0, 2)
    assert joint.device.wake_at == NEVER
