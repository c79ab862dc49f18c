"""Faults below the payload: bits, acknowledgement, error states. They need the emulated medium with a Wire on it.

A frame that these faults hit is noticed as wrong by its receivers or its sender and sent again, so they cost time, not
data. The exception is real: of errors that only some receivers see, some double ones leave a valid CRC. (A payload that
is wrong because a sensor, a memory or a program is, models something upstream of the CAN controller: that is made by
the faults of a gateway.)
Every fault acts from `begin` to `end`, on the bits that its window touches. Ports are numbers on the medium. Copies are
made without who is told (`watch`): whoever has been copied as well listens again.
Sources: ISO 11898-1 for what the bits are; E. N. Gilbert, "Capacity of a burst-noise channel", Bell System Technical
Journal 39 (1960), and E. O. Elliott, ibid. 42 (1963), for bursts.
"""

from typing import Final, final

import numpy as np
from mypy_extensions import mypyc_attr

from canopen_exo.bus.bit_stream import FIELDS, field_positions
from canopen_exo.bus.disturbance import ALL, DOMINANT, FLIP, NO_ACK, Disruption, Disturbance
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import MediumOut
from canopen_exo.bus.node import NEVER, Node, Out
from fi_gateway.errors import FaultError

_LOOK_AHEAD_NS: Final = 1_000_000
"""How far noise is drawn ahead of an idle bus: the next flip may lie beyond the end of the run."""

_ACK_SLOT_TO_END: Final = 12
"""ACK slot and delimiter, end of frame and intermission (ISO 11898-1)."""


@mypyc_attr(allow_interpreted_subclasses=True)
class WireWatch:
    """Who is told what a wire fault does."""

    def disturbed(self, now: int, frame: Frame | None) -> None:
        """It has disturbed an attempt to send `frame` (None: an idle bus), or added `frame`."""


class WireFault(Disturbance):
    """A disturbance with a window [since, until), ns.

    seen: attempts to send a frame that it could disturb, in this window or the last one, and times at which it
    disturbed an idle bus; watch: who is told.
    """

    def __init__(self) -> None:
        self.since: int = NEVER
        self.until: int = NEVER
        self.seen: int = 0
        self.watch: WireWatch = WireWatch()
        self._seen_ns: int = -1

    def begin(self, now: int, until: int = NEVER) -> None:
        """Act from `now` on, and no longer from `until` on (NEVER: not known yet)."""
        self.since, self.until = now, until
        self.seen, self._seen_ns = 0, -1

    def draw_from(self, rng: np.random.Generator) -> None:
        """The stream for what it draws; for those that draw nothing, nothing."""

    def disturbed(self, now: int, frame: Frame | None) -> None:
        """Tell it on. Idle bits count as an attempt where an error on them was noticed."""
        if frame is None:
            self.seen += 1
        self.watch.disturbed(now, frame)

    def end(self, now: int) -> None:
        """Act no longer from `now` on."""
        self.until = min(self.until, now)

    def meets(self, now: int, until: int, frame: Frame | None) -> bool:
        """Whether an attempt from `now` to `until` and the window touch; the attempt is then counted, once."""
        if until <= self.since or now >= self.until:
            return False
        if frame is not None and now != self._seen_ns:
            self._seen_ns = now
            self.seen += 1
        return True

    def touches(self, start_ns: int, end_ns: int) -> bool:
        """Whether the window has an instant in common with [start_ns, end_ns)."""
        return self.since < end_ns and start_ns < self.until

    def state(self) -> dict[str, object]:
        """What a copy needs besides the arguments."""
        return {"since": self.since, "until": self.until, "seen": self.seen, "_seen_ns": self._seen_ns}


