"""A lock-step run cut into the parts that its processes would have left, and what the timing says of parts."""

import numpy as np

from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER
from fi_gateway.injector import Injector
from fi_gateway.schema import build_injectors
from testbench.parts import GatewayPart, HlcPart, JointsPart, NotedEvent, Service, reach_of
from testbench.rig import CONTROLLER_BUS, DRIVE_BUS, Rig, build_rig
from testbench.run import drive_through, rig_params
from testbench.scenario import Scenario
from testbench.timing import Timing, judge_timing

SCENARIO = """\
name: parts
rig: {plant: suspended, stops: off, rate: 100 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 1 s}
injectors:
  bias:
    target: {bus: to_controller, node: right_knee, signal: position}
    fault: {type: bias, value: 0.05 rad}
    event: {type: at, time: 0.3 s}
    effect: {type: constant_time, duration: 0.2 s}
  lost:
    target: {bus: to_drives, node: left_hip, pdo: RPDO1}
    fault: {type: drop}
    event: {type: at, time: 0.6 s}
    effect: {type: constant_time, duration: 0.05 s}
"""

Parts = tuple[HlcPart, GatewayPart, JointsPart]


def service() -> Service:
    return Service(0, NEVER, Lateness(), {})


def seen_by(rig: Rig, bus: int, index: int, own: dict[int, int]) -> list[tuple[int, Transmission]]:
    """Rows of one bus as a process saw them. own: its senders on the medium -> the port it sent on."""
    return [
        (place, Transmission(row.end_ns, index, row.frame, own.get(row.sender, -1)))
        for place, row in enumerate(rig.loop.trace)
        if row.bus == bus
    ]


def parts_of(rig: Rig) -> Parts:
    """A lock-step run, as its processes would have left it."""
    controller, count = rig.controller, len(rig.rack.devices)
    table = {
        name: np.array([getattr(sample, name) for sample in controller.samples])
        for name in ("q_d", "dq_d", "tau_command")
    }
    truth = {name: np.array([getattr(row, name) for row in rig.rack.truth]) for name in ("q", "dq", "tau")}
    hlc = HlcPart(
        service(),
        controller.time_zero,
        controller.completed,
        list(controller.late),
        [NotedEvent(one.time_ns, one.joint, one.kind, one.text) for one in controller.events],
        np.array([sample.cycle for sample in controller.samples]),
        table["q_d"],
        table["dq_d"],
        table["tau_command"],
        [row for _, row in seen_by(rig, CONTROLLER_BUS, 0, {0: 0})],
    )
    gateway_rows = seen_by(rig, CONTROLLER_BUS, 0, {1: 0}) + seen_by(rig, DRIVE_BUS, 1, {0: 1})
    gateway = GatewayPart(
        service(),
        rig.gateway.time_zero,
        {one.name: reach_of(one) for one in rig.gateway.injectors},
        list(rig.gateway.frames),
        list(rig.gateway.lost),
        [Lateness(), Lateness()],
        rig.gateway.records,
        [],
        [row for _, row in sorted(gateway_rows, key=lambda pair: pair[0])],
    )
    joints = JointsPart(
        service(),
        np.array([row.time_ns for row in rig.rack.truth]),
        truth["q"],
        truth["dq"],
        truth["tau"],
        [row for _, row in seen_by(rig, DRIVE_BUS, 0, {port + 1: port for port in range(count)})],
    )
    return hlc, gateway, joints


def judged(scenario: Scenario, hlc: HlcPart | None, gateway: GatewayPart | None, joints: JointsPart | None) -> Timing:
    assert hlc is not None
    return judge_timing(scenario.plan, hlc.time_zero, hlc.cycles.size, hlc, gateway, joints)


def without(
    rows: list[Transmission], cob_id: int, span: range, *, own: bool = False, bus: int = -1
) -> list[Transmission]:
    """Rows that a process did not receive (own: did not send) in that span."""
    return [
        row
        for row in rows
        if row.frame.can_id != cob_id or (row.sender >= 0) != own or row.end_ns not in span or bus not in (-1, row.bus)
    ]


def delayed(rows: list[Transmission], start_ns: int, end_ns: int, by_ns: int, sent: bool | None) -> list[Transmission]:
    """Rows of a span moved later; sent: own ones only, or received ones only, None for both."""
    return [
        Transmission(
            row.end_ns + (by_ns if start_ns <= row.end_ns < end_ns and sent in (None, row.sender >= 0) else 0),
            row.bus,
            row.frame,
            row.sender,
        )
        for row in rows
    ]


CYCLE = 10 * MS


def walked(scenario: Scenario) -> Rig:
    """The lock-step run of a scenario, at its end."""
    injectors: list[Injector] = build_injectors(scenario.injectors, scenario.plan, scenario.seed, 0)
    made = build_rig(rig_params(scenario), injectors)
    drive_through(made, lambda share: None)
    return made
