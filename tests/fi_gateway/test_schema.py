"""`injectors:` in a file becomes the engine's objects, or every complaint at its place; and can be said in words."""

from typing import Final

import numpy as np
import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import validate
from fi_gateway.errors import FaultError
from fi_gateway.injector import Injector
from fi_gateway.marked_yaml import FileErrors, parse
from fi_gateway.outlet import Tray
from fi_gateway.schema import InjectorSpec, build_injectors, check_injectors, describe_injectors

NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))
SECOND: Final = 1_000_000_000

POSITION: Final = "{bus: to_controller, node: right_knee, signal: position}"
VELOCITY: Final = "{bus: to_controller, node: right_knee, signal: velocity}"
TPDO1: Final = "{bus: to_controller, node: right_knee, pdo: TPDO1}"


def injector(
    fault: str = "{type: stuck_at}",
    target: str = POSITION,
    event: str = "{type: never}",
    effect: str = "{type: infinite}",
    more: str = "",
) -> str:
    """One injector in flow style; fault in column 9 + len(target)."""
    return f"{{target: {target}, fault: {fault}, event: {event}, effect: {effect}{more}}}"


def read(**injectors: str) -> dict[str, InjectorSpec]:
    """Specs of injectors in flow style, checked; raises FileErrors."""
    text = "".join(f"{name}: {spec}\n" for name, spec in injectors.items())
    document = parse(text, "s.yaml")
    assert isinstance(document.data, dict)
    specs = {name: validate(InjectorSpec, spec, (name,), document) for name, spec in document.data.items()}
    check_injectors(document.data, PLAN, document.report)
    document.raise_problems()
    return {name: spec for name, spec in specs.items() if spec is not None}


def complaints(**injectors: str) -> tuple[str, ...]:
    """All messages about injectors, without the file's place."""
    with pytest.raises(FileErrors) as caught:
        read(**injectors)
    return tuple(message.partition(": ")[2] for message in caught.value.messages)


def built(fault: str, target: str = POSITION) -> Injector:
    """An injector that is active from 0 ns on."""
    specs = read(a=injector(fault, target))
    found = build_injectors(specs, PLAN, 1, 0)[0]
    found.start(0)
    found.held[0x185] = Frame(0x185, PAYLOAD)
    assert found.open(0, "test") is not None
    return found


def outcome(fault: str, target: str = POSITION, data: bytes = bytes(8)) -> bytes | None:
    """What becomes of a TPDO1 of the right knee."""
    result = built(fault, target).act(1, 1, Frame(0x185, data), Tray())
    return None if result is None else result.data


