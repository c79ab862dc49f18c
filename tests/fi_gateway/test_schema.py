"""`injectors:` in a file becomes the engine's objects."""

import numpy as np
import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.errors import FaultError
from fi_gateway.outlet import Tray
from fi_gateway.schema import build_injectors
from tests.fi_gateway.injector_texts import PLAN, POSITION, SECOND, TPDO1, VELOCITY, built, injector, outcome, read


@pytest.mark.parametrize(
    ("fault", "target", "data", "result"),
    [
        ("{type: stuck_at}", POSITION, "05000000 06000000", "01000000 06000000"),
        ("{type: stuck_at}", TPDO1, "05000000 06000000", "01000000 02000000"),
        ("{type: stuck_at_value, value: 0 rpm}", VELOCITY, "05000000 06000000", "05000000 00000000"),
        ("{type: stuck_at_value, value: 360 deg}", POSITION, "05000000 06000000", "00000200 06000000"),
        ("{type: stuck_at_value, value: -12 counts}", POSITION, "05000000 06000000", "F4FFFFFF 06000000"),
        ("{type: stuck_at_value, value: 3 counts/s}", VELOCITY, "05000000 06000000", "05000000 03000000"),
        ("{type: stuck_at_value, payload: 00 11 22 33 44 55 66 77}", TPDO1, "00" * 8, "0011223344556677"),
        ("{type: bias, value: 180 deg}", POSITION, "05000000 06000000", "05000100 06000000"),
        ("{type: bias, value: -1 counts}", POSITION, "05000000 06000000", "04000000 06000000"),
        ("{type: bias, value: 0 rad}", POSITION, "05000000 06000000", "05000000 06000000"),
        ("{type: bias, value: 0 counts}", POSITION, "05000000 06000000", "05000000 06000000"),
        ("{type: bit_flip, positions: [0, 31]}", POSITION, "05000000 06000000", "04000080 06000000"),
        ("{type: bit_flip, positions: [0, 31]}", VELOCITY, "05000000 06000000", "05000000 07000080"),
        ("{type: bit_flip, positions: [63]}", TPDO1, "05000000 06000000", "05000000 06000080"),
    ],
)
def test_a_fault_in_a_file_does_what_it_says(fault: str, target: str, data: str, result: str) -> None:
    """Values in units of the file become the right bits on the wire."""
    assert outcome(fault, target, bytes.fromhex(data)) == bytes.fromhex(result)


@pytest.mark.parametrize(
    ("fault", "target", "name"),
    [
        ("{type: drop}", TPDO1, "right_knee.TPDO1"),
        ("{type: drop}", "{bus: to_drives, cob_id: 0x80}", "SYNC 0x080"),
        ("{type: drop}", "{bus: to_controller, pdo: TPDO1}", "TPDO1 0x181..0x186"),
        ("{type: stuck_at_value, value: 1 counts}", POSITION, "right_knee.position"),
    ],
)
def test_records_name_what_the_file_targets(fault: str, target: str, name: str) -> None:
    """An activation says what was hit, whole frames as well as signals."""
    one = build_injectors(read(a=injector(fault, target)), PLAN, 1, 0)[0]
    one.start(0)
    record = one.open(0, "test")
    assert record is not None
    assert record.signal == name


def test_a_plain_number_sets_a_signal_without_unit() -> None:
    """statusword has no unit: 0x27 is a plain number."""
    target = "{bus: to_controller, node: right_knee, signal: statusword}"
    found = build_injectors(read(a=injector("{type: stuck_at_value, value: 0x27}", target)), PLAN, 1, 0)[0]
    found.start(0)
    found.open(0, "test")
    result = found.act(1, 1, Frame(0x285, bytes(6)), Tray())
    assert result is not None
    assert result.data == bytes.fromhex("270000000000")


def test_drop_loses_the_frame_or_some_of_them() -> None:
    """Probability 1 by default, or as given."""
    assert outcome("{type: drop}", TPDO1) is None
    active = built("{type: drop, probability: 20 %}", TPDO1)
    lost = sum(active.act(1, 1, Frame(0x185, bytes(8)), Tray()) is None for _ in range(2000))
    assert abs(lost - 400) < 4 * (2000 * 0.2 * 0.8) ** 0.5  # 4 sigma of a binomial


