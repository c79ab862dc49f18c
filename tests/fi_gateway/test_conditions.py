"""Conditions: read with their places, resolved against the rig, evaluated on raw integers."""

import copy
import pickle
import re
import struct
from contextlib import suppress
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from canopen_exo.plan import PDOS, BusPlan, JointNode, Pdo
from fi_gateway.boundary import SpecError, validate
from fi_gateway.condition_specs import parse_condition, resolve_condition
from fi_gateway.conditions import Condition
from fi_gateway.errors import FaultError
from fi_gateway.event_specs import WhenSpec
from fi_gateway.events import FROM_CONTROLLER, FROM_DRIVES
from fi_gateway.marked_yaml import parse

NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))
KNEE: Final = 0x185


def samples(position: int, velocity: int = 0, cob_id: int = KNEE) -> Frame:
    """TPDO1, counts and counts/s."""
    return Frame(cob_id, struct.pack("<ii", position, velocity))


def status(word: int, torque: int = 0) -> Frame:
    """TPDO2 of the right knee: statusword, torque [per mille], error code."""
    return Frame(0x285, struct.pack("<HhH", word, torque, 0))


def condition(text: str) -> Condition:
    return resolve_condition(text, PLAN).condition


QUARTER: Final = 32768  # counts of 90 deg


@pytest.mark.parametrize(
    ("text", "holding", "other"),
    [
        ("right_knee.position < 90 deg", QUARTER - 1, QUARTER),
        ("right_knee.position <= 90 deg", QUARTER, QUARTER + 1),
        ("right_knee.position > 90 deg", QUARTER + 1, QUARTER),
        ("right_knee.position >= 90 deg", QUARTER, QUARTER - 1),
        ("right_knee.position < -90 deg", -QUARTER - 1, -QUARTER),
        ("right_knee.position >= -90 deg", -QUARTER, -QUARTER - 1),
        ("right_knee.position < 1 deg", 364, 365),  # 364.09 counts
        ("right_knee.position <= 1 deg", 364, 365),
        ("right_knee.position > 1 deg", 365, 364),
        ("right_knee.position >= 1 deg", 365, 364),
        ("right_knee.position > -1 deg", -364, -365),
        ("right_knee.position >= -1deg", -364, -365),
        ("right_knee.position < 10 counts", 9, 10),
        ("right_knee.position == -10 counts", -10, -9),
        ("right_knee.position != 10 counts", 11, 10),
        ("right_knee.0x6064 < 10 counts", 9, 10),
        ("right_knee_TPDO1.position<10 counts", 9, 10),
        ("(right_knee.position < 10 counts)", 9, 10),
    ],
)
def test_a_comparison_holds_up_to_its_limit_exactly(text: str, holding: int, other: int) -> None:
    """Dense at the boundary: the raw integers on both sides of a limit in units."""
    one = condition(text)
    assert one.observe(samples(holding))
    assert not one.observe(samples(other))


@pytest.mark.parametrize(
    ("text", "frame", "holds"),
    [
        ("right_knee.velocity > 60 rpm", samples(0, 131073), True),
        ("right_knee.velocity > 60 rpm", samples(0, 131072), False),
        ("right_knee.velocity <= 131072 counts/s", samples(0, 131072), True),
        ("right_knee.torque >= 5.49 N m", status(0, 100), True),
        ("right_knee.torque >= 5.49 N m", status(0, 99), False),
        ("right_knee.statusword == 0x27", status(0x27), True),
        ("right_knee.statusword == 0x27", status(0x1237), False),
        ("right_knee.statusword & 0x6F == 0x27", status(0x1237), True),
        ("right_knee.statusword & 8 != 0", status(0x27), False),
        ("right_knee.statusword & 8 != 0", status(0x2F), True),
        ("right_knee.error_code > 0", status(0x27), False),
    ],
)
def test_units_masks_and_plain_numbers(text: str, frame: Frame, holds: bool) -> None:
    """Units of the signal; a signal without unit is a plain number, and bits of it can be picked."""
    assert condition(text).observe(frame) is holds