PAYLOAD: Final = bytes.fromhex("01000000 02000000")


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
    ("fault", "target", "message"),
    [
        ("{type: stuk_at}", POSITION, ["a.fault.type: unknown fault 'stuk_at'; did you mean 'stuck_at'?", "bit_flip"]),
        ("{type: no_ack}", POSITION, ["a.target.signal: wire faults act on frames, not on what is in them"]),
        ("{value: 2}", POSITION, ["a.fault.type: missing; allowed: stuck_at, stuck_at_value, package_drop"]),
        ("stuck_at", POSITION, ["a.fault: expected a mapping with type: stuck_at | ", "got 'stuck_at'"]),
        ("{type: stuck_at, value: 1 deg}", POSITION, ["a.fault.value: stuck_at has no such key (allowed: type)"]),
        ("{type: stuck_at_value}", POSITION, ["a.fault: value is missing", "position shall read, in rad"]),
        ("{type: stuck_at_value}", TPDO1, ["a.fault: payload is missing"]),
        ("{type: stuck_at_value, value: 0 rpm}", POSITION,
         ["a.fault.value: position of right_knee: '0 rpm' is an angular velocity; an angle is wanted", "rad, mrad"]),
        ("{type: stuck_at_value, value: 0}", POSITION, ["a.fault.value", "0 has no unit; an angle needs one"]),
        ("{type: stuck_at_value, value: true}", POSITION, ["a.fault.value: expected a value", "got true"]),
        ("{type: stuck_at_value, value: 3 counts/s}", POSITION, ["unknown unit 'counts/s'"]),
        ("{type: stuck_at_value, value: 1.5 counts}", POSITION, ["unknown unit 'counts'"]),
        ("{type: stuck_at_value, value: 1 rad}", TPDO1, ["a.fault.value: the target is a whole frame"]),
        ("{type: stuck_at_value, payload: 00 00}", POSITION, ["a.fault.payload: the target is a signal"]),
        ("{type: stuck_at_value, payload: 00 00}", TPDO1, ["a.fault.payload: 2 bytes given", "carries 8"]),
        ("{type: stuck_at_value, payload: 0}", TPDO1, ["a.fault.payload: expected 1 to 8 bytes", "got 0"]),
        ("{type: bias, value: 1 rad}", TPDO1, ["a.fault.type: bias acts on a signal", "add signal"]),
        ("{type: bias}", POSITION, ["a.fault.value: missing; needed: type, value"]),
        ("{type: bias, value: 1e-5 rad}", POSITION, ["less than half of one count (4.79e-05 rad)"]),
        ("{type: drop}", POSITION, ["a.fault.type: drop loses whole frames", "give pdo instead of position"]),
        ("{type: drop, probability: 1.01}", TPDO1, ["a.fault.probability: 1.01 is not a probability; allowed 0..1"]),
        ("{type: bit_flip, count: 0}", POSITION, ["a.fault.count: 0 is too small; allowed from 1 up"]),
        ("{type: bit_flip, count: 33}", POSITION, ["a.fault.count: 33 bits asked for", "has 32"]),
        ("{type: bit_flip, count: 65}", TPDO1, ["a.fault.count: 65 bits asked for", "has 64"]),
        ("{type: bit_flip, count: 1.0}", POSITION, ["a.fault.count: expected a whole number; got 1.0"]),
        ("{type: bit_flip, positions: [32]}", POSITION, ["a.fault.positions.0: there is no bit 32", "bits 0..31"]),
        ("{type: bit_flip, positions: [-1]}", POSITION, ["a.fault.positions.0: there is no bit -1"]),
        ("{type: bit_flip, positions: [3, 3]}", POSITION, ["a.fault.positions.1: bit 3 is given twice"]),
        ("{type: bit_flip, positions: []}", POSITION, ["a.fault.positions: the list needs at least 1 item"]),
        ("{type: bit_flip, positions: 3}", POSITION, ["a.fault.positions: expected a list such as [a, b]; got 3"]),
        ("{type: bit_flip, positions: [3], count: 1}", POSITION, ["a.fault.count: positions say which bits"]),
        ("{type: bit_flip, positions: [3], bits: fixed}", POSITION, ["a.fault.bits: positions say which bits"]),
        ("{type: bit_flip, bits: new}", POSITION, ["a.fault.bits: unknown bits 'new'", "random, fixed"]),
        ("{type: stuck_at}", "{bus: both, node: right_knee, kind: sdo}",
         ["a.target.kind: unknown kind 'sdo'", "sdo_request, sdo_answer, emcy, heartbeat, sync, nmt"]),
        ("{type: stuck_at}", "{bus: both, cob_id: 0x800}", ["a.target.cob_id: COB-ID 0x800 is outside 0x0..0x7ff"]),
        ("{type: stuck_at}", "{bus: both, cob_id: 0x185/0x780}",
         ["a.target.cob_id: 0x185/0x780: bits 0x5 are not in the mask"]),
        ("{type: stuck_at}", "{bus: both, cob_id: 0x180/780}", ["a.target.cob_id: expected a COB-ID with a mask"]),
        ("{type: stuck_at}", "{bus: both, cob_id: 0x180/0x1000}", ["a.target.cob_id: COB-ID 0x1000 is outside"]),
        ("{type: stuck_at}", "{bus: both, cob_id: 0x185, bits: {start: 64, length: 1}}",
         ["a.target.bits.start: 64 is too large; allowed up to 63"]),
        ("{type: stuck_at}", "{bus: both, cob_id: 0x185, bits: {start: 0}}", ["a.target.bits.length: missing"]),
        ("{type: stuck_at}", "{bus: both, cob_id: true}", ["a.target.cob_id: expected a COB-ID", "got true"]),
        ("{type: stuck_at}", "{node: right_knee, pdo: TPDO1}", ["a.target.bus: missing; needed: bus"]),
        ("{type: stuck_at}", "{bus: both, node: 5, pdo: TPDO1}", ["a.target.node: expected a text; got 5"]),
        ("{type: stuck_at}", "{bus: both, signal: []}", ["a.target.signal: expected a signal such as position"]),
    ],
)  # fmt: skip
def test_a_fault_or_target_that_cannot_be_is_refused(fault: str, target: str, message: list[str]) -> None:
    """What, where, got, allowed, remedy; exactly one message."""
    (said,) = complaints(a=injector(fault, target))
    assert all(words in said for words in message), said


