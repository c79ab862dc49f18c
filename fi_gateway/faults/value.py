"""Faults that compute a wrong value from the right one: shifted, scaled, drifting, noisy.

Source: Fabarisov et al., ESREL 2020 (FIBlock), for bias and noise.
Values are computed in raw units of the signal (counts, counts/s, per mille) and rounded to the nearest whole one. A
value that no longer fits saturates at the signal's range and is counted in `saturated`; nothing wraps. In FIBlock the
values are doubles, which are not rounded and do not saturate.
EN 50159 class of all: corruption, above the CRC.
"""

import math
from typing import Final, final

from mypy_extensions import mypyc_attr
from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.signal import Signal
from fi_gateway.errors import FaultError
from fi_gateway.faults.base import Fault, with_payload
from fi_gateway.outlet import Outlet

_MOST: Final = 1e20
"""Beyond the range of any signal (64 bits: 1.8e19) a parameter says nothing more."""


@mypyc_attr(allow_interpreted_subclasses=True)
class ValueFault(Fault):
    """Base: out = clip(changed(in), low, high) of a signal, saturation counted."""

    def __init__(self, signal: Signal) -> None:
        super().__init__(signal)
        self._target: Final[Signal] = signal
        self._low: Final[int] = signal.low
        self._high: Final[int] = signal.high

    def changed(self, now: int, raw: int) -> int:
        """The raw value that shall go on instead of `raw`, in range or not."""
        raise NotImplementedError

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame with the changed value."""
        raw = self.changed(now, self._target.read(frame.data))
        if raw > self._high:
            raw = self._high
            self.saturated += 1
        elif raw < self._low:
            raw = self._low
            self.saturated += 1
        return with_payload(frame, self._target.write(frame.data, raw))


@final
class Bias(ValueFault):
    """A constant is added: out = in + raw_offset. raw_offset: wire units of the signal.

    EN 50159: corruption. FIBlock: Bias (offset); there doubles do not saturate.
    """

    def __init__(self, signal: Signal, raw_offset: int) -> None:
        super().__init__(signal)
        self._raw_offset: Final[int] = raw_offset

    def changed(self, now: int, raw: int) -> int:
        """The sum."""
        return raw + self._raw_offset

    def __reduce__(self) -> tuple[type["Bias"], tuple[Signal, int], dict[str, object]]:
        state: dict[str, object] = {"saturated": self.saturated}
        return Bias, (self._target, self._raw_offset), state


@final
class Gain(ValueFault):
    """The value is scaled: out = in x factor. factor: plain number, also negative (a sensor wired the wrong way).

    The product is that of doubles: a signal of more than 53 bits loses its lowest ones.
    EN 50159: corruption. FIBlock: none.
    """

    def __init__(self, signal: Signal, factor: float) -> None:
        super().__init__(signal)
        _check("gain: factor", factor, -_MOST)
        self._factor: Final[float] = factor

    def changed(self, now: int, raw: int) -> int:
        """The product, rounded."""
        return math.floor(raw * self._factor + 0.5)

    def __reduce__(self) -> tuple[type["Gain"], tuple[Signal, float], dict[str, object]]:
        state: dict[str, object] = {"saturated": self.saturated}
        return Gain, (self._target, self._factor), state


@final
class Drift(ValueFault):
    """The error grows with time: out = in + slope x (t - t0), t0 the start of the activation.

    raw_slope: wire units of the signal per second; t: arrival of the frame.
    EN 50159: corruption. FIBlock: none.
    """

    def __init__(self, signal: Signal, raw_slope: float) -> None:
        super().__init__(signal)
        _check("drift: slope", raw_slope, -_MOST)
        self._raw_slope: Final[float] = raw_slope
        self._start_ns: int = 0

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """The error is zero now."""
        self.saturated = 0
        self._start_ns = now
        return True

    def changed(self, now: int, raw: int) -> int:
        """The sum, its second part rounded."""
        return raw + math.floor(self._raw_slope * (now - self._start_ns) * 1e-9 + 0.5)

    def __reduce__(self) -> tuple[type["Drift"], tuple[Signal, float], dict[str, object]]:
        state: dict[str, object] = {"saturated": self.saturated, "_start_ns": self._start_ns}
        return Drift, (self._target, self._raw_slope), state


@mypyc_attr(allow_interpreted_subclasses=True)
class NoiseFault(ValueFault):
    """Base: out = in + error, an error drawn for every frame from the injector's stream.

    amount: what the error is measured by, in wire units of the signal or as a share of the value; >= 0.
    """

    def __init__(self, signal: Signal, amount: float) -> None:
        super().__init__(signal)
        _check("noise: amount", amount, 0.0)
        self._amount: Final[float] = amount
        self._rng: Generator | None = None

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Keep the stream."""
        self.saturated = 0
        self._rng = rng
        return True

    def error(self, raw: int, rng: Generator) -> float:
        """The error of one value, raw units."""
        raise NotImplementedError

    def changed(self, now: int, raw: int) -> int:
        """The sum, its second part rounded."""
        assert self._rng is not None
        return raw + math.floor(self.error(raw, self._rng) + 0.5)


@final
class RelativeNoise(NoiseFault):
    """Uniform noise in proportion to the value: out = in x (1 + U), U uniform on [-b, b). amount: b, 0.2 for 20 %.

    A value of 0 stays 0. EN 50159: corruption. FIBlock: Noise, no deviation but rounding.
    """

    def error(self, raw: int, rng: Generator) -> float:
        """The value x U."""
        return raw * (self._amount * (2.0 * rng.random() - 1.0))

    def __reduce__(self) -> tuple[type["RelativeNoise"], tuple[Signal, float], dict[str, object]]:
        state: dict[str, object] = {"saturated": self.saturated, "_rng": self._rng}
        return RelativeNoise, (self._target, self._amount), state


@final
class UniformNoise(NoiseFault):
    """Uniform noise: out = in + U, U uniform on [-b, b). amount: b, wire units of the signal.

    EN 50159: corruption. FIBlock: none; b of its Noise is a share of the value.
    """

    def error(self, raw: int, rng: Generator) -> float:
        """U."""
        return self._amount * (2.0 * rng.random() - 1.0)

    def __reduce__(self) -> tuple[type["UniformNoise"], tuple[Signal, float], dict[str, object]]:
        state: dict[str, object] = {"saturated": self.saturated, "_rng": self._rng}
        return UniformNoise, (self._target, self._amount), state


@final
class NormalNoise(NoiseFault):
    """Normal noise: out = in + N, N normal with mean 0. amount: its standard deviation, wire units of the signal.

    EN 50159: corruption. FIBlock: none; its Noise is uniform.
    """

    def error(self, raw: int, rng: Generator) -> float:
        """N."""
        return self._amount * rng.standard_normal()

    def __reduce__(self) -> tuple[type["NormalNoise"], tuple[Signal, float], dict[str, object]]:
        state: dict[str, object] = {"saturated": self.saturated, "_rng": self._rng}
        return NormalNoise, (self._target, self._amount), state


def _check(what: str, value: float, low: float) -> None:
    """Raise FaultError when `value` is not a number from `low` to _MOST."""
    if not low <= value <= _MOST:  # also refuses NaN
        raise FaultError(f"{what} {value} given, allowed {low:g}..{_MOST:g}")
