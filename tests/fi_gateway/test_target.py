"""A target in a file means definite frames and bits on the bus, or is refused with what would be right."""

import math

import pytest
from cantools.database import load_string
from cantools.database.can import Database

from canopen_exo.dbc import dbc_text
from canopen_exo.plan import POSITION, TORQUE, BusPlan, JointNode, Pdo
from fi_gateway.boundary import SpecError, validate
from fi_gateway.marked_yaml import Keys, parse
from fi_gateway.target import Place, TargetSpec, resolve

PLAN = BusPlan(
    tuple(
        JointNode(name, number, 50_000, 131_072)
        for number, name in enumerate(
            ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle"), 1
        )
    )
)


def place(text: str, plan: BusPlan = PLAN) -> Place:
    """The place a target in flow style means."""
    document = parse("{" + text + "}", "t.yaml")
    spec = validate(TargetSpec, document.data, (), document)
    document.raise_problems()
    assert spec is not None
    return resolve(spec, plan)


@pytest.mark.parametrize(
    ("text", "cob_id", "start", "length"),
    [
        ("bus: to_controller, node: right_knee, signal: position", 0x185, 0, 32),
        ("bus: to_controller, node: right_knee, signal: velocity", 0x185, 32, 32),
        ("bus: both, node: right_knee, signal: velocity", 0x185, 32, 32),
        ("bus: to_controller, node: left_hip, signal: torque", 0x281, 16, 16),
        ("bus: to_drives, node: right_ankle, signal: target_torque", 0x206, 16, 16),
        ("bus: to_drives, node: right_ankle, pdo: RPDO1, signal: controlword", 0x206, 0, 16),
        ("bus: to_controller, node: right_knee, signal: 0x6064", 0x185, 0, 32),
        ("bus: to_controller, node: right_knee, signal: '0x606c'", 0x185, 32, 32),
        ("bus: to_controller, signal: right_knee_TPDO1.position", 0x185, 0, 32),
        ("bus: to_controller, cob_id: 0x185, signal: velocity", 0x185, 32, 32),
    ],
)
def test_a_signal_is_found_by_name_object_or_message(text: str, cob_id: int, start: int, length: int) -> None:
    """`signal`: object 0x6064, name `position`, or DBC `Message.Signal`."""
    found = place(text)
    assert found.signal is not None
    assert (found.cob_ids, found.signal.cob_id) == ((cob_id,), cob_id)
    assert (found.signal.start, found.signal.length) == (start, length)


@pytest.mark.parametrize(
    ("text", "cob_ids", "size"),
    [
        ("bus: to_controller, node: right_knee, pdo: TPDO1", (0x185,), 8),
        ("bus: to_controller, node: left_knee, pdo: TPDO2", (0x282,), 6),
        ("bus: to_drives, node: left_hip, pdo: RPDO1", (0x201,), 4),
        ("bus: to_controller, pdo: TPDO1", (0x181, 0x182, 0x183, 0x184, 0x185, 0x186), 8),
        ("bus: to_controller, cob_id: 0x185", (0x185,), 8),
        ("bus: to_controller, cob_id: '0x185'", (0x185,), 8),
        ("bus: to_controller, cob_id: 389", (0x185,), 8),
        ("bus: to_drives, cob_id: 0x80", (0x80,), 1),
        ("bus: to_drives, cob_id: 0", (0,), 2),
        ("bus: to_drives, cob_id: 0x2FF", (0x2FF,), 5),
        ("bus: to_drives, cob_id: 0x77F", (0x77F,), 1),
        ("bus: to_controller, cob_id: 0x705", (0x705,), 1),
        ("bus: to_controller, cob_id: 0x85", (0x85,), 8),
        ("bus: to_controller, cob_id: 0x585", (0x585,), 8),
        ("bus: to_drives, cob_id: 0x605", (0x605,), 8),
        ("bus: both, cob_id: 0x7FF", (0x7FF,), -1),
        ("bus: to_drives, kind: sdo_request, node: right_knee", (0x605,), 8),
        ("bus: to_controller, kind: sdo_answer, node: left_hip", (0x581,), 8),
        ("bus: to_controller, kind: emcy", (0x81, 0x82, 0x83, 0x84, 0x85, 0x86), 8),
        ("bus: to_controller, kind: heartbeat, node: right_ankle", (0x706,), 1),
        ("bus: to_drives, kind: heartbeat, node: controller", (0x77F,), 1),
        ("bus: to_drives, kind: sync", (0x80,), 1),
        ("bus: to_drives, kind: nmt", (0,), 2),
        ("bus: to_controller, cob_id: 0x184/0x7FE", (0x184, 0x185), 8),
        ("bus: both, cob_id: 0x705/0x7FF", (0x705,), 1),
        ("bus: to_controller, cob_id: 0x100/0x5FF", (0x100, 0x300), -1),
    ],
)
def test_without_a_signal_the_target_is_the_whole_frame(text: str, cob_ids: tuple[int, ...], size: int) -> None:
    """Frames by PDO or COB-ID, with the size that the plan gives them."""
    found = place(text)
    assert (found.cob_ids, found.size, found.signal) == (cob_ids, size, None)
    assert found.known == (size >= 0)