@pytest.mark.parametrize(
    ("value", "fits"),
    [
        ("2147483647 counts", True), ("2147483648 counts", False),
        ("-2147483648 counts", True), ("-2147483649 counts", False),
        ("102943 rad", True), ("102944 rad", False),
    ],
)  # fmt: skip
def test_a_value_must_fit_its_signal(value: str, fits: bool) -> None:
    """i32 counts: dense at both ends; 2^31 counts are 102943.7 rad."""
    text = injector(f"{{type: stuck_at_value, value: {value}}}")
    if fits:
        assert read(a=text)
    else:
        (said,) = complaints(a=text)
        assert "more than position of right_knee can carry; allowed -102944..102944 rad" in said


@pytest.mark.parametrize(("value", "fits"), [("4294967295 counts", True), ("-4294967296 counts", False)])
def test_a_bias_must_be_within_the_whole_range(value: str, fits: bool) -> None:
    """Farther than from one end to the other a bias cannot go."""
    text = injector(f"{{type: bias, value: {value}}}")
    if fits:
        assert read(a=text)
    else:
        assert "more than the whole range" in complaints(a=text)[0]


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"event": "{type: rate}"}, "a.event.lambda: missing; needed: type, lambda"),
        ({"event": "{type: rate, lambda: 0.5}"}, "a.event.lambda: 0.5 has no unit; a rate needs one (units: 1/s, "),
        ({"event": "{type: rate, lambda: 0 1/s}"}, "a.event.lambda: '0 1/s' is not a rate of failures; allowed is"),
        ({"event": "{type: rate, lambda: 1 Hz}"}, "a.event.lambda: '1 Hz' is a frequency; a rate is wanted"),
        ({"event": "{type: mttf, mean: 0 s, sd: 1 s}"}, "a.event.mean: '0 s' is not a length of time"),
        ({"event": "{type: mttf, mean: 1 s, sd: -1 s}"}, "a.event.sd: '-1 s' is negative"),
        ({"event": "{type: distribution, law: {type: gauss}}"}, "a.event.law.type: unknown law 'gauss'"),
        ({"event": "{type: distribution}"}, "a.event.law: missing; needed: type, law"),
        ({"event": "{type: every, n: 0}"}, "a.event.n: 0 is too small; allowed from 1 up"),
        ({"event": "{type: every, n: 1.5}"}, "a.event.n: expected a whole number; got 1.5"),
        ({"event": "{type: gait_phase, phase: 100 %}"}, "a.event: phase: 100 % is 0 % of the next stride"),
        ({"event": "{type: gait_phase, phase: -0.1}"}, "a.event.phase: -0.1 is not a probability"),
        ({"event": "{type: when, condition: knee.position < 1 deg}"},
         "a.event.condition: character 1: unknown joint or message 'knee'"),
        ({"event": "{type: when, condition: right_knee.position < 1}"},
         "a.event.condition: character 1: '1' has no unit; an angle needs one"),
        ({"event": "{type: when, condition: right_knee.position}"},
         "a.event.condition: character 1: expected SIGNAL OPERATOR VALUE"),
        ({"event": "{type: when, condition: right_knee.position < 1 deg, edge: falling}"},
         "a.event.edge: unknown edge 'falling' (allowed: rising, level)"),
        ({"event": "{type: at}"}, "a.event: give time (one) or times (a list)"),
        ({"event": "{type: at, time: 1 s, times: [2 s]}"}, "a.event: give time (one) or times (a list)"),
        ({"event": "{type: at, times: [1 s, 1000 ms]}"}, "a.event: the same time is given twice"),
        ({"event": "{type: at, times: []}"}, "a.event.times: the list needs at least 1 item"),
        ({"event": "{type: at, time: -1 ns}"}, "a.event.time: '-1 ns' is negative"),
        ({"event": "{type: at, times: [1 s, 3]}"}, "a.event.times.1: 3 has no unit; a duration needs one"),
        ({"event": "{type: failure_probability, p: 0.1}"}, "a.event.per: missing; needed: type, p, per"),
        ({"event": "{type: failure_probability, p: 0.1, per: 0 s}"},
         "'0 s' is not a period; allowed is more than 0 s, or sync"),
        ({"event": "{type: failure_probability, p: -0.1, per: 1 s}"}, "a.event.p: -0.1 is not a probability"),
        ({"effect": "{type: mttr}"}, "a.effect.mean: missing; needed: type, mean, sd"),
        ({"effect": "{type: frames, n: 0}"}, "a.effect.n: 0 is too small; allowed from 1 up"),
        ({"effect": "{type: distribution, law: {type: weibull, shape: 1}}"}, "a.effect.law.scale: missing"),
        ({"effect": "{type: until, condition: right_knee.temperature > 3}"},
         "a.effect.condition: character 1: no signal 'temperature' of right_knee"),
        ({"effect": "{type: constant_time}"}, "a.effect.duration: missing; needed: type, duration"),
        ({"effect": "{type: constant_time, duration: 0 s}"}, "a.effect.duration: '0 s' is not a length of time"),
        ({"effect": "{type: once, duration: 1 s}"}, "a.effect.duration: once has no such key (allowed: type)"),
        ({"more": ", enabled: off"}, "a.enabled: expected true or false; got 'off'"),
        ({"more": ", from: boot"}, "a.from: unknown from 'boot' (allowed: time_zero, power_up)"),
        ({"more": ", rearm: 1"}, "a.rearm: expected true or false; got 1"),
        ({"more": ", max_activations: 0"}, "a.max_activations: 0 is too small; allowed from 1 up"),
        ({"more": ", rearm: true"}, "a: an infinite effect never ends"),
        ({"more": ", max_activations: 2"}, "a: an infinite effect never ends"),
        ({"more": ", rearm: false, max_activations: 2", "effect": "{type: once}"}, "a: rearm: false allows one"),
        ({"more": ", rearm: true, max_activations: 1", "effect": "{type: once}"}, "a: max_activations: 1 leaves"),
        ({"more": ", trigger: {any: []}"}, "a.trigger.any: the list needs at least 1 item"),
        ({"more": ", trigger: {any: b}"}, "a.trigger.any: expected a list such as [a, b]; got 'b'"),
        ({"more": ", trigger: {any: [c]}"}, "a.trigger.any.0: no injector is called 'c' (there are a)"),
        ({"more": ", trigger: {any: [a]}"}, "a.trigger.any: triggers go round in a circle: a -> a"),
        ({"more": ", trigger: {all: [a], delay: 1 s}"}, "a.trigger.all: triggers go round in a circle: a -> a"),
        ({"more": ", trigger: {all: [b, b]}"}, "a.trigger.all.0: no injector is called 'b' (there are a)"),
        ({"more": ", trigger: {any: [a], on: end}"}, "a.trigger.on: unknown on 'end'; did you mean 'ended'?"),
        ({"more": ", trigger: {any: [a], edge: up}"}, "a.trigger.edge: unknown edge 'up' (allowed: rising, level)"),
        ({"more": ", trigger: {any: [a], delay: 3}"}, "a.trigger.delay: 3 has no unit; a duration needs one"),
        ({"more": ", trigger: {any: [a], probability: 2}"}, "a.trigger.probability: 2 is not a probability"),
        ({"more": ", trigger: {any: [b], all: [c]}"}, "a.trigger: give any (one of), all (of) or frame"),
        ({"more": ", trigger: {on: ended}"}, "a.trigger: give any (one of), all (of) or frame, one of the three; got"),
        ({"more": ", trigger: [a]"}, "a.trigger: expected a mapping with any, all, frame, on, edge, delay"),
        ({"more": ", trigger: {frame: {data: '01'}}"}, "a.trigger.frame.cob_id: missing"),
        ({"more": ", trigger: {frame: {cob_id: 0x800}}"}, "a.trigger.frame.cob_id: COB-ID 0x800 is outside"),
        ({"more": ", trigger: {frame: {cob_id: 1, data: '01', mask: 'FF FF'}}"}, "a.trigger.frame: mask 'FF FF' and"),
        ({"more": ", trigger: {frame: {cob_id: 1}, edge: level}"}, "a.trigger: edge: level needs any or all"),
        ({"more": ", trigger: {frame: {cob_id: 1}, on: ended}"}, "a.trigger: on: ended is a signal of injectors"),
        ({"more": ", report: {on: ended}"}, "a.report.frame: missing"),
        ({"more": ", report: {frame: {cob_id: 0x6F0, data: 1}}"}, "a.report.frame.data: expected 1 to 8 bytes"),
        ({"more": ", repair: {}"}, "a.repair: give checksum, counter or both"),
        ({"more": ", repair: {checksum: {type: md5, byte: 7}}"}, "a.repair.checksum.type: unknown type 'md5'"),
        ({"more": ", repair: {checksum: {type: xor, byte: 8}}"}, "a.repair.checksum.byte: 8 is too large"),
        ({"more": ", repair: {counter: {start: 62, length: 4}}"}, "a.repair.counter: there is no bit 65"),
        ({"more": ", repair: {checksum: {type: xor, byte: 1}, counter: {start: 12, length: 4}}"},
         "a.repair.counter: the counter lies in byte 1, where the checksum is"),
        ({"more": ", repair: {checksum: {type: xor, byte: 3}}", "target": "{bus: to_drives, kind: nmt}"},
         "a.repair.checksum.byte: there is no byte 3; NMT (0x000, to_drives) has 2"),
    ],
)  # fmt: skip
def test_an_event_effect_or_trigger_that_cannot_be_is_refused(part: dict[str, str], message: str) -> None:
    """What, where, got, allowed, remedy."""
    assert any(said.startswith(message) or message in said for said in complaints(a=injector(**part)))


