"""A timed bus of the hub on which errors happen: who is told, what is confirmed, what a client that leaves does."""

from collections.abc import Callable
from typing import Protocol

import can
import pytest

from canopen_exo.bus.disturbance import ALL, FLIP, Disruption, Disturbance
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.hub import HubServer
from canopen_exo.bus.hub_core import Client, Hub, SharedBus
from canopen_exo.bus.hub_errors import ErrorBus
from canopen_exo.bus.hub_wire import (
    FLAG_ERROR,
    KIND_SENT,
    OPTION_CONFIRM,
    RECORD_SIZE,
    pack_frame,
    pack_hello,
    unpack_record,
)
from canopen_exo.bus.medium import QUEUE_LENGTH
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.bus.recovery import RECESSIVE_BITS

MBIT = 1_000_000
BIT = 1000
FRAME = Frame(0x181, bytes(8))
LENGTH = FRAME.measure()
PATIENCE_S = 20.0


class Hits(Disturbance):
    """The CRC delimiter of the first so many attempts of this frame, seen by these ports."""

    def __init__(self, attempts: int, ports: int = ALL) -> None:
        self.attempts = attempts
        self.ports = ports

    def errors(self, now: int, until: int, bit_ns: int, frame: Frame | None, sender: int) -> list[Disruption]:
        if frame is None or self.attempts == 0:
            return []
        self.attempts -= 1
        at = frame.measure() - 13
        return [Disruption(FLIP, at, at + 1, self.ports)]


class Running(Protocol):
    server: HubServer
    address: str


StartHub = Callable[..., Running]


def hub_with(*disturbances: Disturbance) -> Hub:
    def make(name: str, index: int, bitrate: int, now: int) -> SharedBus:
        return ErrorBus(name, index, bitrate, list(disturbances))

    return Hub(MBIT, make)


def join(hub: Hub, options: int = 0, now: int = 0) -> Client:
    client = Client("test")
    hub.received(client, pack_hello("drive", options), now)
    client.outbox.clear()
    return client


def bus_of(hub: Hub) -> ErrorBus:
    bus = hub.buses["drive"]
    assert isinstance(bus, ErrorBus)
    return bus


def told(client: Client) -> list[tuple[int, int, int, str]]:
    """Kind, id, flags, data of all records; empties the outbox."""
    data = bytes(client.outbox)
    client.outbox.clear()
    found, at = [], 0
    while at < len(data):
        can_id, flags, _, payload, _ = unpack_record(data, at)
        found.append((data[at], can_id, flags, payload.hex()))
        at += RECORD_SIZE[data[at]]
    return found


def send(hub: Hub, client: Client, count: int = 1, now: int = 0) -> None:
    hub.received(client, pack_frame(FRAME) * count, now)
    hub.settle(now)


def run(hub: Hub, until: int) -> None:
    while hub.wake_at <= until:
        now = hub.wake_at
        hub.wake(now)
        hub.settle(now)


def test_frames_pass_as_on_any_timed_bus() -> None:
    """Nothing happens: one record at the exact end."""
    hub = hub_with()
    sender, receiver = join(hub), join(hub)
    send(hub, sender)
    run(hub, MS)
    assert told(receiver) == [(1, 0x181, 0, bytes(8).hex())]
    assert told(sender) == []


def test_error_is_told_to_all_and_counters_to_its_own_client() -> None:
    """SocketCAN classes; the sender noticed first, the others do not learn its TEC."""
    hub = hub_with(Hits(1))
    sender, receiver = join(hub), join(hub)
    send(hub, sender)
    run(hub, MS)
    assert told(sender) == [(1, 0x288, FLAG_ERROR, "0000901800000800")]
    assert told(receiver) == [(1, 0x088, FLAG_ERROR, "0000101800000000"), (1, 0x181, 0, bytes(8).hex())]


def test_client_alone_is_not_acknowledged_until_another_joins() -> None:
    """Error-passive at TEC 128, and it goes on trying."""
    hub = hub_with()
    sender = join(hub)
    send(hub, sender)
    run(hub, 10 * MS)
    assert bus_of(hub).medium.ports[0].tec == 128
    states = [one[3] for one in told(sender) if one[1] == 0x204]
    assert states == ["0008000000006000", "0020000000008000"]
    receiver = join(hub)
    run(hub, 11 * MS)
    assert [one[1] for one in told(receiver) if not one[2]] == [0x181]


def test_bus_off_client_hears_nothing_and_its_frames_are_confirmed_as_gone() -> None:
    """A sender that waits for confirmations must not wait for ever; the restart is told."""
    hub = hub_with(Hits(32))
    sender, receiver = join(hub, OPTION_CONFIRM), join(hub)
    send(hub, sender, QUEUE_LENGTH)
    run(hub, 50 * MS)
    bus = bus_of(hub)
    assert bus.medium.ports[0].lost == QUEUE_LENGTH
    found = told(sender)
    assert sum(one[1] for one in found if one[0] == KIND_SENT) == QUEUE_LENGTH
    assert (1, 0x240, FLAG_ERROR, "000000000000ff00") in found
    other = join(hub)
    send(hub, receiver, 1, 50 * MS)
    run(hub, 60 * MS)
    assert told(sender) == []
    assert [one[1] for one in told(other)] == [0x181]
    run(hub, 200 * MS)
    assert [one[1] for one in told(sender)] == [0x304]