@pytest.mark.parametrize(("bits", "fixed"), [("", False), (", bits: random", False), (", bits: fixed", True)])
def test_bits_fixed_stay_for_the_activation(bits: str, fixed: bool) -> None:
    """New bits per frame unless `bits: fixed`."""
    active = built(f"{{type: bit_flip, count: 3{bits}}}")
    seen = set()
    for _ in range(50):
        result = active.act(1, 1, Frame(0x185, bytes(8)), Tray())
        assert result is not None
        word = int.from_bytes(result.data, "little")
        assert word.bit_count() == 3
        assert word < 1 << 32
        seen.add(word)
    assert (len(seen) == 1) == fixed


@pytest.mark.parametrize(
    ("event", "effect", "first", "length"),
    [
        ("{type: never}", "{type: infinite}", NEVER, NEVER),
        ("{type: at, time: 3 s}", "{type: constant_time, duration: 0.3 s}", 3 * SECOND, 3 * SECOND // 10),
        ("{type: at, times: [2 s, 1 s]}", "{type: once}", SECOND, NEVER),
        ("{type: failure_probability, p: 1, per: 1 ms}", "{type: infinite}", SECOND // 1000, NEVER),
        ("{type: failure_probability, p: 100 %, per: sync}", "{type: infinite}", 2 * SECOND // 1000, NEVER),
        ("{type: failure_probability, p: 0, per: 1 ms}", "{type: infinite}", NEVER, NEVER),
    ],
)
def test_events_and_effects_have_the_times_of_the_file(event: str, effect: str, first: int, length: int) -> None:
    """Durations are exact ns; `per: sync` is one control cycle."""
    spec = read(a=injector(event=event, effect=effect))["a"]
    assert spec.event.build(PLAN, np.random.default_rng(0)).first() == first
    assert spec.effect.build(PLAN, np.random.default_rng(0)).duration() == length


def test_injectors_are_built_in_written_order_with_their_own_streams() -> None:
    """Faults apply in written order; another injector more changes no stream."""
    event = "{type: failure_probability, p: 0.001, per: 1 ms}"
    one, two = injector(event=event), injector(event=event, target=VELOCITY)
    alone = build_injectors(read(a=one), PLAN, 7, 3)
    both = build_injectors(read(b=two, a=one), PLAN, 7, 3)
    other = build_injectors(read(a=one), PLAN, 7, 4)
    assert [found.name for found in both] == ["b", "a"]
    for found in (*alone, *both, *other):
        found.start(0)
    assert alone[0].next_ns == both[1].next_ns
    assert alone[0].next_ns != both[0].next_ns
    assert alone[0].next_ns != other[0].next_ns


def test_switches_and_triggers_reach_the_engine() -> None:
    """enabled, from, trigger."""
    specs = read(
        a=injector(more=", enabled: false"),
        b=injector(more=", from: power_up, trigger: {any: [a], on: activated}"),
    )
    a, b = build_injectors(specs, PLAN, 0, 0)
    assert (a.enabled, a.from_power_up, a.trigger) == (False, False, None)
    assert (b.enabled, b.from_power_up) == (True, True)
    assert b.trigger is not None
    assert b.trigger.any_of == ("a",)


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (", repair: {checksum: {type: xor, byte: 7}}", "05000000 00000005"),
        (", repair: {checksum: {type: xor, byte: 7, prefix: A0}}", "05000000 000000A5"),
        (", repair: {counter: {start: 0, length: 4}}", "00000000 00000000"),
    ],
)
def test_a_repair_reaches_the_engine(more: str, expected: str) -> None:
    """The payload that goes on has it."""
    one = build_injectors(read(a=injector("{type: bias, value: 5 counts}", more=more)), PLAN, 1, 0)[0]
    one.start(0)
    one.open(0, "test")
    result = one.act(1, 1, Frame(0x185, bytes(8)), Tray())
    assert result is not None
    assert result.data == bytes.fromhex(expected)


def test_building_what_was_never_checked_is_refused() -> None:
    """A plan of another rig: the message names injector and key."""
    specs = read(a=injector())
    plan = BusPlan((JointNode("left_knee", 1, 54_900, 131_072),))
    with pytest.raises(FaultError, match=r"injectors\.a\.target\.node: unknown joint 'right_knee'"):
        build_injectors(specs, plan, 0, 0)
