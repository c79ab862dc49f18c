"""`injectors:` in a file: every complaint at its place."""

import pytest

from tests.fi_gateway.injector_texts import POSITION, TPDO1, complaints, injector, read


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
