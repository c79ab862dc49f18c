"""What the hub does with the bytes of its clients: several named buses, fast or timed. No socket, no clock.

A fast bus gives every frame to all other clients at once, in order of arrival. A timed bus is the emulated Medium:
transmit queues, arbitration and exact bit times, served against the clock by absolute times, so that a late wake-up
moves no frame. Source: docs/hub.md (records), canopen_exo/bus/medium.py (timed).
Here nobody needs to acknowledge: a client alone on its bus sends without error, as on a vcan interface. `hub_errors`
has the timed bus on which errors happen.
"""

from collections.abc import Callable
from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.hub_wire import (
    FLAG_ERROR,
    FLAG_OWN,
    KIND_FD_FRAME,
    KIND_FRAME,
    KIND_HELLO,
    KIND_OVERRUN,
    KIND_REFUSED,
    KIND_REJECTED,
    KIND_SENT,
    LONG,
    LOST_RECEIVING,
    LOST_SENDING,
    OPTION_CONFIRM,
    OPTION_OWN,
    SHORT,
    STAMP,
    STAMP_AT,
    HubRecordError,
    Welcome,
    frame_fault,
    pack_count,
    pack_frame,
    pack_record,
    pack_text,
    unpack_frame,
    unpack_hello,
    unpack_record,
)
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import NEVER, Node

OUTBOX_LIMIT: Final = 1 << 20
"""Bytes kept for a client that does not read, beside the kernel's own buffers: 43,690 classical frames."""

CONFIRM_EVERY: Final = 16
"""Frames a confirmation is put off by: a quarter of a transmit queue, so that a waiting sender never runs dry."""

MAX_BUSES: Final = 256
"""Bus names one hub knows, so that a client cannot fill its memory with names."""


@final
class Client:
    """One connection. label: for messages; inbox: an incomplete record; outbox: bytes to be written.

    bus: None before the hello. refusal: why it was refused; nothing more is read from it then.
    skipped: frames dropped for it since it was last told; port: its place on a timed medium.
    overflow: its own frames dropped since it was last told; unconfirmed: its frames that left without a word.
    """

    def __init__(self, label: str) -> None:
        self.label: Final[str] = label
        self.bus: SharedBus | None = None
        self.options: int = 0
        self.inbox: bytes = b""
        self.outbox: Final[bytearray] = bytearray()
        self.refusal: str = ""
        self.skipped: int = 0
        self.port: int = -1
        self.overflow: int = 0
        self.unconfirmed: int = 0

    def offer(self, records: bytes | bytearray, frames: int) -> int:
        """Put records into the outbox; returns how many frames were dropped because it is full: all or none."""
        outbox = self.outbox
        if self.skipped:
            if len(outbox) > OUTBOX_LIMIT // 2:  # not one frame in, one out: a gap is one gap
                self.skipped += frames
                return frames
            self.tell_overrun()
        if len(outbox) + len(records) > OUTBOX_LIMIT:
            self.skipped += frames
            return frames
        outbox.extend(records)
        return 0

    def tell_overrun(self) -> None:
        """It reads again: how many frames it missed, at the place where they are missing."""
        self.outbox.extend(pack_count(KIND_OVERRUN, LOST_RECEIVING, self.skipped))
        self.skipped = 0

    def tell_overflow(self) -> None:
        """How many of its own frames were dropped; put off while it does not read."""
        if self.overflow and len(self.outbox) < OUTBOX_LIMIT:
            self.outbox.extend(pack_count(KIND_OVERRUN, LOST_SENDING, self.overflow))
            self.overflow = 0

    def tell_sent(self) -> None:
        """How many of its own frames have left, some at a time; put off while it does not read."""
        if self.unconfirmed >= CONFIRM_EVERY and len(self.outbox) < OUTBOX_LIMIT:
            self.outbox.extend(pack_count(KIND_SENT, 0, self.unconfirmed))
            self.unconfirmed = 0


class SharedBus:
    """One named bus. frames: carried; skipped: dropped for clients that did not read; most: clients at once;
    overflows: dropped at full transmit queues; rejected: not carried because this bus cannot."""

    wake_at: int

    def __init__(self, name: str) -> None:
        self.name: Final[str] = name
        self.wake_at = NEVER
        self.clients: Final[list[Client]] = []
        self.frames: int = 0
        self.skipped: int = 0
        self.overflows: int = 0
        self.rejected: int = 0
        self.most: int = 0

    def join(self, client: Client, now: int) -> None:
        """Connect a client."""
        self.clients.append(client)
        client.bus = self
        self.most = max(self.most, len(self.clients))

    def leave(self, client: Client) -> None:
        """Disconnect a client; its frames that wait are still sent."""
        self.clients.remove(client)
        client.bus = None

    def carry(self, client: Client, data: bytes, now: int) -> int:
        """Take the complete records in `data`; returns the bytes used. Raises HubRecordError at one that is none."""
        raise NotImplementedError

    def wake(self, now: int) -> None:
        """Deliver what has ended by `now`."""

    def settle(self, now: int) -> None:
        """All that has come by `now` is queued: an idle bus starts its next frame."""