def test_every_complaint_about_every_injector_comes_at_once() -> None:
    """All errors at once: shape, rig and triggers together, also within one injector."""
    said = complaints(
        a=injector("{type: drop}", effect="{type: constant_time, duration: 3}", more=", trigger: {any: [x]}"),
        b=injector(target="{bus: both, node: knee, signal: position}", event="{type: sometimes}", more=", color: red"),
    )
    assert [message.split(": ")[0] for message in said] == [
        "a.fault.type",
        "a.effect.duration",
        "a.trigger.any.0",
        "b.target.node",
        "b.event.type",
        "b.color",
    ]


@pytest.mark.parametrize(
    ("target", "fault", "message"),
    [
        ("bus: to_controller, node: knee, signal: position", "bias, value: 5 N m",
         "'5 N m' is a torque; an angle is wanted"),
        ("bus: to_master, node: right_knee, signal: position", "bias, value: 5",
         "position of right_knee: 5 has no unit"),
        ("bus: to_controller, node: right_knee, signal: positio", "bias, value: much",
         "position of right_knee: 'much' is not an angle"),
        ("bus: to_controller, node: right_knee, signal: positio", "bias, value: 5 N m", ""),  # of torque it is right
        ("bus: to_controller, node: right_knee, signal: positio", "bias, value: 5", ""),  # of statusword
        ("bus: to_controller, node: right_knee, signal: positio", "drop", "drop loses whole frames"),
        ("bus: to_controller, node: knee, pdo: TPDO1", "stuck_at_value, value: 0 rpm", "a whole frame"),
        ("bus: to_controller, node: knee, pdo: TPDO1", "drop", ""),
        ("bus: to_controller, node: knee, kind: emcy, bits: {start: 0, length: 8}", "bit_flip, positions: [8]",
         "there is no bit 8"),
        ("bus: to_controller, node: knee, kind: emcy, bits: {start: 60, length: 8}", "bit_flip, positions: [8]", ""),
        ("bus: to_controller, node: right_knee", "bias, value: much", ""),
        ("wire: drive, signal: position", "stuck_dominant", ""),
    ],
)  # fmt: skip
def test_a_fault_beside_a_wrong_target_is_judged_by_all_that_it_may_mean(target: str, fault: str, message: str) -> None:
    """All errors at once, and no consequences: what some target of that kind would take is not complained of."""
    first, *others = complaints(a=injector(f"{{type: {fault}}}", f"{{{target}}}"))
    assert first.startswith("a.target")
    assert [other.startswith("a.fault") for other in others] == ([True] if message else [])
    assert message in "".join(others)


