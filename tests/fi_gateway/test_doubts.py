"""`exo-hil check` warns of what is allowed and looks like a mistake: injectors that can never act, or do nothing."""

from typing import Final

import pytest

from fi_gateway.doubts import injector_warnings
from tests.fi_gateway.injector_texts import PLAN, SECOND, TPDO1, injector, read


@pytest.mark.parametrize(
    ("specs", "words"),
    [
        ({"a": injector()}, ["a: will stay silent: its event never happens and it has no trigger"]),
        ({"a": injector(), "b": injector(more=", trigger: {any: [a]}")}, ["a: will", "b: will stay silent"]),
        ({"a": injector(event="{type: failure_probability, p: 0, per: 1 s}")},
         ["a: will stay silent: its event never happens (p is 0) and it has no trigger"]),
        ({"a": injector(event="{type: failure_probability, p: 0, per: frame}")}, ["a: will stay silent"]),
        ({"a": injector(event="{type: when, condition: right_knee.torque > 1799 N m}")},
         ["a: will stay silent: its event never happens (its signals never reach right_knee.torque > 1799 N m)"]),
        ({"a": injector(event="{type: when, condition: right_knee.torque > 1798 N m}")}, []),
        ({"a": injector(event="{type: mttf, mean: 1 h, sd: 60 s}")},
         ["a.event: comes in fewer than 1 % of the runs of 7 s"]),
        ({"a": injector(event="{type: mttf, mean: 1 h, sd: 60 s}", more=", from: power_up")}, []),
        ({"a": injector(event="{type: rate, lambda: 1/h}")}, ["a.event: comes in fewer than 1 % of the runs"]),
        ({"a": injector(event="{type: every, n: 3501}")}, ["a.event: comes in fewer than 1 % of the runs"]),
        ({"a": injector(event="{type: every, n: 3500}")}, []),
        ({"a": injector(event="{type: gait_phase, phase: 0}",
                        effect="{type: until, condition: right_hip.torque > 9000 N m}")},
         ["a.effect: lasts until the end of the run: its signals never reach right_hip.torque > 9000 N m"]),
        ({"a": injector(event="{type: at, time: 7 s}")}, ["a.event: 7 s comes after the motion has ended at 7 s"]),
        ({"a": injector(event="{type: at, time: 6.999999999 s}")}, []),
        ({"a": injector(event="{type: at, times: [1 s, 9 s]}")}, ["a.event: 9 s comes after"]),
        ({"a": injector(event="{type: at, time: 9 s}", more=", from: power_up")}, []),
        ({"a": injector(more=", enabled: false")}, []),
        ({"a": injector(event="{type: at, time: 1 s}"), "b": injector(more=", trigger: {any: [a]}")}, []),
        ({"a": injector(event="{type: at, time: 1 s}", more=", enabled: false"),
          "b": injector(more=", trigger: {any: [a]}")}, ["b: will stay silent"]),
        ({"a": injector("{type: drop}", "{bus: both, cob_id: 0x123}", "{type: at, time: 1 s}")},
         ["a.target.cob_id: nothing in this rig sends 0x123"]),
        ({"a": injector(event="{type: at, time: 1 s}"), "b": injector(),
          "c": injector(more=", trigger: {all: [a, b]}")}, ["b: will stay silent", "c: will stay silent"]),
        ({"a": injector(event="{type: at, time: 1 s}"), "b": injector(more=", trigger: {any: [a], probability: 0}")},
         ["b: will stay silent"]),
        ({"a": injector(more=", trigger: {frame: {cob_id: 0x6F0}}")}, []),
    ],
)  # fmt: skip
def test_injectors_that_can_never_act_are_warned_about(specs: dict[str, str], words: list[str]) -> None:
    """Allowed, but silent: said once each."""
    warnings = injector_warnings(read(**specs), PLAN, 7 * SECOND)
    assert len(warnings) == len(words)
    assert all(f"injectors.{word}" in warning for word, warning in zip(words, warnings, strict=True))


