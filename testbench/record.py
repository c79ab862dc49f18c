"""What one run leaves behind: frames of both buses, the plant's truth, the controller's commands, what happened.

Times of arrays and rig events count from time 0, the start of the motion proper. Rows of the trace and activations
carry the loop's clock, whose zero is power-up; `RunRecord.time0_ns` lies between the two.
Arrays are checked where they are made, so that no later sum runs over unequal lengths or non-finite numbers.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from canopen_exo.bus.medium import Transmission
from fi_gateway.activation import Activation
from testbench.errors import BenchError

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Truth:
    """The plant itself at 1 kHz, never what a frame said.

    t_s (n,) s, rising; q (n, joints) rad; dq (n, joints) rad/s; tau (n, joints) N m, joint torque after the gear.
    """

    t_s: Array
    q: Array
    dq: Array
    tau: Array

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together or are not finite; raises BenchError."""
        _check("truth", self.t_s, (("q", self.q), ("dq", self.dq), ("tau", self.tau)))


@dataclass(frozen=True, slots=True)
class Commands:
    """What the controller wanted, once a control cycle, at the SYNC that starts the cycle.

    t_s (m,) s; q_ref (m, joints) rad and dq_ref (m, joints) rad/s: reference for that instant;
    tau_command (m, joints) N m: the torque worked out in that cycle, before its clamp.
    The reference of a foreign controller is not known: q_ref and dq_ref are then (m, 0).
    """

    t_s: Array
    q_ref: Array
    dq_ref: Array
    tau_command: Array

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together or are not finite; raises BenchError."""
        parts = (("tau_command", self.tau_command), ("q_ref", self.q_ref), ("dq_ref", self.dq_ref))
        _check("commands", self.t_s, parts if self.has_reference else parts[:1])

    @property
    def has_reference(self) -> bool:
        """Whether it is known what the controller followed."""
        return not self.q_ref.shape == self.dq_ref.shape == (self.t_s.size, 0)


@dataclass(frozen=True, slots=True)
class BusStats:
    """One bus over the motion. frames: that passed; load: 0..1; queue_overflows: frames dropped, whole run."""

    name: str
    frames: int
    load: float
    queue_overflows: int = 0


@dataclass(frozen=True, slots=True)
class RigEvent:
    """Something that happened on the rig: an EMCY, a drive fault, a cut bus.

    time_s: from time 0, negative while starting; node: "right_knee", "HLC", "drive bus"; kind: one word.
    """

    time_s: float
    node: str
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class RunRecord:
    """One run. rows: trace of all buses in loop order.

    time0_ns: time 0 on the loop's clock, as the gateway took it from the bus; duration_ns: of the motion, from time 0;
    buses: by bus index; activations: in the order they began, closed; notes: in time order; completed: False when the
    controller ended the motion early; held_cycles: per joint, cycles in which its last sample was used again because
    no new one had come; invalid_reasons: why the run proves nothing, empty when it is valid; source: of the truth,
    "plant", or "bus" when foreign drives were on it and only their frames tell; activations_after: as activations, of
    those that began after the motion, which the result does not count.
    """

    rows: list[Transmission]
    time0_ns: int
    duration_ns: int
    truth: Truth
    commands: Commands
    activations: list[Activation]
    buses: tuple[BusStats, ...]
    notes: list[RigEvent] = field(default_factory=list)
    completed: bool = True
    held_cycles: list[int] = field(default_factory=list)
    invalid_reasons: list[str] = field(default_factory=list)
    source: str = "plant"
    activations_after: list[Activation] = field(default_factory=list)

    @property
    def valid(self) -> bool:
        """Whether the run can be judged at all."""
        return not self.invalid_reasons

    @property
    def power_up_ns(self) -> int:
        """The first classical 11-bit data frame, as the gateway takes it for power-up; time 0 when there is none."""
        return next((row.end_ns for row in self.rows if row.frame.flags == 0), self.time0_ns)

    @property
    def duration_s(self) -> float:
        """Length of the motion [s]."""
        return self.duration_ns / 1e9


def motion_rows(t_s: Array, duration_s: float) -> NDArray[np.bool_]:
    """Which instants lie in the motion, [0, duration], ends included. (n,)

    Instants are whole nanoseconds held as float64 seconds; half a nanosecond either way is their rounding.
    """
    return np.asarray((t_s >= -0.5e-9) & (t_s <= duration_s + 0.5e-9), dtype=np.bool_)


def _check(what: str, t_s: Array, parts: tuple[tuple[str, Array], ...]) -> None:
    if t_s.ndim != 1 or t_s.size == 0:
        raise BenchError(f"{what}: t_s of shape {t_s.shape} given, allowed is (n,) with at least one instant")
    if np.any(np.diff(t_s) <= 0):
        raise BenchError(f"{what}: t_s must rise at every sample")
    joints = parts[0][1].shape[-1] if parts[0][1].ndim else 0
    for name, values in (("t_s", t_s), *parts):
        if name != "t_s" and values.shape != (t_s.size, joints):
            raise BenchError(f"{what}: {name} of shape {values.shape} given, allowed is {(t_s.size, joints)}")
        if not np.all(np.isfinite(values)):
            row = int(np.argwhere(~np.isfinite(values))[0][0])
            raise BenchError(f"{what}: {name} is not finite at row {row}, t = {t_s[row]:g} s: the run proves nothing")