def test_what_hangs_on_several_keys_is_judged_where_others_are_wrong() -> None:
    """The sources of a trigger, a repair beside a wrong target, a wire fault with a repair, the number of windows."""
    checksum = "{checksum: {type: xor, byte: 70}}"
    said = complaints(
        a=injector("{type: what}", more=", trigger: {any: [x], on: never}, rearm: false, max_activations: 3"),
        b=injector(target="{bus: to_controller, node: knee, pdo: TPDO1}", more=f", repair: {checksum}"),
        c=injector("{type: bit_error, field: crd}", "{wire: drive}", more=", repair: {counter: {start: 0, length: 4}}"),
    )
    assert [message.split(": ")[0] for message in said] == [
        "a",
        "a.fault.type",
        "a.trigger.any.0",
        "a.trigger.on",
        "b.target.node",
        "b.repair.checksum.byte",
        "c.fault.field",
        "c.repair",
    ]


@pytest.mark.parametrize(
    ("triggers", "circles"),
    [
        ({"a": "", "b": "a", "c": "b"}, []),
        ({"a": "", "b": "a", "c": "a", "d": "b, c"}, []),
        ({"a": "b", "b": "a"}, ["a -> b -> a"]),
        ({"a": "c", "b": "a", "c": "b"}, ["a -> b -> c -> a"]),
        ({"a": "", "b": "a, c", "c": "b"}, ["b -> c -> b"]),
        ({"a": "b", "b": "a", "c": "d", "d": "c"}, ["a -> b -> a", "c -> d -> c"]),
    ],
)
def test_chains_may_branch_and_join_but_not_go_round(triggers: dict[str, str], circles: list[str]) -> None:
    """A cycle is refused with the cycle printed, in the direction of cause."""
    specs = {
        name: injector(more=f", trigger: {{any: [{sources}]}}" if sources else "") for name, sources in triggers.items()
    }
    if not circles:
        assert read(**specs)
        return
    assert [message.split("circle: ")[1] for message in complaints(**specs)] == circles