@pytest.mark.parametrize(
    ("fault", "effect", "warned"),
    [
        ("{type: bias, value: 0 deg}", "{type: once}", ["a.fault: changes nothing: value is 0"]),
        ("{type: gain, factor: 100 %}", "{type: once}", ["a.fault: changes nothing: factor is 1"]),
        ("{type: drift, slope: 0 deg/s}", "{type: once}", ["a.fault: changes nothing: slope is 0"]),
        ("{type: bias, value: 0.1 deg}", "{type: once}", []),
        (
            "{type: bias, value: 1 deg}",
            "{type: constant_time, duration: 100 us}",
            ["a.effect: 100 us is less than the 2 ms between two frames of the target, so that a window may meet none"],
        ),
        ("{type: bias, value: 1 deg}", "{type: constant_time, duration: 2 ms}", []),
    ],
)
def test_what_changes_nothing_or_may_meet_nothing_is_warned_of(fault: str, effect: str, warned: list[str]) -> None:
    """`exo-hil check` warns of silent injectors, and of windows that fit between two frames."""
    specs = read(a=injector(fault, event="{type: at, time: 1 s}", effect=effect))
    assert injector_warnings(specs, PLAN, 7 * SECOND) == [f"injectors.{text}" for text in warned]


@pytest.mark.parametrize("fault", ["{type: drop, probability: 0 %}", "{type: drop, p: 10 %, r: 10 %, loss_bad: 0 %}"])
def test_a_drop_that_loses_nothing_is_warned_of(fault: str) -> None:
    """As above, on frames."""
    specs = read(a=injector(fault, TPDO1, "{type: at, time: 1 s}", "{type: once}"))
    (warning,) = injector_warnings(specs, PLAN, 7 * SECOND)
    assert warning.startswith("injectors.a.fault: changes nothing: ")


def test_a_short_window_that_opens_with_a_frame_is_not_warned_of() -> None:
    """It meets that frame."""
    short = "{type: constant_time, duration: 100 us}"
    for event in ("{type: every, n: 3}", "{type: failure_probability, p: 1 %, per: frame}"):
        specs = read(a=injector("{type: bias, value: 1 deg}", event=event, effect=short))
        assert injector_warnings(specs, PLAN, 7 * SECOND) == []


AT: Final = "{type: at, time: 0 s}"
ANSWERS: Final = "{bus: to_controller, kind: sdo_answer}"
COMMANDS: Final = "{bus: to_drives, kind: nmt}"
TOO_LATE: Final = "the rig sends such frames before time 0 only; add from: power_up to meet them"


@pytest.mark.parametrize(
    ("text", "warned"),
    [
        (injector("{type: drop}", ANSWERS, AT), True),
        (injector("{type: drop}", "{bus: to_drives, kind: sdo_request, node: left_hip}", AT), True),
        (injector("{type: drop}", COMMANDS, "{type: every, n: 5}", "{type: once}"), True),
        (injector("{type: drop}", "{bus: to_controller, cob_id: 0x580/0x780}", AT), True),
        (injector("{type: no_ack}", "{kind: sdo_request}", AT), True),
        (injector("{type: insert, payload: '02 00'}", COMMANDS, AT), True),
        (injector("{type: insert, payload: '02 00', every: 10 ms}", COMMANDS, AT), False),
        (injector("{type: drop}", ANSWERS, AT, more=", from: power_up"), False),
        (injector("{type: drop}", ANSWERS, AT, more=", enabled: false"), False),
        (injector("{type: drop}", "{bus: to_controller, kind: emcy}", AT), False),
        (injector("{type: drop}", "{bus: to_drives, kind: sync}", AT), False),
        (injector("{type: drop}", "{bus: both, cob_id: 0x000/0x000}", AT), False),
        (injector("{type: stuck_dominant}", "{wire: drive}", AT), False),
    ],
)
def test_what_waits_in_the_motion_for_frames_of_the_start_is_warned_of(text: str, warned: bool) -> None:
    """NMT commands and SDOs come before time 0: the remedy is to count from power-up. By hand, anything may come."""
    specs = read(a=text)
    assert injector_warnings(specs, PLAN, 7 * SECOND) == ([f"injectors.a.target: {TOO_LATE}"] if warned else [])
    assert injector_warnings(specs, PLAN, 7 * SECOND, by_hand=True) == []