def record_size(data: bytes, at: int, end: int) -> int:
    """Bytes of the frame record at `at`, 0 while it is incomplete; raises HubRecordError when it is none."""
    kind = data[at]
    if kind == KIND_FRAME:
        size = SHORT
    elif kind == KIND_FD_FRAME:
        size = LONG
    else:
        raise HubRecordError(
            f"record of kind {kind} given, a client sends {KIND_FRAME} or {KIND_FD_FRAME} after its hello"
        )
    if end - at < size:
        return 0
    fault = frame_fault(data, at)
    if fault:
        raise HubRecordError(fault)
    return size


@final
class FastBus(SharedBus):
    """Every frame to all other clients at once, in order of arrival; the stamp is the time of arrival at the hub."""

    def carry(self, client: Client, data: bytes, now: int) -> int:
        """Stamp and pass on."""
        end = len(data)
        stamp = STAMP.pack(now)
        stamped = bytearray(data)
        at = 0
        frames = 0
        try:
            while at < end:
                size = record_size(data, at, end)
                if size == 0:
                    break
                stamped[at + STAMP_AT : at + STAMP_AT + 8] = stamp
                at += size
                frames += 1
        finally:  # what came before a corrupt record is good
            if frames:
                self._deliver(client, stamped, at, frames)
        return at

    def _deliver(self, client: Client, stamped: bytearray, size: int, frames: int) -> None:
        self.frames += frames
        del stamped[size:]
        for other in self.clients:
            if other is not client:
                self.skipped += other.offer(stamped, frames)
        if client.options & OPTION_OWN:
            at = 0
            while at < size:
                stamped[at + 1] |= FLAG_OWN
                at += SHORT if stamped[at] == KIND_FRAME else LONG
            self.skipped += client.offer(stamped, frames)


class TimedBus(SharedBus):
    """The emulated Medium against the clock. bitrate: bit/s. lateness: delivery - end of the frame, ns.

    seats: the client at each port, None where nobody is any more.
    """

    def __init__(self, name: str, index: int, bitrate: int) -> None:
        super().__init__(name)
        self.medium: Final[Medium] = Medium(name, index, bitrate)
        self.lateness: Final[Lateness] = Lateness()
        self.seats: Final[list[Client | None]] = []

    def join(self, client: Client, now: int) -> None:
        """Connect a client to a port that nobody uses any more, or to a new one."""
        super().join(client, now)
        medium = self.medium
        for port, seat in enumerate(self.seats):
            there = medium.ports[port]
            on_the_wire = medium.end != NEVER and medium.on_wire[1] is there
            if seat is None and there.queued == 0 and not on_the_wire:
                client.port = port
                self.seats[port] = client
                return
        client.port = medium.attach(Node()).number
        self.seats.append(client)

    def leave(self, client: Client) -> None:
        """Disconnect a client; its frames that wait are still sent."""
        super().leave(client)
        self.seats[client.port] = None

    def carry(self, client: Client, data: bytes, now: int) -> int:
        """Put the frames into the client's transmit queue."""
        end = len(data)
        at = 0
        try:
            while at < end:
                size = record_size(data, at, end)
                if size == 0:
                    break
                self.queue_frame(client, data, at)
                at += size
        finally:
            client.tell_overflow()
        return at

    def queue_frame(self, client: Client, data: bytes, at: int) -> None:
        """One record of a client, checked before."""
        if data[at] == KIND_FD_FRAME:
            self._reject(client, data, at, "CAN FD frame on a timed hub, which emulates classical CAN; use a fast hub")
        elif data[at + 1] & FLAG_ERROR:
            self._reject(client, data, at, "error frame: the notice of a controller, which nobody sends on a timed hub")
        else:
            port = self.medium.ports[client.port]
            before = port.dropped
            self.medium.queue(port, unpack_frame(data, at))
            if port.dropped != before:
                self.overflows += 1
                client.overflow += 1

    def _reject(self, client: Client, data: bytes, at: int, why: str) -> None:
        self.rejected += 1
        can_id, _, _, _, _ = unpack_record(data, at)
        if len(client.outbox) < OUTBOX_LIMIT:
            client.outbox.extend(pack_text(KIND_REJECTED, f"frame {can_id:03X} not carried: {why}"))
        else:  # it does not read: counted at least
            client.overflow += 1

    def wake(self, now: int) -> None:
        """Deliver the frames that have ended, each followed at once by the next that waits."""
        medium = self.medium
        while medium.end <= now:
            end = medium.end
            frame, sender = medium.on_wire
            medium.end = NEVER
            self.lateness.add(now - end)
            self._deliver(end, frame, self.seats[sender.number])
            if medium.waiting:
                medium.arbitrate(end)
        self.wake_at = medium.end

    def settle(self, now: int) -> None:
        """An idle bus starts the winner of all that waits."""
        medium = self.medium
        if medium.end == NEVER and medium.waiting:
            medium.arbitrate(now)
            self.wake_at = medium.end

    def _deliver(self, end: int, frame: Frame, sender: Client | None) -> None:
        self.frames += 1
        record = pack_frame(frame, end)
        for client in self.clients:
            if client is not sender:
                self.skipped += client.offer(record, 1)
        if sender is None:  # it has left since
            return
        if sender.options & OPTION_CONFIRM:
            sender.unconfirmed += 1
            sender.tell_sent()
        if sender.options & OPTION_OWN:
            own = pack_record(frame.can_id, frame.flags | FLAG_OWN, frame.dlc, frame.data, end)
            self.skipped += sender.offer(own, 1)


