"""The bus plan: COB-IDs, load and what it refuses."""

import dataclasses
import math
import re
from collections.abc import Sequence

import pytest

from canopen_exo.errors import CanopenExoError
from canopen_exo.plan import (
    HLC_STATUS,
    MASTER_ID,
    PDOS,
    POSITION,
    RPDO1,
    TPDO1,
    TPDO2,
    VELOCITY,
    BusPlan,
    JointNode,
    Pdo,
)

NAMES = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
JOINTS = tuple(JointNode(name, number, 50_000, 131_072) for number, name in enumerate(NAMES, 1))


def plan(**changes: object) -> BusPlan:
    return dataclasses.replace(BusPlan(JOINTS), **changes)  # type: ignore[arg-type] # one change at a time, by name


# --- load --------------------------------------------------------------------------------------------------------


def share(rows: Sequence[tuple[float, int]], bits_per_frame: int, bits_per_byte: int) -> float:
    """Share of 1 Mbit/s of (frames a second, bytes)."""
    return sum(rate * (bits_per_frame + bits_per_byte * size) for rate, size in rows) / 1e6


CYCLIC = [(500, 1), (6 * 500, 4), (6 * 500, 8)]
"""SYNC with counter, RPDO1, TPDO1 at 500 Hz."""

SLOW = [(6 * 50, 6), (7 * 10, 1), (50, 5)]
"""TPDO2 every 10th SYNC, seven heartbeats every 100 ms, HLC status every 10th SYNC."""


def test_load_of_the_default_plan_is_the_sum_of_its_frames() -> None:
    """Wire rules: 47 + 8n bits without stuffing, 55 + 10n at most; the frames counted by hand."""
    low, high = BusPlan(JOINTS).load()
    assert low == pytest.approx(share(CYCLIC + SLOW, 47, 8), rel=1e-12)  # rounding of a sum of six terms
    assert high == pytest.approx(share(CYCLIC + SLOW, 55, 10), rel=1e-12)


def test_load_is_63_to_76_percent() -> None:
    """Design, bus plan: with TPDO2 and heartbeats 63..76 %; the HLC status adds 0.4 to 0.6 % to that."""
    low, high = BusPlan(JOINTS).load()
    assert math.floor(100 * low) == 63
    assert math.floor(100 * high) == 76


def test_sync_without_counter_saves_its_byte() -> None:
    """0x1019 = 0: SYNC has no data."""
    with_counter, without = BusPlan(JOINTS).load(), plan(sync_counter=0).load()
    assert with_counter[0] - without[0] == pytest.approx(500 * 8 / 1e6)
    assert with_counter[1] - without[1] == pytest.approx(500 * 10 / 1e6)


def test_load_goes_with_the_bit_rate() -> None:
    """Half the bit rate is twice the load; a third of the traffic is needed to make room for it."""
    few = plan(joints=JOINTS[:2]).load()
    slow = plan(joints=JOINTS[:2], bitrate=500_000).load()
    assert slow == pytest.approx((2 * few[0], 2 * few[1]))


def test_second_large_tpdo_in_every_cycle_is_refused() -> None:
    """Design: a second 8-byte TPDO from every joint in every cycle would be 93..112 %: over the limit once stuffed."""
    more = (*PDOS[:2], Pdo("TPDO2", TPDO2, 1, (POSITION, VELOCITY)))
    with pytest.raises(CanopenExoError) as caught:
        plan(pdos=more)
    text = str(caught.value)
    found = re.fullmatch(
        r"bus plan: worst-case load (\d+) % of 1000000 bit/s at a SYNC period of 2 ms \((\d+) % without stuff bits\); "
        r"at most 100 % is allowed: lower the rate or map less",
        text,
    )
    assert found, text
    cyclic = [*CYCLIC, (6 * 500, 8)]
    assert (math.floor(100 * share(cyclic, 47, 8)), math.floor(100 * share(cyclic, 55, 10))) == (93, 112)
    rows = [*cyclic, *SLOW[1:]]  # heartbeats and HLC status, which the design's figures leave out
    assert (int(found[2]), int(found[1])) == (round(100 * share(rows, 47, 8)), round(100 * share(rows, 55, 10)))