class FrameFault(WireFault):
    """One that acts on certain frames: with these COB-IDs (empty: any), sent by these ports (mask)."""

    def __init__(self, cob_ids: tuple[int, ...], senders: int) -> None:
        super().__init__()
        self.cob_ids: Final[tuple[int, ...]] = cob_ids
        self.senders: Final[int] = senders

    def concerns(self, now: int, until: int, frame: Frame, sender: int) -> bool:
        """Whether it may act on this attempt, which is then counted."""
        if not self.senders >> sender & 1:
            return False
        if self.cob_ids and (frame.flags or frame.can_id not in self.cob_ids):
            return False
        return self.meets(now, until, frame)


def mask_of(ports: list[int]) -> int:
    """Port numbers as a mask."""
    mask = 0
    for port in ports:
        if port < 0:
            raise FaultError(f"wire fault: port {port} given, allowed 0 and more")
        mask |= 1 << port
    return mask


@final
class BitError(FrameFault):
    """One bit of a frame is seen inverted: bit' = 1 - bit.

    field: one of `FIELDS`; bit: its index there, from 0, stuff bits not counted; receivers: mask of those who see it
    (also the sender, if its port is in it); cob_ids, senders: of the frames it hits.
    EN 50159: corruption, detected by the CAN controller, so it appears as a delay, or as a deletion. FIBlock: none.
    """

    def __init__(
        self, field: str, bit: int, receivers: int = ALL, cob_ids: tuple[int, ...] = (), senders: int = ALL
    ) -> None:
        super().__init__(cob_ids, senders)
        if field not in FIELDS:
            raise FaultError(f"bit_error: field {field!r} given, allowed {', '.join(FIELDS)}")
        if bit < 0:
            raise FaultError(f"bit_error: bit {bit} given, allowed 0 and more")
        self.field: Final[str] = field
        self.bit: Final[int] = bit
        self.receivers: Final[int] = receivers

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        """The bit of this frame, if it is one of those and the window touches the bit."""
        if frame is None or not self.concerns(now, until, frame, sender):
            return []
        positions = field_positions(frame, self.field)
        if self.bit >= len(positions):
            return []
        at = positions[self.bit]
        if not self.touches(now + at * bit_ns, now + (at + 1) * bit_ns):
            return []
        return [Disruption(FLIP, at, at + 1, self.receivers)]

    def __reduce__(self) -> tuple[type["BitError"], tuple[str, int, int, tuple[int, ...], int], dict[str, object]]:
        return BitError, (self.field, self.bit, self.receivers, self.cob_ids, self.senders), self.state()


@final
class StuckDominant(WireFault):
    """The bus is dominant, whoever sends what: bit' = 0. A short circuit, or a transceiver that does not let go.

    EN 50159: deletion (of everything). FIBlock: none.
    """

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        """All bits that the window touches."""
        if not self.meets(now, until, frame):
            return []
        first = max(self.since - now, 0) // bit_ns
        end = (min(self.until, now + (1 << 40)) - now + bit_ns - 1) // bit_ns
        return [Disruption(DOMINANT, first, end)]

    def next_ns(self, after: int) -> int:
        """All the time."""
        if after >= self.until:
            return NEVER
        return max(after, self.since)

    def __reduce__(self) -> tuple[type["StuckDominant"], tuple[()], dict[str, object]]:
        return StuckDominant, (), self.state()


@final
class NoAck(FrameFault):
    """These receivers do not acknowledge (mask, ALL: nobody does): ACK slot recessive unless another one answers.

    EN 50159: delay; the sender repeats, and becomes error-passive. FIBlock: none.
    """

    def __init__(self, receivers: int = ALL, cob_ids: tuple[int, ...] = (), senders: int = ALL) -> None:
        super().__init__(cob_ids, senders)
        self.receivers: Final[int] = receivers

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        """For every such frame whose ACK slot the window touches."""
        if frame is None or not self.concerns(now, until, frame, sender):
            return []
        at = frame.measure() - _ACK_SLOT_TO_END
        if not self.touches(now + at * bit_ns, now + (at + 1) * bit_ns):
            return []
        return [Disruption(NO_ACK, at, at + 1, self.receivers)]

    def __reduce__(self) -> tuple[type["NoAck"], tuple[int, tuple[int, ...], int], dict[str, object]]:
        return NoAck, (self.receivers, self.cob_ids, self.senders), self.state()


