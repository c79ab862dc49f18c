"""Two buses with controller, gateway and six drives, without plant and control law; every type of injector in text."""

import random
import struct
from typing import Final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, Node, Out
from canopen_exo.bus.wire import Wire
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import validate
from fi_gateway.gateway import Gateway
from fi_gateway.marked_yaml import parse
from fi_gateway.replay import Window
from fi_gateway.schema import InjectorSpec, build_injectors

NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))
CYCLE: Final = 2 * MS
END: Final = 40 * MS
FIRST: Final = 159_000
"""The first frame, a SYNC, is through: power-up."""

SIGNAL: Final = "{bus: to_controller, node: right_knee, signal: position}"
PDO: Final = "{bus: to_controller, node: right_knee, pdo: TPDO1}"
WIRED: Final = "{node: right_knee, pdo: TPDO1}"

FAULT_TEXTS: Final = (
    (SIGNAL, "{type: stuck_at}"), (PDO, "{type: stuck_at}"), (SIGNAL, "{type: stuck_at_value, value: 1 deg}"),
    (PDO, "{type: stuck_at_value, payload: '00 01 02 03 04 05 06 07'}"), (SIGNAL, "{type: package_drop, value: 0 deg}"),
    (SIGNAL, "{type: time_delay, lag: 5 ms}"), (SIGNAL, "{type: bias, value: 5 deg}"),
    (SIGNAL, "{type: gain, factor: -1.2}"), (SIGNAL, "{type: drift, slope: 9000 deg/s}"),
    (SIGNAL, "{type: noise, relative: 20 %}"), (SIGNAL, "{type: noise, uniform: 2 deg}"),
    (SIGNAL, "{type: noise, normal: 2 deg}"), (SIGNAL, "{type: bit_flip, count: 3}"),
    (PDO, "{type: bit_flip, count: 3, bits: fixed}"), (PDO, "{type: bit_flip, positions: [3, 31]}"),
    (SIGNAL, "{type: bit_stuck, positions: [1, 10], level: 1}"), (PDO, "{type: drop}"),
    (PDO, "{type: drop, probability: 50 %}"), (PDO, "{type: drop, p: 30 %, r: 30 %}"),
    (PDO, "{type: delay, time: 5 ms}"),
    (PDO, "{type: delay, law: {type: exponential, mean: 3 ms}, reorder: true}"),
    (PDO, "{type: resequence, span: 5 ms}"),
    (PDO, "{type: resequence, span: 5 ms, order: random}"), (PDO, "{type: duplicate, copies: 2, gap: 0.7 ms}"),
    (PDO, "{type: replay, frames: 3}"), (PDO, "{type: replay, frames: 3, mode: add}"),
    (PDO, "{type: insert, payload: '02 05', every: 1.3 ms}"), (PDO, "{type: masquerade, as: 0x186, copy: true}"),
    (PDO, "{type: corrupt_dlc}"), (WIRED, "{type: bit_error, field: data, bit: 3}"),
    (WIRED, "{type: bit_error, field: eof, bit: 5, receivers: [left_knee]}"), (WIRED, "{type: no_ack}"),
    ("{wire: drive}", "{type: stuck_dominant}"), ("{wire: controller}", "{type: bit_error_rate, rate: 1e-3}"),
    ("{}", "{type: bit_error_rate, rate: 1e-2, receivers: [left_hip]}"),
    ("{wire: drive}", "{type: gilbert_elliott, enter: 2e-3, leave: 1e-2, rate_bad: 10 %}"),
    ("{node: right_knee}", "{type: bus_off, restart: 1 ms}"), ("{wire: controller}", "{type: babbling_idiot}"),
)  # fmt: skip

EVENT_TEXTS: Final = (
    "{type: at, times: [3 ms, 21 ms]}", "{type: failure_probability, p: 0.1, per: 1 ms}",
    "{type: failure_probability, p: 0.2, per: frame}", "{type: rate, lambda: 60 1/s}",
    "{type: mttf, mean: 9 ms, sd: 4 ms}", "{type: distribution, law: {type: weibull, shape: 1.5, scale: 9 ms}}",
    "{type: distribution, law: {type: poisson, mean: 3, period: 3 ms}}",
    "{type: distribution, law: {type: curve, points: [[1 ms, 0], [5 ms, 2], [20 ms, 0]]}}", "{type: every, n: 4}",
    "{type: gait_phase, phase: 40 %}", "{type: when, condition: right_knee.position < 0 deg}", "{type: never}",
)  # fmt: skip

EFFECT_TEXTS: Final = (
    "{type: once}", "{type: frames, n: 3}", "{type: constant_time, duration: 4.1 ms}", "{type: infinite}",
    "{type: mttr, mean: 5 ms, sd: 2 ms}", "{type: distribution, law: {type: binomial, n: 5, p: 0.4, period: 1 ms}}",
    "{type: until, condition: right_knee.position > 0 deg}",
)  # fmt: skip