def test_a_mask_means_every_id_it_leaves() -> None:
    """0x180/0x780: id & 0x780 == 0x180; the rig's TPDO1 are among them."""
    found = place("bus: to_controller, cob_id: 0x180/0x780")
    assert (found.cob_ids, found.size, found.known) == (tuple(range(0x180, 0x200)), -1, True)
    assert (found.name, found.words) == ("frames 0x180/0x780", "frames (0x180/0x780, to_controller)")
    assert not place("bus: both, cob_id: 0x100/0x7F8").known


@pytest.mark.parametrize(
    ("bits", "low", "high", "name"),
    [
        ("{start: 0, length: 1}", 0, 1, "right_knee.TPDO1.bit 0"),
        ("{start: 60, length: 4}", 0, 15, "right_knee.TPDO1.bits 60..63"),
        ("{start: 3, length: 12, signed: true}", -2048, 2047, "right_knee.TPDO1.bits 3..14"),
    ],
)
def test_bits_are_a_raw_range(bits: str, low: int, high: int, name: str) -> None:
    """`bits: {start, length, signed}`: a plain number without unit, wherever it lies."""
    found = place(f"bus: to_controller, cob_id: 0x185, bits: {bits}")
    assert found.signal is not None
    assert (found.signal.cob_id, found.signal.low, found.signal.high, found.signal.unit) == (0x185, low, high, "")
    assert found.name == f"{found.signal.node}.{found.signal.name}" == name


DATABASE = load_string(dbc_text(PLAN), "dbc")
assert isinstance(DATABASE, Database)


@pytest.mark.parametrize(
    ("message", "signal"), [(message.name, one.name) for message in DATABASE.messages for one in message.signals]
)
def test_every_signal_of_the_dbc_is_a_target(message: str, signal: str) -> None:
    """`Message.Signal` means the same here and in the exported DBC: frame, bits, sign, scale."""
    assert isinstance(DATABASE, Database)
    expected = DATABASE.get_message_by_name(message)
    one = expected.get_signal_by_name(signal)
    found = place(f"bus: both, signal: {message}.{signal}").signal
    assert found is not None
    assert (found.cob_id, found.start, found.length) == (expected.frame_id, one.start, one.length)
    assert (found.signed, found.scale) == (one.is_signed, one.scale)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("bus: to_controller, node: right_knee, pdo: TPDO1", "right_knee.TPDO1"),
        ("bus: to_controller, cob_id: 0x185", "right_knee.TPDO1"),
        ("bus: to_drives, node: left_hip, pdo: RPDO1", "left_hip.RPDO1"),
        ("bus: to_controller, node: right_knee, signal: position", "right_knee.position"),
        ("bus: to_controller, pdo: TPDO1", "TPDO1 0x181..0x186"),
        ("bus: to_controller, cob_id: 0x705", "right_knee.heartbeat"),
        ("bus: to_controller, cob_id: 0x85", "right_knee.EMCY"),
        ("bus: to_drives, cob_id: 0x605", "right_knee.SDO request"),
        ("bus: to_drives, cob_id: 0x80", "SYNC 0x080"),
        ("bus: to_drives, cob_id: 0", "NMT 0x000"),
        ("bus: to_drives, cob_id: 0x2FF", "HLC status 0x2FF"),
        ("bus: to_drives, cob_id: 0x77F", "controller.heartbeat"),
        ("bus: both, cob_id: 0x7FF", "frames 0x7FF"),
    ],
)
def test_every_target_has_a_name_for_records(text: str, name: str) -> None:
    """Owner and what it sends; frames of nobody or of many with their COB-IDs."""
    assert place(text).name == name


@pytest.mark.parametrize(("bus", "directions"), [("to_controller", (True, False)), ("both", (True, True))])
def test_the_bus_is_a_direction_of_travel(bus: str, directions: tuple[bool, bool]) -> None:
    """`bus: to_controller | to_drives | both`."""
    found = place(f"bus: {bus}, cob_id: 0x185")
    assert (found.to_controller, found.to_drives) == directions


