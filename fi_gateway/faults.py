"""Fault types: what comes out of the gateway instead of the frame that came in.

Every fault here changes a payload whose CRC stays valid, or loses a whole frame. That models a fault upstream of the
sender's CAN controller (sensor, memory, firmware) or a lossy link, never line noise: bit errors, error frames and
bus-off need the emulated medium (ISO 11898-1: a flip that all nodes see costs time, not data).

Sources: Fabarisov et al., ESREL 2020 (FIBlock), for the types; EN 50159:2010 for the classes of message errors.
Raw values are the integers on the wire; SI units end at the signal.
Every fault can be copied and pickled in mid-run, compiled or not: `__reduce__` gives its arguments and state.
"""

from typing import Final, final

from mypy_extensions import mypyc_attr
from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.signal import Signal
from fi_gateway.errors import FaultError
from fi_gateway.outlet import Outlet


@mypyc_attr(allow_interpreted_subclasses=True)
class Fault:
    """What happens to the frames of an active injector.

    signal: what it acts on, None for the whole payload or frame; saturated: frames of the current or last activation
    whose value was cut at the signal's range; spares: whether `apply` giving the frame itself means it was left alone;
    wake_at: absolute time [ns], while active, at which it wants `wake`, to insert without being asked; NEVER for none.
    Values here are made for one injector and not shared.
    """

    def __init__(self, signal: Signal | None = None) -> None:
        self.signal: Signal | None = signal
        self.saturated: int = 0
        self.spares: bool = False
        self.wake_at: int = NEVER

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """The injector activates at `now` [ns]; False: cannot act yet, ask again at the next frame.

        held: the last frame of each target COB-ID that reached the injector before `now` and was long enough for the
        signal, not to be changed or kept; rng: the injector's stream, may be kept.
        """
        self.saturated = 0
        return True

    def fits(self, frame: Frame) -> bool:
        """Whether the fault can act on this frame; if not, it passes unchanged and is counted."""
        return self.signal is None or self.signal.fits(frame.data)

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame that goes on instead, `frame` itself when nothing changes. It `fits`.

        None: it does not go on now: lost, unless it was given to `outlet.later`.
        """
        raise NotImplementedError

    def wake(self, now: int, outlet: Outlet) -> None:
        """`wake_at` is reached; `now` is that time. Must move `wake_at` on."""
        raise NotImplementedError

    def end(self) -> None:
        """The activation is over."""


def with_payload(frame: Frame, data: bytes) -> Frame:
    """The frame with another payload of the same length; id, flags and raw DLC kept; itself when nothing changes."""
    if data == frame.data:
        return frame
    return Frame(frame.can_id, data, frame.flags, frame.dlc if frame.flags or frame.dlc > 8 else -1)


@final
class StuckAt(Fault):
    """The last value before the activation goes on: out = in(last before t0).

    signal: that value is held, the rest of the payload passes; None: the payload of each COB-ID is held (one whose
    first frame comes only during the activation is held at that one; another length passes unchanged, counted).
    Waits when no value is known yet: the window then opens with the first frame after one has come.
    EN 50159: corruption (stale content in a fresh message). FIBlock: Stuck-at; it holds the activation sample itself,
    which a frame-driven gateway has not got: between frames the last value is the one before.
    """

    def __init__(self, signal: Signal | None) -> None:
        super().__init__(signal)
        self._raw: int = 0
        self._payloads: dict[int, bytes] = {}

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Take the held value; False while there is none."""
        self.saturated = 0
        signal = self.signal
        if signal is not None:
            last = held.get(signal.cob_id)
            if last is None:
                return False
            self._raw = signal.read(last.data)
            return True
        for cob_id, frame in held.items():
            self._payloads[cob_id] = frame.data
        return len(self._payloads) > 0

    def fits(self, frame: Frame) -> bool:
        """The frame holds the signal; for a payload: it is as long as the held one."""
        if self.signal is not None:
            return self.signal.fits(frame.data)
        payload = self._payloads.get(frame.can_id)
        return payload is None or len(payload) == len(frame.data)

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame with the held value."""
        if self.signal is not None:
            return with_payload(frame, self.signal.write(frame.data, self._raw))
        return with_payload(frame, self._payloads.setdefault(frame.can_id, frame.data))

    def end(self) -> None:
        """Forget the held payloads."""
        self._payloads.clear()

    def __reduce__(self) -> tuple[type["StuckAt"], tuple[Signal | None], dict[str, object]]:
        state: dict[str, object] = {"_raw": self._raw, "_payloads": self._payloads}
        return StuckAt, (self.signal,), state


@final
class StuckAtValue(Fault):
    """A given value goes on: out = raw. raw: wire units of the signal (counts, counts/s, per mille), within its range.

    EN 50159: corruption. FIBlock: the paper's Stuck-at-0 ("Stuck-at" with a constant), no deviation.
    """

    def __init__(self, signal: Signal, raw: int) -> None:
        super().__init__(signal)
        if not signal.low <= raw <= signal.high:
            raise FaultError(
                f"stuck_at_value: raw value {raw} given for {signal.node}.{signal.name}, "
                f"allowed {signal.low}..{signal.high}"
            )
        self._target: Final[Signal] = signal
        self._raw: Final[int] = raw

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame with the given value."""
        return with_payload(frame, self._target.write(frame.data, self._raw))

    def __reduce__(self) -> tuple[type["StuckAtValue"], tuple[Signal, int]]:
        return StuckAtValue, (self._target, self._raw)