class Noise(WireFault):
    """Bits that are seen inverted at random times, on the bus's own clock, whether something is sent or not.

    rng: one stream of its own, given here or before `begin` (`draw_from`). receivers: mask of those who see it. Draws
    are made as time goes on, a few at a time.
    """

    def __init__(self, bit_ns: int, rng: np.random.Generator | None, receivers: int) -> None:
        super().__init__()
        self.bit_ns: Final[int] = bit_ns
        self.receivers: Final[int] = receivers
        self._rng: np.random.Generator | None = rng
        self._flips: list[int] = []
        self._known_ns: int = 0

    def draw_from(self, rng: np.random.Generator) -> None:
        """Its stream from now on."""
        self._rng = rng

    def begin(self, now: int, until: int = NEVER) -> None:
        """Noise begins: what was drawn for another time does not count."""
        super().begin(now, until)
        self._flips = []
        self._known_ns = now

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        """The bits that are hit."""
        if not self.meets(now, until, frame):
            return []
        while self._known_ns < min(until, self.until):  # nothing is drawn for after the window
            self._draw()
        flips = self._flips
        while flips and flips[0] < now:
            flips.pop(0)
        found: list[Disruption] = []
        for at in flips:
            if at >= until or at >= self.until:
                break
            bit = (at - now) // bit_ns
            found.append(Disruption(FLIP, bit, bit + 1, self.receivers))
        return found

    def next_ns(self, after: int) -> int:
        """The next bit that is hit."""
        if self.since == NEVER:
            return NEVER
        at = 0
        while True:
            while at < len(self._flips):
                if self._flips[at] >= after:
                    return self._flips[at] if self._flips[at] < self.until else NEVER
                at += 1
            if self._known_ns >= self.until:
                return NEVER
            if self._known_ns > after + _LOOK_AHEAD_NS:
                return self._known_ns  # nothing up to there; look again then
            self._draw()

    def _draw(self) -> None:
        """Move `_known_ns` on, with the flips up to there."""
        raise NotImplementedError

    def _gap(self, rate: float) -> int:
        """Time to the next event of a rate per bit, ns: geometric, at least one bit."""
        if self._rng is None:
            raise FaultError("noise: it has no random stream; give rng, or call draw_from before begin")
        return int(self._rng.geometric(rate)) * self.bit_ns

    def state(self) -> dict[str, object]:
        """See WireFault."""
        return {**super().state(), "_flips": self._flips, "_known_ns": self._known_ns}


@final
class BitErrorRate(Noise):
    """Every bit is inverted with the same small probability `rate`, independently of the others: P(flip) = rate.

    EN 50159: corruption, see BitError. FIBlock: none.
    """

    def __init__(
        self, rate: float, bit_ns: int, rng: np.random.Generator | None = None, receivers: int = ALL
    ) -> None:
        super().__init__(bit_ns, rng, receivers)
        _check("bit_error_rate", "rate", rate)
        self.rate: Final[float] = rate

    def _draw(self) -> None:
        self._known_ns += self._gap(self.rate)
        self._flips.append(self._known_ns)

    def __reduce__(
        self,
    ) -> tuple[type["BitErrorRate"], tuple[float, int, np.random.Generator | None, int], dict[str, object]]:
        return BitErrorRate, (self.rate, self.bit_ns, self._rng, self.receivers), self.state()


