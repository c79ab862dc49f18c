"""Any mix of injectors, recorded and replayed, sends the same frames at the same times."""

import random
import struct
from typing import Final

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER, Out
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import validate
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.marked_yaml import parse
from fi_gateway.replay import Window
from fi_gateway.schema import InjectorSpec, build_injectors

NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))
CYCLE: Final = 2 * MS
CYCLES: Final = 40
ZERO: Final = 3 * CYCLE
INJECTORS: Final = ("a", "b", "c", "d")

SIGNAL: Final = "{bus: to_controller, node: right_knee, signal: position}"
FRAME: Final = "{bus: to_controller, node: right_knee, pdo: TPDO1}"
DOWN: Final = "{bus: to_drives, node: right_knee, pdo: RPDO1}"
MANY: Final = "{bus: both, cob_id: 0x180/0x780}"

ON_SIGNALS: Final = (
    "{type: stuck_at}", "{type: bias, value: 5 deg}", "{type: drift, slope: 900 deg/s}",
    "{type: noise, uniform: 2 deg}", "{type: bit_flip, count: 3}", "{type: bit_flip, count: 2, bits: fixed}",
    "{type: time_delay, lag: 3 ms}",
)  # fmt: skip
CLOCKED: Final = "{type: insert, cob_id: 0x185, payload: '01 02 03 04 05 06 07 08', every: 3 ms}"
ADDING: Final = (
    "{type: duplicate}", "{type: insert, payload: '01 02 03 04 05 06 07 08'}",
    "{type: masquerade, as: 0x186, copy: true}",
)  # fmt: skip
ON_FRAMES: Final = (
    "{type: drop, probability: 40 %}", "{type: drop, p: 20 %, r: 30 %}", "{type: delay, time: 1.5 ms}",
    "{type: delay, time: 1 ms, law: {type: exponential, mean: 2 ms}, reorder: true}", ADDING[0],
    "{type: duplicate, copies: 2, gap: 0.7 ms}", "{type: replay, frames: 2}", "{type: resequence, span: 5 ms}",
    CLOCKED, ADDING[1], "{type: corrupt_dlc}", "{type: bit_flip, count: 2}",
    ADDING[-1], "{type: stuck_at}",
)  # fmt: skip
EVENTS: Final = (
    "{type: at, times: [4 ms, 21 ms]}", "{type: failure_probability, p: 0.1, per: 1 ms}",
    "{type: failure_probability, p: 0.1, per: frame}", "{type: every, n: 2}", "{type: every, n: 5}",
    "{type: when, condition: right_knee.position < 0 deg}", "{type: rate, lambda: 60 1/s}", "{type: never}",
    "{type: when, condition: right_knee.target_torque > 0 N m, edge: level}",
)  # fmt: skip
UNTIL: Final = "{type: until, condition: right_knee.position > 0 deg}"
EFFECTS: Final = (
    "{type: once}", "{type: frames, n: 3}", "{type: constant_time, duration: 4 ms}", "{type: infinite}",
    "{type: mttr, mean: 5 ms, sd: 2 ms}", UNTIL,
)  # fmt: skip


class Sink(Out):
    """Keeps what goes out, and when."""

    def __init__(self) -> None:
        self.now = 0
        self.sent: list[tuple[int, int, int, bytes, int]] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append((self.now, port, frame.can_id, frame.data, frame.dlc))


@st.composite
def mixes(draw: st.DrawFn) -> str:
    """The injectors of a file: any target, fault, event and effect, triggers without circles in any written order.

    Without what fi_gateway.replay leaves out: several frames in one instant.
    """
    names = INJECTORS[: draw(st.integers(1, 4))]
    ranks = draw(st.permutations(names))
    lines = []
    for name in names:
        target = draw(st.sampled_from((SIGNAL, FRAME, FRAME, DOWN, MANY)))
        fault = draw(st.sampled_from(ON_SIGNALS if target == SIGNAL else ON_FRAMES))
        if "insert" in fault and target == MANY:  # a frame nobody sent needs one direction, and one COB-ID
            target = FRAME
        event, effect = draw(st.sampled_from(EVENTS)), draw(st.sampled_from(EFFECTS))
        text = f"{name}: {{target: {target}, fault: {fault}, event: {event}, effect: {effect}"
        sources = ranks[: ranks.index(name)]
        if draw(st.booleans()) and sources:
            chosen = draw(st.lists(st.sampled_from(sources), min_size=1, unique=True))
            on = draw(st.sampled_from(("activated", "manifested", "ended")))
            key = draw(st.sampled_from(("any", "all")))
            rest = draw(st.sampled_from(("", ", delay: 1.2 ms", ", probability: 50 %", ", edge: level")))
            text += f", trigger: {{{key}: [{', '.join(chosen)}], on: {on}{rest}}}"
        if draw(st.integers(0, 3)) == 0:
            text += ", report: {frame: {cob_id: 0x6F0, data: '01'}, on: manifested}"
        lines.append(text + "}")
    text = "\n".join(lines)
    if CLOCKED in text:
        for other in ADDING:
            text = text.replace(other, "{type: corrupt_dlc}")
    if MANY in text or "resequence" in text or "insert" in text:  # several frames in one instant
        text = text.replace(UNTIL, "{type: infinite}")
    return text