def test_the_plan_of_an_injector_is_said_in_words() -> None:
    """The chain of the first experiment, read aloud."""
    length = "{type: constant_time, duration: 0.3 s}"
    specs = read(
        freeze_position=injector(event="{type: failure_probability, p: 0.0005, per: 1 ms}", effect=length),
        zero_velocity=injector(
            "{type: stuck_at_value, value: 0 rpm}", VELOCITY, effect=length, more=", trigger: {any: [freeze_position]}"
        ),
    )
    assert describe_injectors(specs, PLAN, 7 * SECOND) == [
        "freeze_position: position of right_knee (0x185, to_controller) held at its last value for 0.3 s; starts with "
        "probability 0.0005 per 1 ms (0.5/s), about 3.1 activations of freeze_position expected in 7 s, dead time "
        "included",
        "zero_velocity: velocity of right_knee (0x185, to_controller) reads 0 rpm for 0.3 s; starts when "
        "freeze_position is activated",
        "triggers:",
        "  freeze_position",
        "    `-- activated --> zero_velocity",
    ]


def test_chains_are_drawn() -> None:
    """`exo-hil check` draws who starts whom: branches, joins, chains, frames; each injector in full once."""
    specs = read(
        root=injector(event="{type: at, time: 1 s}"),
        left=injector(more=", trigger: {any: [root]}"),
        right=injector(more=", trigger: {any: [root], on: manifested, delay: 10 ms}"),
        join=injector(more=", trigger: {all: [left, right], on: ended, probability: 50 %}"),
        tail=injector(more=", trigger: {any: [join], edge: level}"),
        bus=injector(more=", trigger: {frame: {cob_id: 0x6F0, data: 01 00, mask: FF 00, bus: to_drives}, delay: 1 s}"),
        after=injector(more=", trigger: {any: [bus, tail]}"),
    )
    lines = describe_injectors(specs, PLAN, 7 * SECOND)
    assert lines[lines.index("triggers:") :] == [
        "triggers:",
        "  root",
        "    |-- activated --> left",
        "    |     `-- ended, with right, with probability 0.5 --> join",
        "    |           `-- activated, while it holds --> tail",
        "    |                 `-- activated --> after",
        "    `-- manifested, 10 ms later --> right",
        "          `-- ended, with left, with probability 0.5 --> join (above)",
        "  frame 0x6F0 01 00 (mask FF 00) to_drives",
        "    `-- 1 s later --> bus",
        "          `-- activated --> after (above)",
    ]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (", trigger: {any: [b, c]}", "when b or c is activated"),
        (", trigger: {any: [b], on: manifested}", "when b manifests"),
        (", trigger: {all: [b, c], on: ended}", "when b and c have all ended"),
        (", trigger: {all: [b, c]}", "when b and c are all activated"),
        (", trigger: {any: [b, c], edge: level}", "while b or c is active"),
        (", trigger: {any: [b], edge: level, on: ended, delay: 2 ms}", "while b has ended, 2 ms later"),
        (", trigger: {any: [b], probability: 20 %}", "when b is activated, with probability 0.2"),
        (", trigger: {frame: {cob_id: 0x6F0, data: 0A}}", "with frame 0x6F0 0A"),
        (", report: {frame: {cob_id: 0x6F1, data: '01', bus: to_drives}, on: ended}",
         "sends 0x6F1 01 to_drives when it ends"),
        (", repair: {checksum: {type: crc8_j1850, byte: 7}, counter: {start: 48, length: 4}}",
         "crc8_j1850 in byte 7 and counter in bits 48..51 put right"),
    ],
)  # fmt: skip
def test_triggers_reports_and_repairs_are_said_in_words(more: str, words: str) -> None:
    """What starts it, what it says on the bus, what it puts right."""
    event = "{type: at, time: 1 s}"
    specs = read(a=injector(more=more), b=injector(event=event), c=injector(event=event))
    assert describe_injectors(specs, PLAN, 7 * SECOND)[0].endswith(words)


