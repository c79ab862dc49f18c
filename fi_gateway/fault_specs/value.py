"""Faults in files that compute a wrong value from the right one."""

import re
from dataclasses import dataclass
from typing import Final, Literal

from canopen_exo.signal import Signal
from fi_gateway.boundary import SpecError
from fi_gateway.fault_specs.base import (
    FaultSpec,
    Ratio,
    Scalar,
    needed_signal,
    one_of,
    raw_amount,
    raw_slope,
    raw_value,
)
from fi_gateway.faults import Bias, Drift, Fault, Gain, NormalNoise, RelativeNoise, UniformNoise
from fi_gateway.target import Place

_NOT_ZERO: Final = re.compile(r"\s*[+-]?[0.]*[1-9]", re.ASCII)


@dataclass(frozen=True, slots=True)
class BiasSpec(FaultSpec):
    """A constant added to a signal, in its unit."""

    type: Literal["bias"]
    value: Scalar

    def build(self, place: Place) -> Fault:
        """See Bias."""
        signal = needed_signal(place, "bias")
        raw = raw_value(self.value, signal)
        span = signal.high - signal.low
        if abs(raw) > span:
            most = f"{signal.to_si(span):.6g} {signal.unit}".strip()
            raise SpecError(
                ("value",), f"{self.value} is more than the whole range of {signal.name} of {signal.node}, {most}"
            )
        if raw == 0 and _NOT_ZERO.match(str(self.value)):
            one = f"{signal.scale:.3g} {signal.unit}"
            raise SpecError(("value",), f"{self.value} is less than half of one count ({one}) and would change nothing")
        return Bias(signal, raw)

    def words(self, place: Place) -> str:
        """For people."""
        return f"shifted by {self.value}"

    def doubts(self) -> str:
        """With 0."""
        return "" if _NOT_ZERO.match(str(self.value)) else "value is 0"


@dataclass(frozen=True, slots=True)
class GainSpec(FaultSpec):
    """A signal multiplied by a plain number; negative turns its sign."""

    type: Literal["gain"]
    factor: Ratio

    def build(self, place: Place) -> Fault:
        """See Gain."""
        return Gain(needed_signal(place, "gain"), self.factor)

    def words(self, place: Place) -> str:
        """For people."""
        return f"multiplied by {self.factor:g}"

    def doubts(self) -> str:
        """With 1."""
        return "factor is 1" if self.factor == 1 else ""


@dataclass(frozen=True, slots=True)
class DriftSpec(FaultSpec):
    """An error that grows from 0 at the start of the activation, in the unit of the signal per time."""

    type: Literal["drift"]
    slope: Scalar

    def build(self, place: Place) -> Fault:
        """See Drift."""
        signal = needed_signal(place, "drift")
        slope = raw_slope(self.slope, signal, "slope")
        if not abs(slope) <= 1e9 * (signal.high - signal.low):
            raise SpecError(("slope",), f"{self.slope} passes the whole range of {signal.name} within 1 ns")
        return Drift(signal, slope)

    def words(self, place: Place) -> str:
        """For people."""
        return f"drifts by {self.slope}"

    def doubts(self) -> str:
        """With 0."""
        return "" if _NOT_ZERO.match(str(self.slope)) else "slope is 0"


@dataclass(frozen=True, slots=True)
class NoiseSpec(FaultSpec):
    """An error drawn for every frame: `relative` to the value (FIBlock), `uniform` up to an amount, or `normal`."""

    type: Literal["noise"]
    relative: Ratio | None = None
    uniform: Scalar | None = None
    normal: Scalar | None = None

    def build(self, place: Place) -> Fault:
        """See RelativeNoise, UniformNoise and NormalNoise."""
        signal = needed_signal(place, "noise")
        key = one_of({"relative": self.relative, "uniform": self.uniform, "normal": self.normal}, "noise")
        if self.relative is not None:
            if self.relative <= 0:
                raise SpecError((key,), f"{self.relative:g} is no amount of noise; allowed is more than 0, as '20 %'")
            return RelativeNoise(signal, self.relative)
        if self.uniform is not None:
            return UniformNoise(signal, _amount(self.uniform, signal, key))
        assert self.normal is not None
        return NormalNoise(signal, _amount(self.normal, signal, key))

    def words(self, place: Place) -> str:
        """For people."""
        if self.relative is not None:
            return f"has uniform noise of up to {100 * self.relative:g} % of its value"
        if self.uniform is not None:
            return f"has uniform noise of up to {self.uniform}"
        return f"has normal noise with standard deviation {self.normal}"


def _amount(given: str | int | float, signal: Signal, key: str) -> float:
    """Raw units; raises SpecError for what would change nothing."""
    amount = raw_amount(given, signal, key)
    if key == "uniform" and amount <= 0.5:
        one = f"{signal.scale:.3g} {signal.unit}".strip()
        raise SpecError((key,), f"{given} is not more than half of one count ({one}) and would change nothing")
    return amount