def specs(text: str) -> dict[str, InjectorSpec]:
    document = parse(text, "mix.yaml")
    assert isinstance(document.data, dict)
    found = {name: validate(InjectorSpec, given, (name,), document) for name, given in document.data.items()}
    document.raise_problems()
    return {name: spec for name, spec in found.items() if spec is not None}


def traffic(seed: int) -> list[tuple[int, int, Frame]]:
    """Time, port, frame: SYNC, status, positions that go up and down, torques; some on both sides at one instant."""
    chance = random.Random(seed)
    rows: list[tuple[int, int, Frame]] = []
    for cycle in range(CYCLES):
        at = cycle * CYCLE
        rows.append((at, CONTROLLER_PORT, Frame(0x080, bytes((cycle % 240 + 1,)))))
        if cycle >= 3 and (cycle - 3) % 10 == 0:
            rows.append((at + 60_000, CONTROLLER_PORT, Frame(0x2FF, bytes((2, cycle - 3, 0, 0, 0)))))
        for node in (4, 5, 6):
            data = struct.pack("<ii", chance.randint(-20_000, 20_000), chance.randint(-9_000, 9_000))
            rows.append((at + node * 100_000, DRIVE_PORT, Frame(0x180 + node, data)))
            torque = struct.pack("<Hh", 15, chance.randint(-900, 900))
            rows.append((at + chance.choice((5, 9, 10)) * 100_000, CONTROLLER_PORT, Frame(0x200 + node, torque)))
    return sorted(rows, key=lambda row: row[:2])


def walk(gateway: Gateway, seed: int) -> Sink:
    """All of the traffic, frames before wake-ups at one instant; closed at its end."""
    sink, end = Sink(), CYCLES * CYCLE
    for now, port, frame in [*traffic(seed), (end, CONTROLLER_PORT, Frame(0x080, b"\x01"))]:
        while gateway.wake_at < now:
            sink.now = gateway.wake_at
            gateway.wake(gateway.wake_at, sink)
        sink.now = now
        gateway.receive(now, port, frame, sink)
    gateway.finish(end + 1)
    return sink


@pytest.mark.long
@settings(max_examples=150, deadline=None)
@given(mixes(), st.integers(0, 1000))
def test_a_replay_sends_the_same_frames_at_the_same_times(text: str, seed: int) -> None:
    """results.md: on the same version the frames are the same again, whatever had started and ended the windows."""
    injectors = specs(text)
    gateway = Gateway(build_injectors(injectors, PLAN, seed, 0), CYCLE)
    sent = on_wire(walk(gateway, seed))
    windows: dict[str, tuple[Window, ...]] = {}
    for one in gateway.records:
        end_ns = NEVER if one.end_ns >= NEVER else one.end_ns - ZERO
        window = Window(one.start_ns - ZERO, end_ns, one.stream, one.skipped)
        windows[one.injector] = (*windows.get(one.injector, ()), window)
    again = Gateway(build_injectors(injectors, PLAN, seed, 0, windows), CYCLE)
    assert on_wire(walk(again, seed)) == sent
    assert counts(again) == counts(gateway)


def on_wire(sink: Sink) -> list[tuple[int, int, int, bytes, int]]:
    """As a transmit queue orders it: of one instant the lowest id first, those of one id as they came."""
    return sorted(sink.sent, key=lambda row: row[:3])


def counts(gateway: Gateway) -> list[tuple[object, ...]]:
    """What the activations that met a frame, or could have, did."""
    return sorted(
        (one.injector, one.start_ns, one.end_ns, one.frames_injected, one.manifested, one.first_ns)
        for one in gateway.records
        if one.end_ns > one.start_ns
    )