@final
class StuckAtPayload(Fault):
    """A given payload goes on: out = payload, 0..8 bytes. Frames of another length pass unchanged and are counted.

    `stuck_at_value` without a signal. EN 50159: corruption. FIBlock: Stuck-at, on all signals of the frame at once.
    """

    def __init__(self, payload: bytes) -> None:
        super().__init__(None)
        if len(payload) > 8:
            raise FaultError(f"stuck_at_value: a payload of {len(payload)} bytes given, allowed 0..8")
        self._payload: Final[bytes] = payload

    def fits(self, frame: Frame) -> bool:
        """The frame is as long as the given payload."""
        return len(frame.data) == len(self._payload)

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame with the given payload."""
        return with_payload(frame, self._payload)

    def __reduce__(self) -> tuple[type["StuckAtPayload"], tuple[bytes]]:
        return StuckAtPayload, (self._payload,)


@final
class Bias(Fault):
    """A constant is added: out = clip(in + raw_offset, low, high). raw_offset: wire units of the signal.

    A sum that does not fit saturates at the signal's range and is counted in `saturated`; nothing wraps.
    EN 50159: corruption. FIBlock: Bias; there doubles do not saturate.
    """

    def __init__(self, signal: Signal, raw_offset: int) -> None:
        super().__init__(signal)
        self._target: Final[Signal] = signal
        self._raw_offset: Final[int] = raw_offset
        self._low: Final[int] = signal.low
        self._high: Final[int] = signal.high

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame with the biased value."""
        raw = self._target.read(frame.data) + self._raw_offset
        if raw > self._high:
            raw = self._high
            self.saturated += 1
        elif raw < self._low:
            raw = self._low
            self.saturated += 1
        return with_payload(frame, self._target.write(frame.data, raw))

    def __reduce__(self) -> tuple[type["Bias"], tuple[Signal, int], dict[str, object]]:
        state: dict[str, object] = {"saturated": self.saturated}
        return Bias, (self._target, self._raw_offset), state