def test_every_frame_that_left_is_confirmed_once() -> None:
    """Also one that had to be repeated."""
    hub = hub_with(Hits(3))
    sender = join(hub, OPTION_CONFIRM)
    join(hub)
    send(hub, sender, 10)
    run(hub, 10 * MS)
    assert sum(one[1] for one in told(sender) if one[0] == KIND_SENT) == 10


def test_client_that_leaves_takes_its_frames_along_and_acknowledges_no_more() -> None:
    """Its seat is free for the next one."""
    hub = hub_with()
    sender, receiver = join(hub), join(hub)
    send(hub, sender, 3)
    run(hub, LENGTH * BIT // 2)
    hub.left(receiver)
    run(hub, 5 * MS)
    bus = bus_of(hub)
    assert bus.medium.ports[0].tec > 0
    hub.left(sender)
    run(hub, 6 * MS)
    assert (bus.medium.waiting, bus.wake_at) == ([], NEVER)
    again = join(hub)
    other = join(hub)
    assert {again.port, other.port} == {0, 1}
    send(hub, again, 1, 7 * MS)
    run(hub, 8 * MS)
    assert [one[1] for one in told(other)] == [0x181]


@pytest.mark.parametrize("step", [1, 50_000, 10_000_000])
def test_late_hub_moves_no_frame(step: int) -> None:
    """However late it is woken, stamps are the exact ends."""
    hub = hub_with(Hits(5))
    sender, receiver = join(hub), join(hub)
    send(hub, sender, 5)
    ends = []
    while hub.wake_at != NEVER:
        now = hub.wake_at + step
        hub.wake(now)
        hub.settle(now)
        data = bytes(receiver.outbox)
        receiver.outbox.clear()
        ends += [unpack_record(data, at)[4] // BIT for at in range(0, len(data), 24) if not data[at + 1]]
    failed = LENGTH - 12 + 6 + 8 + 3
    assert ends == [RECESSIVE_BITS + 5 * failed + (one + 1) * LENGTH for one in range(5)]


def test_client_that_joins_within_a_frame_neither_hears_it_nor_sends_before_its_end() -> None:
    """It takes part once it has seen 11 recessive bits, which the end of a frame has."""
    hub = hub_with()
    sender, receiver = join(hub), join(hub)
    send(hub, sender, 2)
    run(hub, (RECESSIVE_BITS + LENGTH // 2) * BIT)
    late = join(hub, now=(RECESSIVE_BITS + LENGTH // 2) * BIT)
    send(hub, late, 1, (RECESSIVE_BITS + LENGTH // 2) * BIT)
    run(hub, 5 * MS)
    assert [one[1] for one in told(receiver)] == [0x181] * 3
    assert [one[1] for one in told(late)] == [0x181]  # the sender's second


def test_client_that_joins_an_idle_bus_waits_for_11_bits() -> None:
    """Its own frame begins then."""
    hub = hub_with()
    sender, _ = join(hub), join(hub)
    run(hub, MS)
    late = join(hub, now=MS)
    send(hub, late, 1, MS)
    run(hub, MS + (RECESSIVE_BITS - 1) * BIT)
    assert bus_of(hub).medium.end == NEVER
    run(hub, MS + (RECESSIVE_BITS + LENGTH) * BIT)
    assert [one[1] for one in told(sender)] == [0x181]


def test_client_that_has_just_joined_acknowledges_no_frame_that_it_does_not_hear() -> None:
    """The sender was alone until then: the frame is repeated until the other one takes part."""
    hub = hub_with()
    sender = join(hub)
    run(hub, MS)
    late = join(hub, now=MS)
    send(hub, sender, 1, MS + 5 * BIT)
    run(hub, 5 * MS)
    assert [one[1] for one in told(late) if not one[2]] == [0x181]
    assert [one[1] for one in told(sender)] == [0x2A0]  # one error frame: no acknowledgement
    assert bus_of(hub).medium.ports[0].tec == 8 - 1


def test_python_can_shows_error_frames(start_hub: StartHub) -> None:
    """`is_error_frame`, with the classes of linux/can/error.h."""

    def make(name: str, index: int, bitrate: int, now: int) -> SharedBus:
        return ErrorBus(name, index, bitrate, [Hits(1)])

    hub = start_hub(bitrate=MBIT, make_timed=make)
    channel = f"{hub.address}/drive"
    with can.Bus(interface="hub", channel=channel) as one, can.Bus(interface="hub", channel=channel) as two:
        one.send(can.Message(arbitration_id=0x181, data=bytes(8), is_extended_id=False))
        error, frame = two.recv(PATIENCE_S), two.recv(PATIENCE_S)
        own = one.recv(PATIENCE_S)
    assert error is not None
    assert frame is not None
    assert own is not None
    assert (error.is_error_frame, error.arbitration_id) == (True, 0x088)
    assert (frame.is_error_frame, frame.arbitration_id) == (False, 0x181)
    assert (own.is_error_frame, own.arbitration_id, own.data[6]) == (True, 0x288, 8)