def test_rate_that_just_fits_is_taken() -> None:
    """The worst case is compared with 100 %, without a margin: a node alone, then made to send just too much."""
    alone = JOINTS[:1]
    for every_us in range(150, 400):
        rate = 1e6 / every_us
        rows = [(rate, 1), (rate, 4), (rate, 8), (rate / 10, 6), (20.0, 1), (rate / 10, 5)]
        if share(rows, 55, 10) > 1.0:
            with pytest.raises(CanopenExoError, match="worst-case load"):
                plan(joints=alone, cycle_ns=every_us * 1000)
        else:
            assert 0.99 < plan(joints=alone, cycle_ns=every_us * 1000).load()[1] <= 1.0
            return
    pytest.fail("no rate fits")


# --- refusals ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bitrate", [0, -1, 300_000, 1_000_001])
def test_bit_rate_without_a_whole_bit_time_is_refused(bitrate: int) -> None:
    """Times are whole nanoseconds; the message gives rates that work."""
    with pytest.raises(CanopenExoError, match=f"bit rate {bitrate} given") as caught:
        plan(bitrate=bitrate)
    assert "500000" in str(caught.value)


@pytest.mark.parametrize("cycle_ns", [0, -2_000_000])
def test_cycle_that_is_no_time_is_refused(cycle_ns: int) -> None:
    """A SYNC period is a time to the next SYNC."""
    with pytest.raises(CanopenExoError, match=f"SYNC period of {cycle_ns} ns given"):
        plan(cycle_ns=cycle_ns)


@pytest.mark.parametrize("heartbeat_ns", [0, -1])
def test_heartbeat_that_is_no_time_is_refused(heartbeat_ns: int) -> None:
    """The rig supervises its drives by heartbeat: it cannot be switched off in the plan."""
    with pytest.raises(CanopenExoError, match=f"heartbeat period of {heartbeat_ns} ns given"):
        plan(heartbeat_ns=heartbeat_ns)


@pytest.mark.parametrize("counter", [0, 2, 3, 239, 240])
def test_counter_overflow_values_of_the_standard_are_taken(counter: int) -> None:
    """CiA 301, object 1019: 0, 2..240."""
    assert plan(sync_counter=counter).sync_counter == counter


@pytest.mark.parametrize("counter", [-1, 1, 241, 255])
def test_other_counter_overflow_values_are_refused(counter: int) -> None:
    """CiA 301, object 1019: 1 and 241..255 are reserved."""
    with pytest.raises(CanopenExoError, match=rf"SYNC counter {counter} given, allowed 0 or 2\.\.240"):
        plan(sync_counter=counter)


@pytest.mark.parametrize("ids", [(1, 1), (0, 1), (1, 127), (1, 128), (-1, 1)])
def test_node_ids_that_clash_or_do_not_exist_are_refused(ids: tuple[int, int]) -> None:
    """CiA 301: node ids are distinct, 1..127; 127 is the master's."""
    joints = tuple(JointNode(f"j{number}", number, 1000, 4096) for number in ids)
    with pytest.raises(CanopenExoError) as caught:
        BusPlan(joints)
    assert f"node ids {list(ids)} given, allowed are distinct ids 1..126" in str(caught.value)


@pytest.mark.parametrize("ids", [(1, 2), (1, 126), (126, 125)])
def test_any_other_node_ids_are_taken(ids: tuple[int, int]) -> None:
    """The bounds themselves are allowed, in any order."""
    joints = tuple(JointNode(f"j{number}", number, 1000, 4096) for number in ids)
    assert [joint.node_id for joint in BusPlan(joints).joints] == list(ids)


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    """Style: a message lists the valid values."""
    whole = BusPlan(JOINTS)
    with pytest.raises(CanopenExoError, match="unknown joint 'knee'; this rig has left_hip, left_knee, left_ankle, "):
        whole.joint("knee")
    with pytest.raises(CanopenExoError, match="no PDO 'TPDO3'; there are RPDO1, TPDO1, TPDO2"):
        whole.pdo("TPDO3")
    with pytest.raises(CanopenExoError, match="TPDO1 carries no 'torque'; it carries position, velocity"):
        whole.pdo("TPDO1").place("torque")


