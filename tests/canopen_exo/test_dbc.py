"""The DBC export, read back by cantools, against the plan and against bytes worked out by hand."""

import math
from collections.abc import Mapping
from importlib import resources

import pytest
from cantools.database import load_string
from cantools.database.can import Database
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.dbc import dbc_text
from canopen_exo.plan import BusPlan, JointNode
from testbench.scenario import default_joints

PLAN = BusPlan(default_joints())
SIGNALS = {f"{signal.message}.{signal.name}": signal for signal in PLAN.signals()}


def read(plan: BusPlan) -> Database:
    database = load_string(dbc_text(plan), "dbc")
    assert isinstance(database, Database)
    return database


DATABASE = read(PLAN)


def decode(message: int | str, data: bytes) -> Mapping[str, object]:
    decoded = DATABASE.decode_message(message, data)
    assert isinstance(decoded, dict)
    return decoded


def test_stored_file_is_that_of_the_default_plan() -> None:
    """Design: the DBC in dbc/ is generated from the plan, and kept equal by this test."""
    stored = resources.files("dbc").joinpath("exo.dbc").read_text(encoding="utf-8")
    assert stored == dbc_text(PLAN), (
        "dbc/exo.dbc is not the DBC of the default plan; write it again:\n"
        'python -c "from canopen_exo.dbc import dbc_text; from canopen_exo.plan import BusPlan; '
        "from testbench.scenario import default_joints; print(dbc_text(BusPlan(default_joints())), end='')\" "
        "> dbc/exo.dbc"
    )


@pytest.mark.parametrize("name", SIGNALS)
def test_signal_lies_where_the_plan_has_it(name: str) -> None:
    """One plan: position in the frame, sign, scale and unit are the same in DBC and Signal."""
    signal = SIGNALS[name]
    message = DATABASE.get_message_by_frame_id(signal.cob_id)
    found = message.get_signal_by_name(signal.name)
    assert message.name == signal.message
    assert (found.start, found.length, found.is_signed, found.byte_order) == (
        signal.start,
        signal.length,
        signal.signed,
        "little_endian",
    )
    assert found.scale == signal.scale  # to the last bit: the file holds the shortest exact decimal
    assert (found.unit or "") == signal.unit


@given(data=st.binary(min_size=8, max_size=8))
def test_any_payload_decodes_to_what_signal_reads(data: bytes) -> None:
    """cantools and Signal agree on every payload."""
    decoded = decode("right_knee_TPDO1", data)
    for name in ("position", "velocity"):
        signal = SIGNALS[f"right_knee_TPDO1.{name}"]
        assert decoded[name] == signal.to_si(signal.read(data))


def test_known_frame_decodes_to_known_values() -> None:
    """Plan: half a turn is 65536 counts at 17 bit; two counts a second backwards."""
    decoded = decode(0x185, bytes.fromhex("00000100feffffff"))
    assert decoded["position"] == pytest.approx(math.pi, rel=1e-15)  # one rounding of 65536 x scale
    assert decoded["velocity"] == pytest.approx(-4 * math.pi / 131072, rel=1e-15)


def test_target_torque_counts_per_mille_of_rated() -> None:
    """CiA 402-2, 0x6071: 1000 is the rated torque, 54.9 N m at the knee."""
    decoded = decode(0x205, bytes.fromhex("0f00e803"))
    assert decoded["controlword"] == 15
    assert decoded["target_torque"] == pytest.approx(54.9, rel=1e-12)  # a few roundings in the scale


@pytest.mark.parametrize(
    ("can_id", "data", "expected"),
    [
        (0x000, "0100", {"nmt_command": "start", "nmt_node": 0}),
        (0x080, "f0", {"sync_counter": 240}),
        (0x2FF, "020a000080", {"state": "motion", "cycle": 10, "phase": 0.5}),
        (0x705, "05", {"nmt_state": "operational"}),
        (0x77F, "7f", {"nmt_state": "pre_operational"}),
        (0x085, "3081110000000000", {"emcy_error_code": 0x8130, "emcy_error_register": 17, "emcy_manufacturer": 0}),
    ],
    ids=["NMT", "SYNC", "HLC status", "heartbeat", "master heartbeat", "EMCY"],
)
def test_service_frames_decode(can_id: int, data: str, expected: dict[str, object]) -> None:
    """CiA 301: NMT, SYNC, heartbeat and EMCY layouts; the HLC status frame of the plan."""
    decoded = decode(can_id, bytes.fromhex(data))
    assert {name: getattr(value, "name", value) for name, value in decoded.items()} == expected


def test_ids_and_names_are_unique() -> None:
    """A tool finds a message by id and by name."""
    messages = DATABASE.messages
    assert len({message.frame_id for message in messages}) == len(messages)
    assert len({message.name for message in messages}) == len(messages)


def test_plan_without_sync_counter_has_an_empty_sync() -> None:
    """CiA 301, 1019 = 0: SYNC carries no data."""
    joints = (JointNode("right_knee", 9, 54_900, 4096),)
    database = read(BusPlan(joints, sync_counter=0))
    assert database.get_message_by_name("SYNC").length == 0
    assert database.get_message_by_name("right_knee_TPDO1").frame_id == 0x189
    assert {node.name for node in database.nodes} == {"HLC", "right_knee"}


def test_text_has_line_feeds_only_and_no_names_cut_short() -> None:
    """The stored file is the same on every system; DBC names have at most 32 letters."""
    text = dbc_text(PLAN)
    assert "\r" not in text
    assert text.endswith("\n")
    assert "SystemMessageLongSymbol" not in text