def test_and_binds_more_closely_than_or_and_brackets_more_than_both() -> None:
    """`a or b and c` is `a or (b and c)`."""
    a, b, c = (f"right_knee.statusword & {bit} == {bit}" for bit in (1, 2, 4))
    for word in range(8):
        has = [bool(word & bit) for bit in (1, 2, 4)]
        frame = status(word)
        assert condition(f"{a} or {b} and {c}").observe(frame) == (has[0] or (has[1] and has[2]))
        assert condition(f"({a} or {b}) and {c}").observe(frame) == ((has[0] or has[1]) and has[2])
        assert condition(f"{a} and {b} and {c}").observe(frame) == all(has)
        assert condition(f"{a} or {b} or {c}").observe(frame) == any(has)


def test_a_condition_over_several_frames_uses_the_last_value_of_each() -> None:
    """What no frame has brought yet does not hold, whatever the operator."""
    both = condition("right_knee.position < 0 rad and left_knee.position != 5 counts")
    assert both.watches == ((FROM_DRIVES, KNEE), (FROM_DRIVES, 0x182))
    assert not both.observe(samples(-1))
    assert both.observe(samples(4, cob_id=0x182))
    assert not both.observe(samples(0))
    assert both.observe(samples(-1))
    assert not both.observe(samples(5, cob_id=0x182))
    either = condition("right_knee.position < 0 rad or left_knee.position > 5 counts")
    assert either.observe(samples(-1))


def test_commands_are_watched_on_the_controllers_side() -> None:
    """RPDOs come in on the controller's port; a frame is watched once for all its signals."""
    one = condition("left_hip.target_torque > 5 N m and left_hip.controlword == 15 and left_hip.controlword != 7")
    assert one.watches == ((FROM_CONTROLLER, 0x201),)


@pytest.mark.parametrize(
    ("text", "port", "cob_id", "holding", "other"),
    [
        ("right_knee_EMCY.emcy_error_code != 0", FROM_DRIVES, 0x085, "3082010000000000", "0000010000000000"),
        ("right_knee.emcy_error_register & 1 == 1", FROM_DRIVES, 0x085, "3082010000000000", "3082800000000000"),
        ("left_hip_heartbeat.nmt_state != 5", FROM_DRIVES, 0x701, "7F", "05"),
        ("HLC_status.phase >= 25 %", FROM_CONTROLLER, 0x2FF, "0200000040", "020000FF3F"),
        ("HLC_status.phase < 0.25 stride", FROM_CONTROLLER, 0x2FF, "020000FF3F", "0200000040"),
        ("HLC_status.phase == 16384 counts", FROM_CONTROLLER, 0x2FF, "0200000040", "020000FF3F"),
        ("controller.state == 2", FROM_CONTROLLER, 0x2FF, "0200000000", "0100000000"),
        ("HLC_heartbeat.nmt_state == 5", FROM_CONTROLLER, 0x77F, "05", "7F"),
        ("NMT.nmt_command == 0x81", FROM_CONTROLLER, 0x000, "8100", "0100"),
        ("SYNC.sync_counter > 239", FROM_CONTROLLER, 0x080, "F0", "01"),
    ],
)
def test_every_message_of_the_dbc_can_be_in_a_condition(
    text: str, port: int, cob_id: int, holding: str, other: str
) -> None:
    """Conditions over decoded signals: those of the services too, on the side from which they come."""
    one = condition(text)
    assert one.watches == ((port, cob_id),)
    assert one.observe(Frame(cob_id, bytes.fromhex(holding)))
    assert not one.observe(Frame(cob_id, bytes.fromhex(other)))


def test_a_frame_too_short_for_a_signal_leaves_it_as_it_was() -> None:
    """Bad bytes are data."""
    one = condition("right_knee.position < 0 rad and right_knee.velocity < 0 rpm")
    assert one.observe(samples(-1, -1))
    assert one.observe(Frame(KNEE, bytes(3)))
    assert not one.observe(Frame(KNEE, bytes(4)))  # position 0; velocity is not in it


