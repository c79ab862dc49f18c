"""What a joint's drive can sense: encoder counts, the speed it makes of them, and three hall signals.

Encoder: absolute over many turns, on the joint side of the gear, quantised to the nearest count (round half up).
Speed: the difference of counts over one sample, through a first-order low-pass; in counts/s as object 0x606C has it
(CiA 402-2). Hall sensors: three signals 120 electrical degrees apart, each high for half an electrical turn.
Left out: noise, index pulse, nonlinearity, and the faults of sensors.
"""

import math
from dataclasses import dataclass, field
from math import floor
from typing import Final, final

from joint_emulators.errors import JointEmulatorError

INT32_MIN: Final = -(1 << 31)
INT32_MAX: Final = (1 << 31) - 1
_LOWEST: Final = float(INT32_MIN)
_HIGHEST: Final = float(INT32_MAX)
TURN: Final = 2.0 * math.pi
"""A revolution [rad]."""


def to_int32(value: float) -> int:
    """Nearest integer (half up), clipped to int32: 0x6064 and 0x606C do not wrap."""
    if value >= _HIGHEST:
        return INT32_MAX
    if value <= _LOWEST:
        return INT32_MIN
    return floor(value + 0.5)


@dataclass(frozen=True, slots=True)
class EncoderParams:
    """counts_per_revolution: of the joint; offset: counts at q = 0; direction: 1, or -1 when mounted the other way.

    factor: direction times counts a revolution.
    """

    counts_per_revolution: int
    offset: int
    direction: int
    factor: float = field(init=False)

    def __post_init__(self) -> None:
        """Refuse values that are no encoder; raises JointEmulatorError."""
        if self.counts_per_revolution < 1:
            raise JointEmulatorError(f"encoder: {self.counts_per_revolution} counts a revolution given, allowed from 1")
        if self.direction not in (1, -1):
            raise JointEmulatorError(f"encoder: direction {self.direction} given, allowed 1 or -1")
        object.__setattr__(self, "factor", float(self.direction * self.counts_per_revolution))


ENCODER: Final = EncoderParams(131072, 0, 1)
"""17 bit per joint revolution: 48 microradians a count."""


def encode(q: float, params: EncoderParams) -> int:
    """Counts at the joint angle q [rad, finite]; clipped at int32 (16384 turns of a 17-bit encoder)."""
    value = q * params.factor / TURN + params.offset
    if _LOWEST < value < _HIGHEST:
        return floor(value + 0.5)
    return to_int32(value)


@dataclass(frozen=True, slots=True)
class VelocityEstimateParams:
    """sample_s: time between two calls of `estimate_velocity` [s]; cutoff_hz: of the low-pass, -3 dB.

    rate_hz: samples a second; gain: share of the way to its input that the low-pass goes in one sample,
    1 - exp(-2 pi cutoff sample).
    """

    sample_s: float
    cutoff_hz: float
    gain: float = field(init=False)
    rate_hz: float = field(init=False)

    def __post_init__(self) -> None:
        """Refuse values that are no filter; raises JointEmulatorError."""
        if not (0.0 < self.sample_s < math.inf and 0.0 < self.cutoff_hz < math.inf):
            raise JointEmulatorError(
                f"velocity estimate: sample {self.sample_s} s and cut-off {self.cutoff_hz} Hz given, "
                "allowed are finite values above 0"
            )
        object.__setattr__(self, "rate_hz", 1.0 / self.sample_s)
        object.__setattr__(self, "gain", 1.0 - math.exp(-2.0 * math.pi * self.cutoff_hz * self.sample_s))


VELOCITY: Final = VelocityEstimateParams(0.001, 100.0)
"""Drive default: 1 ms, 100 Hz. One count more in a single sample shows as 467 counts/s (0.022 rad/s at 17 bit)."""


@final
class VelocityEstimateState:
    """counts: of the last sample; filtered: counts/s; started: whether there was a last sample."""

    def __init__(self) -> None:
        self.counts = 0
        self.filtered = 0.0
        self.started = False


def estimate_velocity(params: VelocityEstimateParams, state: VelocityEstimateState, counts: int) -> float:
    """Speed [counts/s] after the next sample of the encoder; 0 on the first one, which has no difference."""
    if state.started:
        state.filtered += params.gain * ((counts - state.counts) * params.rate_hz - state.filtered)
    state.counts = counts
    state.started = True
    return state.filtered


@final
class JointSensor:
    """What a drive has sampled of its joint, by `sample`.

    counts: of the encoder; speed: counts/s, as estimated; torque_nm: joint torque after the gear [N m].
    """

    def __init__(self, encoder: EncoderParams, velocity: VelocityEstimateParams) -> None:
        self.counts: int = 0
        self.speed: float = 0.0
        self.torque_nm: float = 0.0
        self.is_started: bool = False
        self.factor: Final[float] = encoder.factor
        self.offset: Final[int] = encoder.offset
        self.gain: Final[float] = velocity.gain
        self.rate_hz: Final[float] = velocity.rate_hz


def sample(sensors: list[JointSensor], q: list[float], tau: list[float]) -> None:
    """`encode` and `estimate_velocity` for all joints in one call, after every step.

    q: joint angles [rad, finite]; tau: torques of the motors after the gear [N m].
    """
    for joint, sensor in enumerate(sensors):
        value = q[joint] * sensor.factor / TURN + sensor.offset
        counts = floor(value + 0.5) if _LOWEST < value < _HIGHEST else to_int32(value)
        if sensor.is_started:
            speed = sensor.speed
            sensor.speed = speed + sensor.gain * ((counts - sensor.counts) * sensor.rate_hz - speed)
        else:
            sensor.is_started = True
        sensor.counts = counts
        sensor.torque_nm = tau[joint]


@dataclass(frozen=True, slots=True)
class HallParams:
    """pole_pairs: electrical turns per shaft turn; gear_ratio: shaft turns per joint turn.

    offset_rad: electrical angle at q = 0.
    """

    pole_pairs: int
    gear_ratio: float
    offset_rad: float

    def __post_init__(self) -> None:
        """Refuse values that are no motor; raises JointEmulatorError."""
        if self.pole_pairs < 1 or not 0.0 < self.gear_ratio < math.inf:
            raise JointEmulatorError(f"hall sensors: {self} given, allowed are pole_pairs from 1, gear_ratio above 0")


_SECTORS: Final = (5, 1, 3, 2, 6, 4)


def hall_state(q: float, params: HallParams) -> int:
    """The three signals at the joint angle q [rad], a + 2 b + 4 c, always 1..6 (0 and 7 are illegal).

    a is high for electrical angles 0..180 deg, b for 120..300, c for 240..420: the sectors of 60 deg from 0 on give
    5 1 3 2 6 4.
    """
    turns = (q * params.gear_ratio * params.pole_pairs + params.offset_rad) / (2.0 * math.pi)
    sector = math.floor(6.0 * (turns - math.floor(turns)))
    return _SECTORS[min(sector, 5)]  # a turn just below a whole one may round up to it