# --- content -----------------------------------------------------------------------------------------------------


def test_cob_ids_are_those_of_the_design() -> None:
    """Design, bus plan: the table, in full."""
    table = [(pdo.name, pdo.base, pdo.every, [(m.index, m.length, m.signed) for m in pdo.content]) for pdo in PDOS]
    assert table == [
        ("RPDO1", 0x200, 1, [(0x6040, 16, False), (0x6071, 16, True)]),
        ("TPDO1", 0x180, 1, [(0x6064, 32, True), (0x606C, 32, True)]),
        ("TPDO2", 0x280, 10, [(0x6041, 16, False), (0x6077, 16, True), (0x603F, 16, False)]),
    ]
    assert (RPDO1, TPDO1, TPDO2, HLC_STATUS, MASTER_ID) == (0x200, 0x180, 0x280, 0x2FF, 127)


def test_no_two_messages_share_a_cob_id() -> None:
    """CiA 301, 7.3.5: over all node ids a drive may have, and with the HLC status, SYNC, NMT and TIME."""
    used = [0x000, 0x080, 0x100, HLC_STATUS, 0x700 + MASTER_ID]
    for node_id in range(1, 127):
        used += [pdo.base + node_id for pdo in PDOS]
        used += [0x080 + node_id, 0x580 + node_id, 0x600 + node_id, 0x700 + node_id]
    assert len(used) == len(set(used))
    assert max(used) <= 0x7FF


def test_signals_are_every_mapped_value_of_every_joint() -> None:
    """Names, COB-IDs and bits of all 42 signals, in node and PDO order."""
    found = [
        (s.message, s.name, s.node, s.cob_id, s.start, s.length, s.signed, s.unit, s.index)
        for s in BusPlan(JOINTS).signals()
    ]
    expected = []
    for node_id, name in enumerate(NAMES, 1):
        expected += [
            (f"{name}_RPDO1", "controlword", name, 0x200 + node_id, 0, 16, False, "", 0x6040),
            (f"{name}_RPDO1", "target_torque", name, 0x200 + node_id, 16, 16, True, "N m", 0x6071),
            (f"{name}_TPDO1", "position", name, 0x180 + node_id, 0, 32, True, "rad", 0x6064),
            (f"{name}_TPDO1", "velocity", name, 0x180 + node_id, 32, 32, True, "rad/s", 0x606C),
            (f"{name}_TPDO2", "statusword", name, 0x280 + node_id, 0, 16, False, "", 0x6041),
            (f"{name}_TPDO2", "torque", name, 0x280 + node_id, 16, 16, True, "N m", 0x6077),
            (f"{name}_TPDO2", "error_code", name, 0x280 + node_id, 32, 16, False, "", 0x603F),
        ]
    assert found == expected


def test_scale_of_position_velocity_and_torque() -> None:
    """CiA 402-2: torque counts per mille of 0x6076; position counts of the encoder, velocity counts a second."""
    whole, joint = BusPlan(JOINTS), JointNode("x", 1, 72_900, 131_072)
    assert whole.scale(joint, "rad") * 131_072 == pytest.approx(2 * math.pi, rel=1e-15)  # one rounding
    assert whole.scale(joint, "rad/s") == whole.scale(joint, "rad")
    assert whole.scale(joint, "N m") * 1000 == pytest.approx(72.9, rel=1e-15)
    assert whole.scale(joint, "") == 1.0


@pytest.mark.parametrize(("name", "size"), [("RPDO1", 4), ("TPDO1", 8), ("TPDO2", 6)])
def test_codec_of_a_pdo_has_its_size(name: str, size: int) -> None:
    """Design, bus plan: 4-byte RPDO1, 8-byte TPDO1, 6-byte TPDO2; values come back in the order of the content."""
    pdo = BusPlan(JOINTS).pdo(name)
    codec = pdo.codec()
    values = tuple(range(3, 3 + len(pdo.content)))
    assert (codec.size, codec.unpack(codec.pack(values))) == (size, values)
    assert [pdo.place(mapped.name) for mapped in pdo.content] == list(range(len(pdo.content)))