@final
class GilbertElliott(Noise):
    """Noise in bursts: a two-state Markov chain, one step a bit.

    good -> bad with probability `enter`, bad -> good with `leave`; a bit is inverted with probability `rate_good` or
    `rate_bad`. A share enter / (enter + leave) of the bits is bad, a burst lasts 1 / leave bits on average.
    EN 50159: corruption, see BitError. FIBlock: none (its packet loss in bursts is the gateway's).
    """

    def __init__(
        self, enter: float, leave: float, rate_good: float, rate_bad: float, bit_ns: int,
        rng: np.random.Generator | None = None, receivers: int = ALL,
    ) -> None:  # fmt: skip
        super().__init__(bit_ns, rng, receivers)
        _check("gilbert_elliott", "enter", enter)
        _check("gilbert_elliott", "leave", leave)
        for name, rate in (("rate_good", rate_good), ("rate_bad", rate_bad)):
            if not 0 <= rate <= 1:
                raise FaultError(f"gilbert_elliott: {name} {rate:g} given, allowed 0..1 per bit")
        self.enter: Final[float] = enter
        self.leave: Final[float] = leave
        self.rate_good: Final[float] = rate_good
        self.rate_bad: Final[float] = rate_bad
        self._is_bad: bool = False
        self._change_ns: int = 0

    def begin(self, now: int, until: int = NEVER) -> None:
        """Noise begins, in the good state."""
        super().begin(now, until)
        self._is_bad = False
        self._change_ns = now + self._gap(self.enter)

    def _draw(self) -> None:
        rate = self.rate_bad if self._is_bad else self.rate_good
        at = self._known_ns + self._gap(rate) if rate else NEVER
        if at < self._change_ns:
            self._known_ns = at
            self._flips.append(at)
            return
        self._known_ns = self._change_ns  # the rest of the gap is drawn anew: it has no memory
        self._is_bad = not self._is_bad
        self._change_ns += self._gap(self.leave if self._is_bad else self.enter)

    def __reduce__(
        self,
    ) -> tuple[
        type["GilbertElliott"],
        tuple[float, float, float, float, int, np.random.Generator | None, int],
        dict[str, object],
    ]:
        given = (self.enter, self.leave, self.rate_good, self.rate_bad, self.bit_ns, self._rng, self.receivers)
        return GilbertElliott, given, {**self.state(), "_is_bad": self._is_bad, "_change_ns": self._change_ns}


@final
class BabblingIdiot(Node):
    """A node that wants to send the same frame all the time: whenever its last one has left the queue, the next.

    With id 0 nobody else gets the bus. EN 50159: insertion, delay of everything below it. FIBlock: none.
    watch: who is told of each frame.
    """

    def __init__(self, frame: Frame, bit_ns: int) -> None:
        super().__init__()
        self.frame: Final[Frame] = frame
        self.watch: WireWatch = WireWatch()
        self._bit_ns: Final[int] = bit_ns
        self._until: int = NEVER

    def begin(self, now: int, until: int = NEVER) -> None:
        """Babble from `now` on until `until`; takes effect when the loop next wakes a node."""
        self.wake_at, self._until = now, until

    def end(self, now: int) -> None:
        """Fall silent; what is in the queue still goes."""
        self._until = now

    def wake(self, now: int, out: Out) -> None:
        """Have one frame in the queue at any time."""
        if now >= self._until:
            self.wake_at = NEVER
            return
        if not isinstance(out, MediumOut):
            raise FaultError("babbling_idiot: it has no emulated bus; connect it to a loop in virtual time")
        if out.ports[0].queued == 0:
            out.send(0, self.frame)
            self.watch.disturbed(now, self.frame)
        self.wake_at = now + _SHORTEST_FRAME * self._bit_ns

    def __reduce__(self) -> tuple[type["BabblingIdiot"], tuple[Frame, int], dict[str, object]]:
        state: dict[str, object] = {"wake_at": self.wake_at, "_until": self._until}
        return BabblingIdiot, (self.frame, self._bit_ns), state


_SHORTEST_FRAME: Final = 47
"""Bits of an empty frame without stuff bits: in that time at most one of its frames can leave the queue."""


def _check(fault: str, name: str, rate: float) -> None:
    if not 0 < rate <= 1:
        raise FaultError(f"{fault}: {name} {rate:g} given, allowed above 0 up to 1 per bit")
