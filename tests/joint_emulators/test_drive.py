"""The drive's firmware behind its CANopen device: what it does with frames, and what it says about itself."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from joint_emulators.sensors import sample
from tests.joint_emulators.drive_on_bus import (
    DISABLED,
    ENABLE,
    ENABLED,
    NM,
    NODE,
    READY,
    SWITCHED_ON,
    Joint,
    enabled_joint,
)


@pytest.fixture
def joint() -> Joint:
    return Joint()


@pytest.fixture
def enabled() -> Joint:
    return enabled_joint()


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