@pytest.mark.parametrize(
    ("effect", "more", "words"),
    [
        ("once", "", "in one frame, once a run;"),
        ("once", ", rearm: true", "in one frame, again and again;"),
        ("once", ", max_activations: 3", "in one frame, at most 3 times a run;"),
        ("constant_time, duration: 1 s", "", "for 1 s;"),
        ("constant_time, duration: 1 s", ", rearm: false", "for 1 s, once a run;"),
        ("constant_time, duration: 1 s", ", max_activations: 1", "for 1 s, once a run;"),
        ("constant_time, duration: 1 s", ", max_activations: 2", "for 1 s, at most 2 times a run;"),
    ],
)
def test_how_often_is_said_in_words_and_reaches_the_engine(effect: str, more: str, words: str) -> None:
    """`rearm`, `max_activations` override."""
    times = ", ".join(f"{number} s" for number in range(1, 12, 2))
    text = injector("{type: bias, value: 1 deg}", effect=f"{{type: {effect}}}", more=more,
                    event=f"{{type: at, times: [{times}]}}")  # fmt: skip
    specs = read(a=text)
    assert words in describe_injectors(specs, PLAN, 7 * SECOND)[0]
    one = build_injectors(specs, PLAN, 1, 0)[0]
    one.start(0)
    count = 0
    while one.next_ns < NEVER:
        now = one.next_ns
        one.open(now, "event")
        one.act(now, 1, Frame(0x185, bytes(8)), Tray())
        one.close(now + SECOND)
        count += 1
    most = {"once a": 1, "most 3": 3, "most 2": 2}
    assert count == next((number for word, number in most.items() if word in words), 6)


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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (injector("{type: drop}", TPDO1, "{type: at, time: 3 s}"),
         "TPDO1 of right_knee (0x185, to_controller) lost until the end of the run; starts at 3 s"),
        (injector("{type: drop, probability: 0.2}", "{bus: both, pdo: TPDO1}", "{type: at, times: [2 s, 1 s]}"),
         "TPDO1 of every joint (0x181..0x186, both ways) lost with probability 0.2 each, until the end of the run; "
         "starts at 1 s, 2 s"),
        (injector("{type: bias, value: 5 deg}", more=", enabled: false"),
         "(switched off): position of right_knee (0x185, to_controller) shifted by 5 deg until the end of the run; "
         "never starts"),
        (injector("{type: bit_flip}", event="{type: at, time: 50 ms}", effect="{type: once}", more=", from: power_up"),
         "has 1 random bit inverted (drawn anew for every frame) in one frame, once a run; "
         "starts at 50 ms after power-up"),
        (injector("{type: bit_flip, positions: [1, 2]}", event="{type: failure_probability, p: 1e-3, per: sync}"),
         "has bits 1, 2 inverted until the end of the run; starts with probability 0.001 per sync (0.5/s), activated "
         "in 97 % of the runs of 7 s"),
        (injector("{type: stuck_at_value, payload: 00 ff 00 00 00 00 00 00}", TPDO1),
         "replaced by 00 FF 00 00 00 00 00 00 until"),
    ],
)  # fmt: skip
def test_every_kind_of_injector_can_be_read_aloud(text: str, words: str) -> None:
    """What, where, how long, when."""
    (sentence,) = describe_injectors(read(a=text), PLAN, 7 * SECOND)
    assert words in sentence


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (injector(event="{type: at, time: .inf}"), "a.event.time"),
        (injector(event="{type: at, times: .nan}"), "a.event.times"),
        (injector("{type: noise, uniform: .inf}"), "a.fault.uniform"),
    ],
)
def test_a_value_that_is_no_number_is_not_called_missing_as_well(text: str, key: str) -> None:
    """One mistake, one complaint: not also "give time (one) or times"."""
    (said,) = complaints(a=text)
    assert said.startswith(f"{key}: .")
    assert said.endswith(" is not a finite number")


def test_building_what_was_never_checked_is_refused() -> None:
    """A plan of another rig: the message names injector and key."""
    specs = read(a=injector())
    plan = BusPlan((JointNode("left_knee", 1, 54_900, 131_072),))
    with pytest.raises(FaultError, match=r"injectors\.a\.target\.node: unknown joint 'right_knee'"):
        build_injectors(specs, plan, 0, 0)
