"""Quantisation: what a failing encoder or a saving of bits does to a value.

Two classes: the fault, which works on raw values while frames pass, and its form in scenario files, which knows units.
"""

import math
from dataclasses import dataclass
from typing import Final, final

from canopen_exo.signal import Signal
from fi_gateway.boundary import SpecError, Text
from fi_gateway.errors import FaultError
from fi_gateway.fault_specs import FaultSpec, Scalar, needed_signal, raw_value
from fi_gateway.faults import Fault, ValueFault
from fi_gateway.target import Place


@final
class Quantise(ValueFault):
    """The value is rounded to the nearest multiple of a step: out = step x floor(in / step + 1/2).

    raw_step: wire units of the signal, >= 2.
    EN 50159: corruption. FIBlock: none.
    """

    def __init__(self, signal: Signal, raw_step: int) -> None:
        super().__init__(signal)
        if raw_step < 2:
            raise FaultError(f"quantise: a step of {raw_step} given, allowed 2 and more")
        self._raw_step: Final = raw_step

    def changed(self, now: int, raw: int) -> int:
        """The nearest multiple."""
        return self._raw_step * math.floor(raw / self._raw_step + 0.5)

    def __reduce__(self) -> tuple[type["Quantise"], tuple[Signal, int], dict[str, object]]:
        state: dict[str, object] = {"saturated": self.saturated}
        return Quantise, (self._target, self._raw_step), state


@dataclass(frozen=True, slots=True)
class QuantiseSpec(FaultSpec):
    """A signal known only in steps. step: in the unit of the signal."""

    type: Text
    step: Scalar

    def build(self, place: Place) -> Fault:
        """See Quantise."""
        signal = needed_signal(place, "quantise")
        raw = raw_value(self.step, signal, "step")
        if raw < 2:
            one = f"{signal.scale:.3g} {signal.unit}".strip()
            raise SpecError(("step",), f"{self.step} is less than 2 counts of {one} each and would change nothing")
        return Quantise(signal, raw)

    def words(self, place: Place) -> str:
        """For people."""
        return f"known only in steps of {self.step}"
