"""Events and effects of a scenario file in a gateway, frame by frame: which frames are met, and which are not."""

import copy
import struct
from math import floor
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, Out
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import validate
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.marked_yaml import parse
from fi_gateway.schema import InjectorSpec, build_injectors

NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))
KNEE: Final = 0x185
CYCLE: Final = 2 * MS
STRIDE: Final = 100  # cycles
TARGET: Final = "{bus: to_controller, node: right_knee, signal: velocity}"


class Sink(Out):
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[Frame] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append(frame)


def gateway(event: str, effect: str, before: str = "") -> Gateway:
    """Velocity of the right knee reads 1 while the injector x is active. before: further injectors, in front of it."""
    text = f"x: {{target: {TARGET}, fault: {{type: bias, value: 1 counts/s}}, event: {event}, effect: {effect}}}\n"
    document = parse(before + text, "s.yaml")
    assert isinstance(document.data, dict)
    specs = {}
    for name, found in document.data.items():
        spec = validate(InjectorSpec, found, (name,), document)
        document.raise_problems()
        assert spec is not None
        specs[name] = spec
    return Gateway(build_injectors(specs, PLAN, 1, 0), CYCLE)


def pass_on(node: Gateway, now: int, port: int, frame: Frame) -> Frame | None:
    """The last of what comes out for it."""
    sink = Sink()
    while node.wake_at < now:
        node.wake(node.wake_at, sink)
    node.receive(now, port, frame, sink)
    return sink.sent[-1] if sink.sent else None


def cycle_of(node: Gateway, number: int, position: int = 0) -> bool:
    """One control cycle from time 0 on; whether the knee's velocity has been changed."""
    now = (1000 + number) * CYCLE
    pass_on(node, now, CONTROLLER_PORT, Frame(0x080, b"\x01"))
    if number % 10 == 0:
        state, phase = 2 if number >= 0 else 1, floor(number % STRIDE / STRIDE * 65536)
        pass_on(node, now + 100_000, CONTROLLER_PORT, Frame(0x2FF, struct.pack("<BHH", state, max(0, number), phase)))
    out = pass_on(node, now + 500_000, DRIVE_PORT, Frame(KNEE, struct.pack("<ii", position, 0)))
    assert out is not None
    changed: int = struct.unpack("<ii", out.data)[1]
    return changed == 1


def met(node: Gateway, positions: list[int], first: int = -20) -> list[int]:
    """The cycles whose frame was changed. positions: of the knee from time 0 on, counts; before it 0."""
    found = [number for number in range(first, 0) if cycle_of(node, number)]
    return found + [number for number, position in enumerate(positions) if cycle_of(node, number, position)]


BELOW: Final = "condition: right_knee.position < 0 counts"


def test_a_condition_meets_the_frame_that_makes_it_true_and_until_spares_the_one_that_ends_it() -> None:
    """when and until: window [t0, t0 + D) on the frame's arrival; the same frame carries condition and target."""
    positions = [5, -1, -1, 3, -9, 0, -2, -2]
    until = "{type: until, condition: right_knee.position >= 0 counts}"
    assert met(gateway(f"{{type: when, {BELOW}}}", until), positions) == [1, 2, 4, 6, 7]


def test_a_rising_condition_comes_once_and_a_level_again() -> None:
    """edge: rising | level, with a window of one frame."""
    positions = [5, -1, -1, -1, 3, -9, -9]
    once_each = "{type: frames, n: 1}"
    assert met(gateway(f"{{type: when, {BELOW}}}", once_each), positions) == [1, 5]
    assert met(gateway(f"{{type: when, {BELOW}, edge: level}}", once_each), positions) == [1, 2, 3, 5, 6]
    assert met(gateway(f"{{type: when, {BELOW}, edge: level}}", "{type: once}"), positions) == [1]


def test_what_is_true_at_time_0_starts_with_the_first_frame_after_it() -> None:
    """No frame before time 0 is met."""
    assert met(
        gateway("{type: when, condition: right_knee.position == 0 counts}", "{type: frames, n: 2}"), [0] * 5
    ) == [0, 1]


def test_a_condition_looks_at_frames_as_they_came_in() -> None:
    """Before any fault: an injector in front that changes the position changes no condition."""
    front = (
        "front: {target: {bus: to_controller, node: right_knee, signal: position}, "
        "fault: {type: bias, value: -100 counts}, event: {type: at, time: 0 s}, effect: {type: infinite}}\n"
    )
    assert met(gateway(f"{{type: when, {BELOW}}}", "{type: frames, n: 1}", front), [5, 5, -1, 5]) == [2]


