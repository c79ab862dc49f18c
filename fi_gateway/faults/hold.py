"""Faults that put a kept or given value in the place of the one that came: held, replaced, late.

Source: Fabarisov et al., ESREL 2020 (FIBlock), for stuck-at, package drop and time delay.
The CRC of the changed frame is valid: that models a fault upstream of the sender's CAN controller (sensor, memory,
firmware), never line noise.
"""

from typing import Final, final

from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.signal import Signal
from fi_gateway.errors import FaultError
from fi_gateway.faults.base import Fault, with_payload
from fi_gateway.outlet import Outlet


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

    EN 50159: corruption. FIBlock: the paper's Stuck-at-0 ("Stuck-at" with a constant), and Package drop, which also
    puts a given value in the place of the signal and loses no frame; no deviation.
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
class TimeDelay(Fault):
    """The signal lags: out(t) = in(t - lag) from t0 + lag on, and in(last before t0) until then.

    lag_ns: > 0. in(t): the value of the last frame that arrived at or before t. The frames themselves are on time.
    Waits when no value is known yet, as StuckAt does. With the end of the window the fresh values are back at once.
    EN 50159: delay (of content; the frame is fresh). FIBlock: Time delay; there the frozen part is the whole
    activation, then one sample is skipped and a lag of one sample less stays for ever, and lags of several activations
    add up; here the lag is given, exact, and ends with the window.
    """

    def __init__(self, signal: Signal, lag_ns: int) -> None:
        super().__init__(signal)
        if lag_ns <= 0:
            raise FaultError(f"time_delay: lag {lag_ns} ns given, allowed 1 ns and more")
        self._target: Final[Signal] = signal
        self._lag_ns: Final[int] = lag_ns
        self._raw: int = 0
        self._times: list[int] = []
        self._raws: list[int] = []

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        """Take the value from before; False while there is none."""
        self.saturated = 0
        last = held.get(self._target.cob_id)
        if last is None:
            return False
        self._raw = self._target.read(last.data)
        return True

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        """The frame with the value of `lag_ns` ago."""
        times, raws = self._times, self._raws
        times.append(now)
        raws.append(self._target.read(frame.data))
        while times and times[0] <= now - self._lag_ns:
            times.pop(0)
            self._raw = raws.pop(0)
        return with_payload(frame, self._target.write(frame.data, self._raw))

    def end(self) -> None:
        """Forget the values on their way."""
        self._times.clear()
        self._raws.clear()

    def __reduce__(self) -> tuple[type["TimeDelay"], tuple[Signal, int], dict[str, object]]:
        state: dict[str, object] = {"_raw": self._raw, "_times": self._times, "_raws": self._raws}
        return TimeDelay, (self._target, self._lag_ns), state