ONCE: Final = "{type: once}"
SHIFT: Final = "{type: bias, value: 1 deg}"
FOREVER: Final = "{type: until, condition: right_knee.torque > 9000 N m}"


@pytest.mark.parametrize(
    ("source", "trigger", "words"),
    [
        (injector(SHIFT, event=AT), "any: [a], on: ended", ["a never ends (its effect is infinite)"]),
        (injector(SHIFT, event=AT), "all: [a, other], on: ended", ["a never ends (its effect is infinite)"]),
        (injector(SHIFT, event=AT), "any: [a], on: ended, edge: level", ["a never ends (its effect is infinite)"]),
        (injector("{type: gain, factor: 1}", event=AT, effect=ONCE), "any: [a], on: manifested",
         ["a never manifests (factor is 1)"]),
        (injector(SHIFT, event=AT), "any: [a], on: manifested", []),
        (injector(SHIFT, event=AT), "any: [a]", []),
        (injector(SHIFT, event=AT, effect=ONCE), "any: [a], on: ended", []),
        (injector("{type: gain, factor: 1}", event=AT, effect=ONCE), "any: [a], on: ended", []),
    ],
)  # fmt: skip
def test_a_trigger_on_what_its_source_never_does_is_warned_of(source: str, trigger: str, words: list[str]) -> None:
    """An infinite effect never ends, a fault that changes nothing never manifests; what follows stays silent too."""
    other = injector(SHIFT, event=AT, effect=ONCE)
    specs = {"a": source, "other": other, "b": injector(SHIFT, effect=ONCE, more=f", trigger: {{{trigger}}}")}
    specs["c"] = injector(SHIFT, effect=ONCE, more=", trigger: {any: [b]}")
    warnings = [text for text in injector_warnings(read(**specs), PLAN, 7 * SECOND) if "injectors.a." not in text]
    silent = [f"injectors.b: will stay silent: its event never happens and {text}" for text in words]
    more = ["injectors.c: will stay silent: its event never happens and nothing that triggers it can start"]
    assert warnings == (silent + more if words else [])


def test_a_trigger_that_never_fires_is_warned_of_beside_what_does_start_the_injector() -> None:
    """Its own event, or another source; by hand every window can be ended."""
    forever = injector(SHIFT, event=AT, effect=FOREVER)
    specs = read(
        a=forever,
        other=injector(SHIFT, event=AT, effect=ONCE),
        b=injector(SHIFT, event=AT, effect=ONCE, more=", trigger: {any: [a], on: ended}"),
        c=injector(SHIFT, effect=ONCE, more=", trigger: {any: [a, other], on: ended}"),
    )
    endless = "lasts until the end of the run: its signals never reach right_knee.torque > 9000 N m"
    doubts = [f"injectors.{name}.trigger: a never ends ({endless})" for name in ("b", "c")]
    assert injector_warnings(specs, PLAN, 7 * SECOND) == [f"injectors.a.effect: {endless}", *doubts]
    assert not any(".trigger" in text for text in injector_warnings(specs, PLAN, 7 * SECOND, by_hand=True))


@pytest.mark.parametrize(("phase", "warned"), [("90 %", True), ("66 %", False), ("0 %", False), ("66.7 %", True)])
def test_a_phase_of_the_gait_beyond_a_short_motion_is_warned_of(phase: str, warned: bool) -> None:
    """1 s is two thirds of a stride of 1.5 s; without a stride nobody can tell."""
    specs = read(a=injector(SHIFT, event=f"{{type: gait_phase, phase: {phase}}}", effect=ONCE))
    text = "injectors.a.event: comes in fewer than 1 % of the runs of 1 s"
    assert injector_warnings(specs, PLAN, SECOND, stride_ns=3 * SECOND // 2) == ([text] if warned else [])
    assert injector_warnings(specs, PLAN, SECOND) == []


def test_a_condition_that_contradicts_itself_is_warned_of() -> None:
    """It never holds, whatever comes."""
    never = "right_knee.position < -60 deg and right_knee.position > 0 deg"
    (warning,) = injector_warnings(read(a=injector(SHIFT, event=f"{{type: when, condition: {never}}}")), PLAN, SECOND)
    assert warning.startswith(
        f"injectors.a: will stay silent: its event never happens (its signals never reach {never}"
    )