def test_a_condition_may_be_over_the_frames_of_services() -> None:
    """The EMCY of a drive, from its side alone; state and phase of the controller's status frame."""
    emcy, gone = Frame(0x085, bytes.fromhex("3082010000000000")), Frame(0x085, bytes(8))
    event, until = (f"condition: right_knee_EMCY.emcy_error_code {sign} 0" for sign in ("!=", "=="))
    node, changed = gateway(f"{{type: when, {event}}}", f"{{type: until, {until}}}"), []
    sent = {2: (CONTROLLER_PORT, emcy), 4: (DRIVE_PORT, emcy), 7: (CONTROLLER_PORT, gone), 9: (DRIVE_PORT, gone)}
    for number in range(12):
        if cycle_of(node, number):
            changed.append(number)
        if number in sent:
            pass_on(node, (1000 + number) * CYCLE + 900_000, *sent[number])
    assert changed == [5, 6, 7, 8, 9]
    quarter = "HLC_status.state == 2 and HLC_status.phase >= 15 % and HLC_status.phase < 0.35 stride"
    found = met(gateway(f"{{type: when, condition: {quarter}, edge: level}}", "{type: frames, n: 1}"), [0] * 130)
    assert found == [20, 30, 120]


def test_every_nth_frame_is_met_from_time_0_on() -> None:
    """every {n} frames: the n-th itself is met; frames before time 0 do not count."""
    assert met(gateway("{type: every, n: 3}", "{type: frames, n: 1}"), [0] * 10) == [2, 5, 8]
    assert met(gateway("{type: every, n: 3}", "{type: constant_time, duration: 7 ms}"), [0] * 10) == [2, 3, 4, 5, 8, 9]


def test_a_trial_meets_its_own_frame() -> None:
    """failure_probability per frame: p = 1 meets every frame from time 0."""
    assert met(gateway("{type: failure_probability, p: 1, per: frame}", "{type: frames, n: 1}"), [0] * 4) == [
        0,
        1,
        2,
        3,
    ]
    assert met(gateway("{type: failure_probability, p: 0, per: frame}", "{type: frames, n: 1}"), [0] * 99) == []


@pytest.mark.parametrize(("phase", "cycles"), [("0 %", [0, 100, 200]), ("25 %", [25, 125, 225]), ("99 %", [99, 199])])
def test_a_gait_phase_meets_the_samples_of_its_cycle(phase: str, cycles: list[int]) -> None:
    """gait_phase: from status frame and SYNC only; the samples that answer that SYNC are the first ones met."""
    found = met(gateway(f"{{type: gait_phase, phase: {phase}}}", "{type: frames, n: 1}"), [0] * 250)
    assert found == cycles


PAIRS: Final = (
    ("{type: failure_probability, p: 0.1, per: 1 ms}", "{type: mttr, mean: 5 ms, sd: 5 ms}"),
    ("{type: failure_probability, p: 0.2, per: frame}", "{type: frames, n: 2}"),
    ("{type: rate, lambda: 90/s}", "{type: distribution, law: {type: gamma, shape: 2, scale: 2 ms}}"),
    ("{type: distribution, law: {type: poisson, mean: 3, period: 4 ms}}", "{type: constant_time, duration: 3 ms}"),
    ("{type: every, n: 4}", "{type: distribution, law: {type: binomial, n: 4, p: 0.5, period: 3 ms}}"),
    (f"{{type: when, {BELOW}}}", "{type: until, condition: right_knee.position > 3 counts}"),
    ("{type: gait_phase, phase: 0.3}", "{type: distribution, law: {type: weibull, shape: 0.5, scale: 9 ms}}"),
)


@pytest.mark.long
@pytest.mark.parametrize(("event", "effect"), PAIRS)
@given(st.lists(st.integers(-5, 5), min_size=40, max_size=60), st.integers(0, 39))
def test_a_snapshot_goes_on_alike(event: str, effect: str, positions: list[int], taken: int) -> None:
    """One copy of gateway, injectors and generators, taken between frames, gives the same frames."""
    node = gateway(event, effect)
    assert met(node, []) == []
    for number, position in enumerate(positions[:taken]):
        cycle_of(node, number, position)
    copied = copy.deepcopy(node)
    rest = list(enumerate(positions))[taken:]
    assert [cycle_of(node, *one) for one in rest] == [cycle_of(copied, *one) for one in rest]
    assert [record.start_ns for record in node.records] == [record.start_ns for record in copied.records]


@pytest.mark.parametrize(("event", "effect"), [pair for pair in PAIRS if "frame" not in "".join(pair)][:3])
def test_bus_load_does_not_change_when_drawn_faults_happen(event: str, effect: str) -> None:
    """faults.md: per-period events are drawn once, never on frame arrival: ten times the frames, the same windows."""
    starts = []
    for more in (0, 9):
        node = gateway(event, effect)
        met(node, [])
        for number in range(200):
            cycle_of(node, number)
            for extra in range(more):
                pass_on(node, (1000 + number) * CYCLE + 600_000 + extra, DRIVE_PORT, Frame(KNEE, bytes(8)))
        starts.append([(record.start_ns, record.end_ns) for record in node.records])
    assert len(starts[0]) > 3
    assert starts[0] == starts[1]
