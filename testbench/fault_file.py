"""Fault files: injectors for a gateway between real buses, where nothing is simulated and nothing is judged.

Needed is `injectors:` alone. `rig: {rate: ...}` is the control cycle that `per: sync` means, and by which the
controller's status frame counts; `seed`, `name` and `description` are as in a scenario. A whole scenario serves as
well: a gateway takes from it what it needs. A file with a key that only a scenario has is read as one.
Left out: a bus plan of one's own; targets are named by the plan of testbench.scenario, or by COB-ID.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Final, Literal

from canopen_exo.bus.node import MS, NEVER, SECOND
from canopen_exo.plan import BusPlan
from fi_gateway.boundary import Later, SpecModel, Text, validate
from fi_gateway.doubts import injector_warnings
from fi_gateway.marked_yaml import Data, Document, apply_override, load
from fi_gateway.quantity import format_hertz
from fi_gateway.schema import InjectorSpec, describe_injectors, status_watchers
from testbench.scenario import (
    Cycle,
    Name,
    Pins,
    Queues,
    Scenario,
    Seed,
    check_file_injectors,
    check_rate,
    default_joints,
    scenario_in,
)

SCENARIO_ONLY: Final = frozenset({"motion", "expect", "fail_on", "tolerance", "realtime"})
"""Keys that make a file a scenario: what moves, and how it is judged."""

WORDS_NS: Final = 60 * SECOND
"""For how long the number of activations is told; a gateway has no end of its own."""

_STATUS_NEEDED: Final = (
    "waits for what `exo-hil hlc` says on the bus (COB-ID 0x2FF); with another controller it never comes, and "
    "`exo-hil fault start` is refused"
)


@dataclass(frozen=True, slots=True)
class FaultRig(SpecModel):
    """What a gateway must know of a rig. cycle_ns: control cycle; the rest is of a simulated rig, not used."""

    plant: Annotated[Literal["suspended"] | None, Later(("walking",))] = None
    stops: Pins | None = None
    cycle_ns: Cycle = 2 * MS
    queues: Queues = "by_id"


@dataclass(frozen=True, slots=True)
class FaultFile(SpecModel):
    """Injectors, in the order in which they act on a frame, and what they hang on."""

    injectors: dict[str, InjectorSpec]
    name: Name = "faults"
    description: Text = ""
    rig: FaultRig = field(default_factory=FaultRig)
    seed: Seed = 0

    @property
    def plan(self) -> BusPlan:
        """The bus plan that targets are named by."""
        return BusPlan(default_joints(), cycle_ns=self.rig.cycle_ns)

    @property
    def warnings(self) -> list[str]:
        """What is allowed and still looks like a mistake, such as an injector that can never act."""
        return [
            *injector_warnings(self.injectors, self.plan, NEVER, by_hand=True),
            *(f"injectors.{name}: {_STATUS_NEEDED}" for name in status_watchers(self.injectors, self.plan)),
        ]


def no_faults() -> FaultFile:
    """What a gateway runs on without a file."""
    return FaultFile({})


def faults_of(scenario: Scenario) -> FaultFile:
    """What a gateway needs of a scenario."""
    rig = FaultRig(cycle_ns=scenario.rig.cycle_ns)
    return FaultFile(dict(scenario.injectors), scenario.name, scenario.description, rig, scenario.seed)


def load_faults(path: Path | str, overrides: Sequence[str] = ()) -> FaultFile:
    """The faults in a fault file or in a scenario, with overrides; raises FileErrors with everything that is wrong."""
    found = load_any(path, overrides)
    return faults_of(found) if isinstance(found, Scenario) else found


def load_any(path: Path | str, overrides: Sequence[str] = ()) -> Scenario | FaultFile:
    """Whichever of the two a file is; raises FileErrors with everything that is wrong."""
    document = load(path)
    if isinstance(document.data, dict):  # so that `rig.rate`, and the limits, can be set in a file without them
        document.data.setdefault("rig" if is_fault_file(document.data) else "realtime", {})
    for override in overrides:
        apply_override(document, override)
    return _read(document) if is_fault_file(document.data) else scenario_in(document)


def is_fault_file(data: Data) -> bool:
    """Whether a file is about injectors, and nothing in it is of a scenario alone."""
    return isinstance(data, Mapping) and "injectors" in data and SCENARIO_ONLY.isdisjoint(data)


def describe_faults(faults: FaultFile) -> list[str]:
    """A fault file in sentences, for `exo-hil check`."""
    lines = [f"{faults.name}: {faults.description}" if faults.description else faults.name]
    lines.append("faults for `exo-hil gateway`; a run (`exo-hil run`, `exo-hil up`) also needs name, rig and motion")
    lines.append(f"control cycles: {format_hertz(Fraction(SECOND, faults.rig.cycle_ns))}; seed: {faults.seed}")
    lines.append("time 0: the controller's status frame (COB-ID 0x2FF), or `exo-hil fault start`")
    return lines + (describe_injectors(faults.injectors, faults.plan, WORDS_NS) or ["no injectors: every frame passes"])


def _read(document: Document) -> FaultFile:
    whole = validate(FaultFile, document.data, (), document)
    data = document.data if isinstance(document.data, dict) else {}
    rig = validate(FaultRig, data.get("rig", {}), ("rig",), None)
    if rig is not None:
        check_rate(rig.cycle_ns, document)
    check_file_injectors(document)
    document.raise_problems()
    assert whole is not None
    return whole
