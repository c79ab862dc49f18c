"""Conditions over decoded signals, such as `right_knee.position < -60 deg`, as the engine evaluates them.

Limits are raw integers: made once from the file's units (`condition_specs`), so that no rounding happens per frame.
A comparison with a signal that no frame has brought yet does not hold, whatever its sense.
"""

from typing import Final, final

from mypy_extensions import mypyc_attr

from canopen_exo.bus.frame import Frame
from canopen_exo.signal import Signal
from fi_gateway.errors import FaultError


@final
class Reading:
    """A signal as last read. port: of the gateway, on which its frames come in; known: whether one has come."""

    def __init__(self, port: int, signal: Signal) -> None:
        self.port: Final[int] = port
        self.signal: Final[Signal] = signal
        self.known: bool = False
        self.raw: int = 0

    def __reduce__(self) -> tuple[type["Reading"], tuple[int, Signal], dict[str, object]]:
        return Reading, (self.port, self.signal), {"known": self.known, "raw": self.raw}


@mypyc_attr(allow_interpreted_subclasses=True)
class Term:
    """A part of a condition that holds or does not."""

    def holds(self) -> bool:
        """Whether it holds with the readings as they are."""
        raise NotImplementedError


@final
class Within(Term):
    """low <= raw & mask <= high, raw integers; or, with `outside`, known and not so. mask: -1 for all bits.

    Every operator is one of these: < and <= have a high end, > and >= a low one, == both, != both and `outside`.
    """

    def __init__(self, reading: Reading, low: int, high: int, mask: int = -1, outside: bool = False) -> None:
        self.reading: Final[Reading] = reading
        self.low: Final[int] = low
        self.high: Final[int] = high
        self.mask: Final[int] = mask
        self.outside: Final[bool] = outside

    def holds(self) -> bool:
        """Compare the last value."""
        reading = self.reading
        return reading.known and (self.low <= reading.raw & self.mask <= self.high) != self.outside

    def __reduce__(self) -> tuple[type["Within"], tuple[Reading, int, int, int, bool]]:
        return Within, (self.reading, self.low, self.high, self.mask, self.outside)


@final
class AllOf(Term):
    """`and`: holds when every part does."""

    def __init__(self, parts: list[Term]) -> None:
        self.parts: Final[list[Term]] = parts

    def holds(self) -> bool:
        """In written order, up to the first that does not hold."""
        for part in self.parts:  # noqa: SIM110 (a generator per frame is what the compiled core avoids)
            if not part.holds():
                return False
        return True

    def __reduce__(self) -> tuple[type["AllOf"], tuple[list[Term]]]:
        return AllOf, (self.parts,)


@final
class AnyOf(Term):
    """`or`: holds when one part does."""

    def __init__(self, parts: list[Term]) -> None:
        self.parts: Final[list[Term]] = parts

    def holds(self) -> bool:
        """In written order, up to the first that holds."""
        for part in self.parts:  # noqa: SIM110 (as above)
            if part.holds():
                return True
        return False

    def __reduce__(self) -> tuple[type["AnyOf"], tuple[list[Term]]]:
        return AnyOf, (self.parts,)


@final
class Condition:
    """A term with the readings it is made of; belongs to one event or effect.

    watches: the frames it needs, (port, COB-ID) each once, as they come in, before any fault.
    """

    def __init__(self, term: Term, readings: list[Reading]) -> None:
        if not readings:
            raise FaultError("condition: no signal given, allowed are one or more")
        self._term: Final[Term] = term
        self._readings: Final[list[Reading]] = readings
        watches: list[tuple[int, int]] = []
        for reading in readings:
            frame = (reading.port, reading.signal.cob_id)
            if frame not in watches:
                watches.append(frame)
        self.watches: Final[tuple[tuple[int, int], ...]] = tuple(watches)

    def observe(self, frame: Frame) -> bool:
        """Read the signals that are in a watched frame (it may be too short for some); whether the term holds now."""
        for reading in self._readings:
            signal = reading.signal
            if signal.cob_id == frame.can_id and signal.fits(frame.data):
                reading.raw, reading.known = signal.read(frame.data), True
        return self._term.holds()

    def __reduce__(self) -> tuple[type["Condition"], tuple[Term, list[Reading]]]:
        return Condition, (self._term, self._readings)