STARTER: Final = (
    "starter: {target: {bus: to_drives, kind: sync}, fault: {type: delay, time: 0.1 ms}, event: "
    "{type: failure_probability, p: 0.1, per: 1 ms}, effect: {type: frames, n: 2}, from: power_up}"
)


class Sender(Node):
    """Sends rows (time, port, frame), and writes down what it hears."""

    def __init__(self, rows: list[tuple[int, int, Frame]]) -> None:
        super().__init__()
        self.rows = rows
        self.heard: list[tuple[int, int, Frame]] = []
        self.wake_at = rows[0][0]

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        self.heard.append((now, port, frame))

    def wake(self, now: int, out: Out) -> None:
        while self.rows and self.rows[0][0] <= now:
            _, port, frame = self.rows.pop(0)
            out.send(port, frame)
        self.wake_at = self.rows[0][0] if self.rows else NEVER


class Bench:
    """Controller, gateway and six drives on two buses; a Wire on each where there is a fault for it."""

    def __init__(self, text: str, seed: int, recorded: dict[str, tuple[Window, ...]] | None = None) -> None:
        document = parse(text, "copied.yaml")
        assert isinstance(document.data, dict)
        specs = {}
        for name, given_spec in document.data.items():
            spec = validate(InjectorSpec, given_spec, (name,), document)
            document.raise_problems()
            assert spec is not None
            specs[name] = spec
        injectors = build_injectors(specs, PLAN, seed, 0, recorded)
        self.gateway = Gateway(injectors, CYCLE)
        self.media = [Medium("controller", 0, 1_000_000), Medium("drive", 1, 1_000_000)]
        self.loop = Loop(self.media)
        self.nodes = [Sender(commands(seed)), Sender(answers(seed))]
        self.loop.connect(self.nodes[0], self.media[:1])
        self.loop.connect(self.gateway, self.media)
        self.loop.connect(self.nodes[1], self.media[1:] * 6)
        for medium in self.media:
            self.gateway.join(medium)
            faults = [one.wire for one in injectors if one.wire is not None and one.wire.bus == medium.name]
            for fault in faults:
                fault.connect(self.loop, medium)
            wire = Wire(medium, [])
            if faults:
                self.loop.install(wire, medium)
            for fault in faults:
                fault.install(wire)

    def state(self, since_ns: int) -> list[object]:
        """Everything that shows, of the trace what came after `since_ns`."""
        rows = [(row.end_ns, row.bus, row.sender, row.frame) for row in self.loop.trace if row.end_ns > since_ns]
        names = list(vars(self.gateway.records[0])) if self.gateway.records else []
        records = [tuple(getattr(one, name) for name in names) for one in self.gateway.records]
        counts = [
            (medium.errors, [(port.tec, port.rec, port.state, port.lost) for port in medium.ports])
            for medium in self.media
        ]
        return [rows, records, counts, self.gateway.lost, self.gateway.waiting, [node.heard for node in self.nodes]]


def commands(seed: int) -> list[tuple[int, int, Frame]]:
    """SYNC, status from the third cycle on, set-points."""
    chance = random.Random(seed)
    rows = []
    for cycle in range(END // CYCLE):
        at = cycle * CYCLE + 100_000
        rows.append((at, 0, Frame(0x080, bytes((cycle % 240 + 1,)))))
        if cycle >= 3 and cycle % 3 == 0:
            phase = (cycle - 3) * 6000 & 0xFFFF
            rows.append((at + 60_000, 0, Frame(0x2FF, struct.pack("<BHH", 2, cycle - 3, phase))))
        rows.append((at + 900_000, 0, Frame(0x205, struct.pack("<Hh", 15, chance.randint(-900, 900)))))
    return rows


def answers(seed: int) -> list[tuple[int, int, Frame]]:
    """Positions that go up and down, of all drives at once."""
    chance = random.Random(seed + 1)
    rows = []
    for cycle in range(END // CYCLE):
        for node in range(1, 7):
            data = struct.pack("<ii", chance.randint(-20_000, 20_000), chance.randint(-9_000, 9_000))
            rows.append((cycle * CYCLE + 300_000, node - 1, Frame(0x180 + node, data)))
    return rows


def text_of(target: str, fault: str, event: str, effect: str) -> str:
    """Two injectors: one that starts others, and one with this fault, also started by it."""
    if "per: frame" in event and "pdo" not in target and "signal" not in target:
        event = EVENT_TEXTS[1]
    if "every" in event and "pdo" not in target and "signal" not in target:
        event = EVENT_TEXTS[0]
    trigger = "trigger: {any: [starter], on: manifested, delay: 1.1 ms, probability: 60 %}"
    return f"{STARTER}\none: {{target: {target}, fault: {fault}, event: {event}, effect: {effect}, {trigger}}}\n"
