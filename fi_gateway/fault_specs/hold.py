"""Faults in files that put a kept or given value in the place of the one that came."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from fi_gateway.boundary import Span, SpecError
from fi_gateway.fault_specs.base import FaultSpec, Payload, Scalar, needed_signal, value_in_range
from fi_gateway.faults import Fault, StuckAt, StuckAtPayload, StuckAtValue, TimeDelay
from fi_gateway.quantity import format_duration
from fi_gateway.target import Place


@dataclass(frozen=True, slots=True)
class StuckAtSpec(FaultSpec):
    """The last value before activation."""

    type: Literal["stuck_at"]

    def build(self, place: Place) -> Fault:
        """See StuckAt."""
        return StuckAt(place.signal)

    def words(self, place: Place) -> str:
        """For people."""
        return "held at its last value" if place.signal is not None else "held at its last payload"


@dataclass(frozen=True, slots=True)
class StuckAtValueSpec(FaultSpec):
    """A given value (with a signal: `value`, in its unit), or given bytes (whole frame: `payload`)."""

    type: Literal["stuck_at_value"]
    value: Scalar | None = None
    payload: Payload | None = None

    def build(self, place: Place) -> Fault:
        """See StuckAtValue and StuckAtPayload."""
        signal = place.signal
        if signal is None:
            if self.value is not None:
                raise SpecError(("value",), "the target is a whole frame: give its bytes as payload, or add a signal")
            if self.payload is None:
                raise SpecError((), "payload is missing: the bytes to send instead, such as '00 00 00 00'")
            data = bytes.fromhex(self.payload)
            if place.size >= 0 and len(data) != place.size:
                raise SpecError(("payload",), f"{len(data)} bytes given; {place.words} carries {place.size}")
            return StuckAtPayload(data)
        if self.payload is not None:
            raise SpecError(("payload",), "the target is a signal: give its value, or leave signal out of the target")
        if self.value is None:
            raise SpecError((), f"value is missing: what {signal.name} shall read, in {signal.unit or 'plain numbers'}")
        return StuckAtValue(signal, value_in_range(self.value, signal))

    def words(self, place: Place) -> str:
        """For people."""
        return f"reads {self.value}" if place.signal is not None else f"replaced by {self.payload}"


@dataclass(frozen=True, slots=True)
class PackageDropSpec(FaultSpec):
    """A given value in the place of the signal, in its unit: FIBlock's Package drop; no frame is lost."""

    type: Literal["package_drop"]
    value: Scalar

    def build(self, place: Place) -> Fault:
        """See StuckAtValue."""
        signal = needed_signal(place, "package_drop")
        return StuckAtValue(signal, value_in_range(self.value, signal))

    def words(self, place: Place) -> str:
        """For people."""
        return f"replaced by {self.value}"


@dataclass(frozen=True, slots=True)
class TimeDelaySpec(FaultSpec):
    """The signal lags, while its frames come in time."""

    type: Literal["time_delay"]
    lag_ns: Annotated[Span, Field(alias="lag")]

    def build(self, place: Place) -> Fault:
        """See TimeDelay."""
        return TimeDelay(needed_signal(place, "time_delay"), self.lag_ns)

    def words(self, place: Place) -> str:
        """For people."""
        return f"lags by {format_duration(self.lag_ns)}"