@given(st.lists(st.binary(max_size=8), max_size=30))
def test_a_copy_goes_on_alike(payloads: list[bytes]) -> None:
    """Snapshots; and no bytes make it raise."""
    one = condition("right_knee.position < 1 rad and (right_knee.velocity > 0 rpm or left_knee.position == 0 counts)")
    copied = one
    for data in payloads:
        copied = copy.deepcopy(pickle.loads(pickle.dumps(copied)))
        for cob_id in (KNEE, 0x182):
            assert copied.observe(Frame(cob_id, data)) == one.observe(Frame(cob_id, data))


@pytest.mark.parametrize(
    ("text", "can_hold"),
    [
        ("right_knee.torque > 1798.5 N m", True),  # i16 per mille of 54.9 N m
        ("right_knee.torque > 1799 N m", False),
        ("right_knee.torque < -1799 N m", False),
        ("right_knee.statusword < 0", False),
        ("right_knee.statusword >= 65535", True),
        ("right_knee.statusword > 65535", False),
        ("right_knee.statusword != 65536", True),
        ("right_knee.statusword & 8 == 4", False),
        ("right_knee.statusword & 0x6F == 0x27", True),
        ("right_knee.statusword & 8 > 8", False),
        ("right_knee.statusword < 0 or right_knee.position < 0 rad", True),
        ("right_knee.statusword < 0 and right_knee.position < 0 rad", False),
        ("right_knee.position < -60 deg and right_knee.position > 0 deg", False),
        ("right_knee.position < -60 deg and left_knee.position > 0 deg", True),
        ("right_knee.position <= 5 counts and right_knee.0x6064 >= 5 counts", True),
        ("right_knee.position < 5 counts and right_knee.position >= 5 counts", False),
        ("right_knee.position < 5 counts or right_knee.position > 9 counts", True),
        ("right_knee.position < 5 counts and (right_knee.position > 9 counts or right_knee.position < 3 counts)", True),
        ("right_knee.statusword & 8 == 8 and right_knee.statusword & 8 == 0", False),
        ("right_knee.statusword & 8 == 8 and right_knee.statusword & 4 == 0", True),
        ("right_knee.statusword == 8 and right_knee.statusword != 7", True),
    ],
)
def test_what_signals_cannot_carry_can_never_hold(text: str, can_hold: bool) -> None:
    """For warnings."""
    assert resolve_condition(text, PLAN).can_hold is can_hold


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a condition such as"),
        ("right_knee.position", "character 1: expected SIGNAL OPERATOR VALUE"),
        ("right_knee < 3 deg", "character 1: expected SIGNAL OPERATOR VALUE"),
        ("right_knee.position = 3 deg", "character 1: expected SIGNAL"),
        ("right_knee.position < 3 deg and", "character 32: expected SIGNAL OPERATOR VALUE", ),
        ("right_knee.position < 3 deg & right_hip.position > 1 deg", "character 1: expected SIGNAL"),
        ("(right_knee.position < 3 deg", "character 29: expected and, or, or a closing bracket; got the end"),
        ("right_knee.position < 3 deg)", "character 28: expected and, or, or the end; got ')'"),
        ("right_knee.position < and right_hip.position > 1 deg", "character 1: expected SIGNAL"),
        ("(" * 17 + "right_knee.position < 3 deg" + ")" * 17, "character 17: more than 16 brackets"),
        ("right_knee.position < 3 deg or " * 40, "1240 characters long; allowed up to 1000"),
    ],
)  # fmt: skip
def test_a_condition_that_cannot_be_read_says_where(text: str, message: str) -> None:
    """The character, what was expected, an example."""
    with pytest.raises(ValueError, match=re.escape(message)):
        parse_condition(text)