MakeBus = Callable[[str, int, int, int], SharedBus]


@final
class Hub:
    """All buses and what came of their clients. bitrate: bit/s of timed buses, 0: fast buses.

    make_timed: makes a timed bus of a name, an index, a bit rate and the time; one on which errors happen, for example.
    realtime_offset_ns: CLOCK_REALTIME - the hub's clock, for the welcome. refused: clients refused;
    wake_at: when `wake` is to be called next.
    """

    def __init__(self, bitrate: int, make_timed: MakeBus | None = None) -> None:
        self.bitrate: Final[int] = bitrate
        self._make_timed: Final[MakeBus | None] = make_timed
        self.buses: Final[dict[str, SharedBus]] = {}
        self.realtime_offset_ns: int = 0
        self.refused: int = 0
        self.wake_at: int = NEVER

    def received(self, client: Client, data: bytes, now: int) -> None:
        """Bytes came from a client at `now` [ns]."""
        if client.refusal or not data:
            return
        self.wake(now)  # of a hub held up: what ended before these bytes came was followed by what waited then
        if client.inbox:
            data = client.inbox + data
        try:
            bus = client.bus
            at = 0
            if bus is None:
                if data[0] == KIND_HELLO and len(data) < LONG:  # what starts like no hello is not waited for
                    client.inbox = data
                    return
                bus = self._admit(client, data, now)
                at = LONG
            used = at + bus.carry(client, data[at:] if at else data, now)
        except HubRecordError as error:
            self.refuse(client, str(error))
            return
        client.inbox = data[used:] if used < len(data) else b""

    def left(self, client: Client) -> None:
        """The client has closed its side, or the connection broke."""
        if client.refusal:
            return
        if client.inbox:
            self.refuse(client, f"closed within a record, after {len(client.inbox)} of its bytes")
        elif client.bus is not None:
            client.bus.leave(client)

    def refuse(self, client: Client, why: str) -> None:
        """Tell the client why it is disconnected; count it."""
        self.refused += 1
        client.refusal = why
        client.inbox = b""
        client.outbox.extend(pack_text(KIND_REFUSED, why))
        if client.bus is not None:
            client.bus.leave(client)

    def drained(self, client: Client) -> None:
        """Its outbox has been written: what was dropped or sent meanwhile is told, if no later frame brought it."""
        if client.bus is None:
            return
        if client.skipped:
            client.tell_overrun()
        client.tell_overflow()
        client.tell_sent()

    def wake(self, now: int) -> None:
        """Deliver what has ended by `now`."""
        for bus in self.buses.values():
            if bus.wake_at <= now:
                bus.wake(now)

    def settle(self, now: int) -> None:
        """Everything that has come by `now` was given to `received`."""
        wake = NEVER
        for bus in self.buses.values():
            bus.settle(now)
            if bus.wake_at < wake:
                wake = bus.wake_at
        self.wake_at = wake

    def _admit(self, client: Client, data: bytes, now: int) -> SharedBus:
        """Take the hello: the client joins the bus it names."""
        name, client.options = unpack_hello(data[:LONG])
        bus = self.buses.get(name)
        if bus is None:
            if len(self.buses) >= MAX_BUSES:
                raise HubRecordError(f"bus {name!r} would be one more than the {MAX_BUSES} this hub keeps; restart it")
            bus = self._make(name, now)
            self.buses[name] = bus
        bus.join(client, now)
        client.outbox.extend(Welcome(self.bitrate, now, now + self.realtime_offset_ns).pack())
        return bus

    def _make(self, name: str, now: int) -> SharedBus:
        if not self.bitrate:
            return FastBus(name)
        if self._make_timed is None:
            return TimedBus(name, len(self.buses), self.bitrate)
        return self._make_timed(name, len(self.buses), self.bitrate, now)
