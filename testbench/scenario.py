"""Scenario files: what is on the rig, how it moves, what is injected, and what is expected of it.

A file is read once, every complaint at once, into plain frozen data: times in ns, angles in rad. `resolved_yaml` writes
that data back as a file, defaults filled in, which reads as an equal scenario. A file of faults alone, for a gateway on
real buses, is testbench.fault_file's.
Left out: `rig: {file: ...}`, the walking plant, other motions than the recorded gait.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal, TypeAlias

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, PlainValidator, WithJsonSchema

from canopen_exo.bus.node import MS, SECOND
from canopen_exo.errors import CanopenExoError
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import Angle, Later, Share, Span, SpecModel, Text, Time, dump, json_schema, validate
from fi_gateway.doubts import injector_warnings
from fi_gateway.marked_yaml import Data, Document, apply_override, load, parse, write
from fi_gateway.quantity import describe_value, format_duration, format_hertz, parse_hertz
from fi_gateway.schema import InjectorSpec, check_injectors, describe_injectors
from hlc.limits import limits_of
from testbench.errors import BenchError
from testbench.expect import Expectation, parse_expectation

__all__ = [
    "JOINT_NAMES",
    "Cycle",
    "Expectation",
    "Motion",
    "Name",
    "Pins",
    "RealTime",
    "Rig",
    "Scenario",
    "Seed",
    "check_file_injectors",
    "check_rate",
    "default_joints",
    "describe",
    "load_scenario",
    "parse_scenario",
    "scenario_in",
    "scenario_schema",
]

JOINT_NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
"""Node ids 1..6 in this order."""

ENCODER_COUNTS: Final = 131_072
"""17 bits per joint revolution."""

PLANT_STEP_NS: Final = MS
MAX_CYCLE_NS: Final = 20 * MS
"""50 Hz: below, computed-torque control with one cycle of delay is no longer stable."""
STRIDE_RANGE_NS: Final = (SECOND // 2, 20 * SECOND)
MAX_DURATION_NS: Final = 3600 * SECOND
MAX_SEED: Final = 2**63 - 1
MAX_TOLERANCE_RAD: Final = math.pi / 2

_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", re.ASCII)


def default_joints() -> tuple[JointNode, ...]:
    """Six drives, node ids 1..6; rated torque as in table 1 of ESREL 2020 [mN m], 17-bit encoders."""
    return tuple(
        JointNode(name, number, round(1000 * limits_of(name).torque_nm), ENCODER_COUNTS)
        for number, name in enumerate(JOINT_NAMES, 1)
    )


def _name(given: object) -> str:
    if not isinstance(given, str) or not _NAME.fullmatch(given):
        raise ValueError(
            f"{describe_value(given)} is no name; allowed are letters, digits, _ and -, at most 64 "
            "(results are stored under it)"
        )
    return given


def _switch(given: object) -> bool:
    if given not in ("on", "off"):
        raise ValueError(f"expected on or off; got {describe_value(given)}")
    return given == "on"


def _cycle(given: object) -> int:
    """Control cycle [ns] of a rate."""
    hertz = parse_hertz(given)
    cycle = SECOND / hertz if hertz > 0 else Fraction(0)
    if cycle.denominator != 1 or cycle % PLANT_STEP_NS or not PLANT_STEP_NS <= cycle <= MAX_CYCLE_NS:
        raise ValueError(
            f"{given!r} is not a rate this rig can run at: a control cycle is a whole number of plant steps of 1 ms, "
            f"at most {MAX_CYCLE_NS // MS} ms; allowed: 500, 250, 200, 125, 100, 62.5 or 50 Hz"
        )
    return int(cycle)


def _rate(cycle_ns: int) -> str:
    return format_hertz(Fraction(SECOND, cycle_ns))


def _seed(given: object) -> int:
    if not isinstance(given, int) or isinstance(given, bool) or not 0 <= given <= MAX_SEED:
        raise ValueError(f"expected a whole number 0..{MAX_SEED}; got {describe_value(given)}")
    return given


def _stride(given: int) -> int:
    low, high = STRIDE_RANGE_NS
    if not low <= given <= high:
        raise ValueError(f"{format_duration(given)} given; allowed {format_duration(low)}..{format_duration(high)}")
    return given


def _motion_time(given: int) -> int:
    if given > MAX_DURATION_NS or given % PLANT_STEP_NS:
        longest = format_duration(MAX_DURATION_NS)
        raise ValueError(f"{format_duration(given)} given; allowed are whole milliseconds up to {longest}")
    return given


def _tolerance(given: float) -> float:
    if not 0 <= given <= MAX_TOLERANCE_RAD:
        raise ValueError(f"{given:.4g} rad given; allowed 0 deg..90 deg beyond the range of travel")
    return given


def _expectation(given: object) -> Expectation:
    return parse_expectation(given, JOINT_NAMES)


ExpectLine: TypeAlias = Annotated[
    Expectation,
    PlainValidator(_expectation),
    PlainSerializer(lambda expectation: expectation.text),
    WithJsonSchema({"type": "string", "examples": ["failures == 0"]}),
]
Pins: TypeAlias = Annotated[
    bool,
    PlainValidator(_switch),
    PlainSerializer(lambda on: "on" if on else "off"),
    WithJsonSchema({"enum": ["on", "off"]}),
]
Name: TypeAlias = Annotated[str, BeforeValidator(_name)]
Seed: TypeAlias = Annotated[int, BeforeValidator(_seed)]
Queues: TypeAlias = Literal["by_id", "fifo"]
Cycle: TypeAlias = Annotated[
    int,
    BeforeValidator(_cycle),
    PlainSerializer(_rate),
    WithJsonSchema({"type": "string", "examples": ["500 Hz"]}),
    Field(alias="rate", json_schema_extra={"default": "500 Hz"}),
]
"""Control cycle [ns], in a file the key `rate`."""


@dataclass(frozen=True, slots=True)
class Rig(SpecModel):
    """What is simulated. stops: mechanical pins at the range of travel; cycle_ns: control cycle (key `rate`, in Hz).

    queues: which frame a CAN controller offers first, of the lowest id, or the one that came first.
    """

    later: ClassVar[tuple[str, ...]] = ("file",)

    plant: Annotated[Literal["suspended"], Later(("walking",))]
    stops: Pins
    cycle_ns: Cycle = 2 * MS
    queues: Queues = "by_id"


@dataclass(frozen=True, slots=True)
class Motion(SpecModel):
    """What the legs do. stride_ns: stride time; duration_ns: from time 0, after the fade-in of one stride."""

    gait: Literal["walking"]
    stride_ns: Annotated[Span, AfterValidator(_stride), Field(alias="stride")]
    duration_ns: Annotated[Span, AfterValidator(_motion_time), Field(alias="duration")]


@dataclass(frozen=True, slots=True)
class RealTime(SpecModel):
    """Beyond which a real-time run is invalid. late_share: of all control cycles, 0..1; late_worst_ns: of one cycle.

    A run proves something only when nearly all cycles are on time. In lock-step none is ever late.
    """

    late_share: Share = 0.01
    late_worst_ns: Annotated[Time, Field(alias="late_worst", json_schema_extra={"default": "20 ms"})] = 20 * MS


@dataclass(frozen=True, slots=True)
class Scenario(SpecModel):
    """One experiment. expect: what must hold besides no failure; fail_on: what fails the verdict.

    tolerance_rad: how far beyond the range of travel is not yet a failure; realtime: when a real-time run is invalid.
    """

    name: Name
    rig: Rig
    motion: Motion
    description: Text = ""
    seed: Seed = 0
    injectors: dict[str, InjectorSpec] = field(default_factory=dict)
    expect: tuple[ExpectLine, ...] = ()
    fail_on: Literal["failure", "error"] = "failure"
    tolerance_rad: Annotated[
        Angle, AfterValidator(_tolerance), Field(alias="tolerance", json_schema_extra={"default": "0 deg"})
    ] = 0.0
    realtime: RealTime = field(default_factory=RealTime)

    @property
    def plan(self) -> BusPlan:
        """The bus plan of the rig."""
        return BusPlan(default_joints(), cycle_ns=self.rig.cycle_ns)

    @property
    def warnings(self) -> list[str]:
        """What is allowed and still looks like a mistake, such as an injector that can never act."""
        motion = self.motion
        return injector_warnings(self.injectors, self.plan, motion.duration_ns, stride_ns=motion.stride_ns)

    def resolved_yaml(self) -> str:
        """The scenario as a file with the defaults filled in; reads as an equal scenario."""
        plain = dump(Scenario, self)
        ordered = {key: plain[key] for key in ("name", "description", *plain)}
        return write(ordered)


def load_scenario(path: Path | str, overrides: Sequence[str] = ()) -> Scenario:
    """The scenario in a file, with `key=value` overrides on top; raises FileErrors with everything that is wrong."""
    document = load(path)
    _change(document, overrides)
    return scenario_in(document)


def parse_scenario(text: str, source: str = "scenario", overrides: Sequence[str] = ()) -> Scenario:
    """As load_scenario, from text; `source` stands for the path in messages."""
    document = parse(text, source)
    _change(document, overrides)
    return scenario_in(document)


def _change(document: Document, overrides: Sequence[str]) -> None:
    """Put `key=value` overrides on top of a scenario; problems go to the document."""
    if isinstance(document.data, dict):
        document.data.setdefault("realtime", {})  # so that its limits can be set in a file that says nothing of them
    for override in overrides:
        apply_override(document, override)


def scenario_schema() -> dict[str, Data]:
    """JSON Schema of scenario files, for editors."""
    return json_schema(Scenario)


def refuse_queues(scenario: Scenario, what: str) -> None:
    """Raise BenchError where the transmit queues are those of a kernel or adapter. what: "exo-hil up"."""
    if scenario.rig.queues != "by_id":
        raise BenchError(
            f"rig.queues: {scenario.rig.queues} given, {what} cannot choose: the transmit queues of real buses are the "
            "kernel's and the adapter's; run it in virtual time (exo-hil run without --realtime), or leave the key out"
        )


def describe(scenario: Scenario) -> list[str]:
    """The scenario in sentences, for `exo-hil check`."""
    rig, motion, plan = scenario.rig, scenario.motion, scenario.plan
    low, high = plan.load()
    pins = "with mechanical stops" if rig.stops else "without mechanical stops"
    lines = [f"{scenario.name}: {scenario.description}" if scenario.description else scenario.name]
    queues = ", transmit queues first in, first out" if rig.queues == "fifo" else ""
    load = f"bus load {100 * low:.0f} to {100 * high:.0f} %"
    lines.append(f"rig: {rig.plant}, {pins}, {_rate(rig.cycle_ns)}{queues}; {load}")
    stride, duration = format_duration(motion.stride_ns), format_duration(motion.duration_ns)
    lines.append(f"motion: {motion.gait}, stride {stride}, {duration} after a fade-in of one stride")
    lines.append(f"seed: {scenario.seed}")
    told = describe_injectors(scenario.injectors, plan, motion.duration_ns, motion.stride_ns)
    lines.extend(told or ["no injectors: a fault-free run"])
    tolerance = f" by more than {math.degrees(scenario.tolerance_rad):g} deg" if scenario.tolerance_rad else ""
    limits = " or passes a torque or speed limit" if scenario.fail_on == "error" else ""
    lines.append(f"verdict: fails if a joint leaves its range of travel{tolerance}{limits}")
    lines.extend(f"expected: {expectation.text}" for expectation in scenario.expect)
    return lines


def scenario_in(document: Document) -> Scenario:
    """Check shape, then sense; raises FileErrors with everything that is wrong."""
    whole = validate(Scenario, document.data, (), document)
    data = document.data if isinstance(document.data, dict) else {}
    rig = validate(Rig, data.get("rig"), ("rig",), None)
    motion = validate(Motion, data.get("motion"), ("motion",), None)
    if rig is not None:
        _check_rig(rig, motion, document)
    check_file_injectors(document)
    document.raise_problems()
    assert whole is not None
    return whole


def check_file_injectors(document: Document) -> None:
    """Report what cannot work in a document's injectors, beyond their shape."""
    plan = BusPlan(default_joints())  # names and mappings do not hang on the rate, which may be wrong
    data = document.data if isinstance(document.data, dict) else {}
    found = data.get("injectors")
    injectors = found if isinstance(found, dict) else {}
    for name in injectors:
        if not _NAME.fullmatch(name):
            text = f"{name!r} is no name; allowed are letters, digits, _ and -, at most 64"
            document.report(("injectors", name), text, at_key=True)
    check_injectors(injectors, plan, lambda keys, text: document.report(("injectors", *keys), text))


def check_rate(cycle_ns: int, document: Document) -> None:
    """Report a rate at which the bus cannot carry what is due in a cycle."""
    try:
        BusPlan(default_joints(), cycle_ns=cycle_ns)
    except CanopenExoError as error:
        document.report(("rig", "rate"), str(error))


def _check_rig(rig: Rig, motion: Motion | None, document: Document) -> None:
    """Report what the bus cannot carry, and what rig and motion cannot do together."""
    if motion is not None and motion.duration_ns < rig.cycle_ns:
        text = f"{format_duration(motion.duration_ns)} is shorter than one control cycle, "
        document.report(("motion", "duration"), f"{text}{format_duration(rig.cycle_ns)}; allowed: from that on")
    if motion is not None and motion.stride_ns % rig.cycle_ns:
        below = motion.stride_ns - motion.stride_ns % rig.cycle_ns
        nearest = f"{format_duration(below)} or {format_duration(below + rig.cycle_ns)}"
        text = f"{format_duration(motion.stride_ns)} is not a whole number of control cycles of "
        document.report(("motion", "stride"), f"{text}{format_duration(rig.cycle_ns)}; nearest: {nearest}")
    check_rate(rig.cycle_ns, document)