@pytest.mark.parametrize("given_", [None, True, 3, [], {}])
def test_only_text_is_a_condition(given_: object) -> None:
    """What the file holds is said in its own words."""
    with pytest.raises(ValueError, match="expected a condition such as"):
        parse_condition(given_)


@given(st.text(alphabet="right_knee.position<>=!&() and or -60deg0x", max_size=60))
def test_no_text_breaks_the_parser(text: str) -> None:
    """Either a condition or a ValueError, and a FaultError for what does not fit the rig."""
    with suppress(ValueError, FaultError):
        assert resolve_condition(text, PLAN).condition.watches


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("knee.position < 3 deg", "character 1: unknown joint or message 'knee'"),
        ("left_knee.position < 3 deg and rihgt_knee.position < 1 deg",
         "character 32: unknown joint or message 'rihgt_knee'; did you mean 'right_knee'? (this rig has left_hip, "
         "left_knee, left_ankle, right_hip, right_knee, right_ankle, controller, and the messages of the DBC, su"),
        ("right_knee_EMYC.emcy_error_code != 0", "'right_knee_EMYC'; did you mean 'right_knee_EMCY'?"),
        ("right_knee_SDO.index == 1", "unknown joint or message 'right_knee_SDO'"),
        ("HLC_status.0x0000 == 1", "no signal '0x0000' of HLC_status (allowed: state, cycle, phase; what is in SDOs"),
        ("HLC_status.phase > 0.25", "'0.25' has no unit; a gait phase needs one (units: stride, %"),
        ("HLC_status.phase == 25 %", "HLC_status.phase is a measured value and never exactly equal"),
        ("right_knee.positon < 3 deg",
         "no signal 'positon' of right_knee; did you mean 'position'? (allowed: controlword, target_torque"),
        ("right_knee.0x6078 < 3", "no signal '0x6078' of right_knee (allowed: controlword, target_torque"),
        ("right_knee.0xyz < 3", "'0xyz' is not an object such as 0x6064"),
        ("right_knee.position < 3", "'3' has no unit; an angle needs one"),
        ("right_knee.position < 3 rpm", "'3 rpm' is an angular velocity; an angle is wanted"),
        ("right_knee.position < 3 counts/s", "unknown unit 'counts/s'"),
        ("right_knee.position == 3 deg", "right_knee.position is a measured value and never exactly equal"),
        ("right_knee.position & 1 == 1 counts", "a mask is for signals without unit"),
        ("right_knee.statusword == 27 deg", "is a whole number without unit, such as 0x27; got '27 deg'"),
        ("right_knee.statusword > 1.5", "is a whole number without unit"),
    ],
)  # fmt: skip
def test_a_condition_that_does_not_fit_the_rig_is_refused(text: str, message: str) -> None:
    """What, where, got, allowed; the key for the place in the file."""
    with pytest.raises(SpecError, match=re.escape(message)) as caught:
        resolve_condition(text, PLAN)
    assert caught.value.keys == ("condition",)


def test_a_signal_in_two_pdos_must_be_named_with_its_pdo() -> None:
    """Which of them, the file says."""
    twice = BusPlan(
        (JointNode("knee", 1, 54_900, 131_072),), pdos=(*PDOS[:2], Pdo("TPDO2", 0x280, 10, PDOS[1].content))
    )
    with pytest.raises(SpecError, match=r"in several PDOs; write one of knee_TPDO1\.position, knee_TPDO2\.position"):
        resolve_condition("knee.position < 3 deg", twice)
    assert resolve_condition("knee_TPDO2.position < 3 deg", twice).condition.watches == ((FROM_DRIVES, 0x281),)


def test_a_condition_in_a_file_is_refused_at_its_place() -> None:
    """path:line:col."""
    document = parse("type: when\ncondition: right_knee.position < \n", "s.yaml")
    assert validate(WhenSpec, document.data, (), document) is None
    (problem,) = document.problems
    assert document.line(problem).startswith("s.yaml:2:12: condition: character 1: expected SIGNAL OPERATOR VALUE")