@final
class Drop(Fault):
    """The frame is lost, each with the given probability (0..1), drawn per frame.

    EN 50159: deletion. FIBlock: none; its Package drop replaces a value and loses no frame.
    """

    def __init__(self, probability: float = 1.0) -> None:
        super().__init__(None)
        if not 0.0 <= probability <= 1.0:
            raise FaultError(f"drop: probability {probability} given, allowed 0..1")
        self.spares = True
        self._probability: Final[float] = probability
        self._rng: Generator | None = None

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Keep the stream."""
        self.saturated = 0
        self._rng = rng
        return True

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """None, or the frame itself when the draw spares it."""
        if self._probability >= 1.0:
            return None
        assert self._rng is not None
        return None if self._rng.random() < self._probability else frame

    def __reduce__(self) -> tuple[type["Drop"], tuple[float], dict[str, object]]:
        state: dict[str, object] = {"_rng": self._rng}
        return Drop, (self._probability,), state


@final
class BitFlip(Fault):
    """Bits are inverted: out = in XOR mask.

    signal: bit positions count from its lowest bit; None: from bit 0 of byte 0 of the payload (little endian).
    count: how many distinct bits are drawn, >= 1; bits: given positions instead (count is then not used);
    fixed: drawn bits stay for the whole activation, otherwise every frame gets new ones.
    A payload with fewer bits than asked for passes unchanged and is counted.
    EN 50159: corruption, above the CRC. FIBlock: Bit flips; that draws with replacement (a bit drawn twice cancels) and
    reaches only the 32 low mantissa bits of a double, here every bit of the wire value can be hit.
    """

    def __init__(
        self, signal: Signal | None, count: int = 1, bits: tuple[int, ...] | None = None, fixed: bool = False
    ) -> None:
        super().__init__(signal)
        length = 64 if signal is None else signal.length
        if bits is None and not 1 <= count <= length:
            raise FaultError(f"bit_flip: {count} bits asked for, allowed 1..{length}")
        given = 0
        for bit in bits if bits is not None else ():
            if not 0 <= bit < length or given >> bit & 1:
                raise FaultError(f"bit_flip: bits {bits} given, allowed are distinct positions 0..{length - 1}")
            given |= 1 << bit
        if bits is not None and not given:
            raise FaultError(f"bit_flip: no bits given, allowed are one or more positions 0..{length - 1}")
        self._start: Final[int] = 0 if signal is None else signal.start
        self._length: Final[int] = 0 if signal is None else signal.length
        self._count: Final[int] = count
        self._bits: Final[tuple[int, ...] | None] = bits
        self._given: Final[int] = given
        self._fixed: Final[bool] = fixed
        self._mask: int = given
        self._rng: Generator | None = None

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Keep the stream; fixed bits are drawn with the first frame, whose length they need."""
        self.saturated = 0
        self._mask = self._given
        self._rng = rng
        return True

    def fits(self, frame: Frame) -> bool:
        """The frame holds the signal, or for a payload all the bits to invert."""
        if self.signal is not None:
            return self.signal.fits(frame.data)
        need = self._mask.bit_length() if self._mask else self._count
        return need <= 8 * len(frame.data)

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame with its bits inverted."""
        size = len(frame.data)
        mask = self._mask
        if mask == 0:
            assert self._rng is not None
            mask = distinct_bits(self._rng, self._count, self._length if self._length else 8 * size)
            if self._fixed:
                self._mask = mask
        word = int.from_bytes(frame.data, "little") ^ mask << self._start
        return with_payload(frame, word.to_bytes(size, "little"))

    def __reduce__(
        self,
    ) -> tuple[type["BitFlip"], tuple[Signal | None, int, tuple[int, ...] | None, bool], dict[str, object]]:
        state: dict[str, object] = {"_mask": self._mask, "_rng": self._rng}
        return BitFlip, (self.signal, self._count, self._bits, self._fixed), state


def distinct_bits(rng: Generator, count: int, length: int) -> int:
    """A mask of `count` distinct bits below `length`, every set equally likely.

    Source: R. Floyd, in J. Bentley, "Programming pearls: a sample of brilliance", CACM 30 (1987) 754.
    """
    mask = 0
    for top in range(length - count, length):
        bit = 1 << int(rng.random() * (top + 1))
        mask |= 1 << top if mask & bit else bit
    return mask