@pytest.mark.parametrize(
    ("text", "keys", "words"),
    [
        ("bus: to_drives, node: right_knee, signal: position", ("bus",),
         ["position of right_knee does not travel to_drives", "write bus: to_controller"]),
        ("bus: to_controller, node: right_knee, pdo: RPDO1", ("bus",), ["write bus: to_drives"]),
        ("bus: to_controller, cob_id: 0x205", ("bus",), ["RPDO1 of right_knee", "write bus: to_drives"]),
        ("bus: to_controller, cob_id: 0x80", ("bus",), ["SYNC", "write bus: to_drives"]),
        ("bus: to_drives, cob_id: 0x705", ("bus",), ["heartbeat of right_knee", "write bus: to_controller"]),
        ("bus: both, node: right_kne, signal: position", ("node",), ["did you mean 'right_knee'?", "left_hip"]),
        ("bus: both, node: knee, pdo: TPDO1", ("node",), ["unknown joint 'knee'", "right_ankle"]),
        ("bus: both, node: right_knee, pdo: TPDO9", ("pdo",), ["did you mean 'TPDO", "RPDO1, TPDO1, TPDO2"]),
        ("bus: both, node: right_knee, signal: positon", ("signal",), ["did you mean 'position'?", "velocity"]),
        ("bus: both, node: right_knee, pdo: TPDO1, signal: torque", ("signal",), ["(allowed: position, velocity)"]),
        ("bus: both, signal: position", ("signal",), ["position of which joint?", "left_hip | left_knee"]),
        ("bus: both, cob_id: 0x7FF, signal: position", ("cob_id",), ["no signals are mapped into COB-ID 0x7FF"]),
        ("bus: both, cob_id: 0x705, signal: position", ("signal",), ["unknown signal 'position' (allowed: nmt_state)"]),
        ("bus: both, kind: sync, signal: nmt_state", ("signal",), ["(allowed: sync_counter)"]),
        ("bus: both, kind: heartbeat, signal: nmt_state", ("signal",), ["nmt_state of which joint?", "left_hip"]),
        ("bus: both, kind: sync, node: left_hip", ("node",), ["kind: sync is the controller's alone"]),
        ("bus: both, kind: emcy, node: controller", ("node",), ["unknown joint 'controller'"]),
        ("bus: to_drives, kind: emcy", ("bus",), ["EMCY of every joint does not travel to_drives"]),
        ("bus: to_controller, kind: sdo_request", ("bus",), ["write bus: to_drives"]),
        ("bus: both, kind: emcy, pdo: TPDO1", ("pdo",), ["either kind or pdo"]),
        ("bus: both, cob_id: 0x185, kind: emcy", ("kind",), ["either cob_id or kind"]),
        ("bus: to_drives, cob_id: 0x180/0x780", ("bus",), ["frames does not travel to_drives"]),
        ("bus: both, kind: emcy, bits: {start: 0, length: 8}", ("bits",), ["one COB-ID", "EMCY 0x081..0x086 has 6"]),
        ("bus: both, cob_id: 0x705, bits: {start: 4, length: 5}", ("bits",), ["there is no bit 8", "bits 0..7"]),
        ("bus: both, cob_id: 0x7FF, bits: {start: 60, length: 5}", ("bits",), ["there is no bit 64"]),
        ("bus: both, cob_id: 0x185, signal: position, bits: {start: 0, length: 8}", ("bits",), ["either signal or"]),
        ("bus: both, cob_id: 0x185, node: right_knee", ("node",), ["either cob_id or node"]),
        ("bus: both, cob_id: 0x185, pdo: TPDO1", ("pdo",), ["either cob_id or pdo"]),
        ("bus: both, node: right_knee", (), ["which frames?", "signal", "pdo", "cob_id"]),
        ("bus: both", (), ["which frames?"]),
    ],
)  # fmt: skip
def test_a_target_that_is_none_or_many_is_refused(text: str, keys: Keys, words: list[str]) -> None:
    """Unknown, ambiguous, or not travelling that way: the message names what is right."""
    with pytest.raises(SpecError) as caught:
        place(text)
    assert caught.value.keys == keys
    assert all(word in str(caught.value) for word in words)


def test_a_signal_in_two_pdos_needs_the_pdo() -> None:
    """Ambiguous is refused; with `pdo` it is definite."""
    pdos = (Pdo("TPDO1", 0x180, 1, (POSITION,)), Pdo("TPDO2", 0x280, 1, (TORQUE, POSITION)))
    plan = BusPlan(PLAN.joints, pdos=pdos)
    with pytest.raises(SpecError, match=r"several PDOs of right_knee; add pdo: TPDO1 \| TPDO2"):
        place("bus: both, node: right_knee, signal: position", plan)
    found = place("bus: both, node: right_knee, pdo: TPDO2, signal: position", plan)
    assert found.signal is not None
    assert (found.cob_ids, found.signal.start) == ((0x285,), 16)


def test_the_signal_carries_the_plans_scale() -> None:
    """131072 counts a revolution."""
    found = place("bus: both, node: right_knee, signal: position")
    assert found.signal is not None
    assert found.signal.to_raw(math.tau) == 131_072
