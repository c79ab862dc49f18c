"""The timed hub without sockets: who gets which frame when."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.bits import frame_bits
from canopen_exo.bus.frame import FLAG_FD, Frame
from canopen_exo.bus.hub_core import (
    CONFIRM_EVERY,
    Client,
    Hub,
    MakeBus,
    SharedBus,
    TimedBus,
)
from canopen_exo.bus.hub_errors import ErrorBus
from canopen_exo.bus.hub_wire import (
    FLAG_ERROR,
    KIND_OVERRUN,
    KIND_REJECTED,
    KIND_SENT,
    LOST_SENDING,
    OPTION_CONFIRM,
    pack_frame,
    pack_hello,
    pack_record,
)
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import QUEUE_LENGTH, Medium
from canopen_exo.bus.node import NEVER, Node, Out
from tests.canopen_exo.bus.hub_clients import MBIT, counts, frames, join, texts

# --- timed ---------------------------------------------------------------------------------------------------------


def test_timed_hub_delivers_when_the_last_bit_has_passed() -> None:
    """Timed mode: 126 us for id 181 with 8 zero bytes at 1 Mbit/s, intermission included (113 bits + 13)."""
    hub = Hub(MBIT)
    sender, receiver = join(hub), join(hub)
    hub.received(sender, pack_frame(Frame(0x181, bytes(8))), 1_000)
    hub.settle(2_000)
    assert hub.wake_at == 2_000 + 126_000
    hub.wake(hub.wake_at - 1)
    assert not receiver.outbox
    hub.wake(hub.wake_at)
    assert frames(receiver) == [(128_000, Frame(0x181, bytes(8)))]


def test_timed_hub_lets_the_lowest_id_win() -> None:
    """Arbitration among all clients whose frames wait, at every bus idle."""
    hub = Hub(MBIT)
    first, second, receiver = join(hub), join(hub), join(hub)
    hub.received(first, pack_frame(Frame(0x300, b"")) + pack_frame(Frame(0x100, b"")), 0)
    hub.received(second, pack_frame(Frame(0x200, b"")), 0)
    hub.settle(0)
    hub.received(second, pack_frame(Frame(0x050, b"")), 0)  # the first frame is on the wire already
    hub.wake(MBIT)
    assert [frame.can_id for _, frame in frames(receiver)] == [0x100, 0x050, 0x200, 0x300]


@pytest.mark.parametrize("bitrate", [1_000_000, 500_000, 125_000])
def test_late_wake_up_moves_no_frame(bitrate: int) -> None:
    """Absolute times: a hub that was kept waiting catches up, the bus does not fall behind."""
    hub = Hub(bitrate)
    sender, receiver = join(hub), join(hub)
    sent = [Frame(number, bytes((number,)) * 8) for number in range(1, QUEUE_LENGTH + 1)]
    hub.received(sender, b"".join(pack_frame(frame) for frame in sent), 0)
    hub.settle(0)
    hub.wake(1000 * MBIT)
    ends = []
    end = 0
    for frame in sent:
        end += frame_bits(frame.can_id, frame.data, False, False, frame.dlc) * (1_000_000_000 // bitrate)
        ends.append(end)
    assert [stamp for stamp, _ in frames(receiver)] == ends
    bus = hub.buses["drive"]
    assert isinstance(bus, TimedBus)
    assert bus.lateness.count == QUEUE_LENGTH
    assert bus.lateness.worst_ns == 1000 * MBIT - ends[0]


def error_bus(name: str, index: int, bitrate: int, _now: int) -> SharedBus:
    """One on which errors could happen."""
    return ErrorBus(name, index, bitrate, [])


@pytest.mark.parametrize("make", [None, error_bus])
def test_frame_that_comes_to_a_late_hub_does_not_start_before_it_came(make: MakeBus | None) -> None:
    """It waits from when it came on, behind what was on the wire and what had waited: not in the gap before."""
    hub = Hub(MBIT, make)
    sender, receiver = join(hub), join(hub)
    hub.received(sender, pack_frame(Frame(0x181, bytes(8))) + pack_frame(Frame(0x301, bytes(8))), 0)
    hub.settle(0)
    came = 5 * MBIT
    hub.received(sender, pack_frame(Frame(0x081, bytes(8))), came)  # lower than what waits, and 5 ms later
    hub.settle(came)
    hub.wake(10 * MBIT)
    got = frames(receiver)
    assert [frame.can_id for _, frame in got] == [0x181, 0x301, 0x081]
    first, second, third = (end for end, _ in got)
    assert second < 2 * first + 10_000
    assert third == came + frame_bits(0x081, bytes(8), False, False, 8) * 1000


def test_client_that_joins_a_late_hub_acknowledges_nothing_from_before_it_came() -> None:
    """A sender alone on the bus repeats its frame until then: some 130 us an attempt, error frame included."""
    hub = Hub(MBIT, error_bus)
    sender = join(hub)
    hub.received(sender, pack_frame(Frame(0x181, bytes(8))), 0)
    hub.settle(0)
    hub.received(Client("joiner"), pack_hello("drive", 0), 5 * MBIT)
    bus = hub.buses["drive"]
    assert isinstance(bus, ErrorBus)
    assert bus.medium.errors > 30


class Script(Node):
    """Sends what it is told at given times."""

    def __init__(self, plan: list[tuple[int, Frame]]) -> None:
        super().__init__()
        self.plan = plan
        self.wake_at = plan[0][0] if plan else NEVER

    def wake(self, now: int, out: Out) -> None:
        while self.plan and self.plan[0][0] <= now:
            out.send(0, self.plan.pop(0)[1])
        self.wake_at = self.plan[0][0] if self.plan else NEVER


PLANS = st.lists(
    st.tuples(st.integers(0, 2_000), st.integers(0, 2), st.integers(0, 0x7FF), st.binary(max_size=8)),
    min_size=1,
    max_size=40,
)


@given(PLANS)
def test_timed_hub_gives_the_trace_of_the_lock_step_loop(plan: list[tuple[int, int, int, bytes]]) -> None:
    """One core for both clocks: the same frames at the same nanosecond in the same order as lock-step.

    But for one thing: a frame that comes in the very nanosecond in which another ends competes in lock-step, and on the
    hub in the next arbitration. So each time of sending has its own remainder of a bit time here.
    """
    times = sorted({step[0] for step in plan})
    steps = [(at * 1000 + times.index(at), sender, Frame(can_id, data)) for at, sender, can_id, data in plan]
    steps.sort(key=lambda step: step[:2])
    loop = Loop([Medium("drive", 0, MBIT)])
    for number in range(3):
        loop.connect(Script([(at, frame) for at, sender, frame in steps if sender == number]), [loop.media[0]])
    loop.run_until(100 * MBIT)

    hub = Hub(MBIT)
    clients = [join(hub) for _ in range(3)]
    receiver = join(hub)
    for at in sorted({step[0] for step in steps}):
        hub.wake(at)
        for when, sender, frame in steps:
            if when == at:
                hub.received(clients[sender], pack_frame(frame), at)
        hub.settle(at)
    hub.wake(100 * MBIT)
    assert frames(receiver) == [(row.end_ns, row.frame) for row in loop.trace]


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (pack_frame(Frame(0x123, bytes(12), FLAG_FD)), "frame 123 not carried: CAN FD frame on a timed hub"),
        (pack_record(0x4, FLAG_ERROR, 8, bytes(8)), "frame 004 not carried: error frame"),
    ],
)
def test_timed_hub_rejects_what_it_cannot_carry_and_says_so(record: bytes, words: str) -> None:
    """What the bus cannot do is refused with a clear error, never imitated; the client stays."""
    hub = Hub(MBIT)
    sender, receiver = join(hub), join(hub)
    hub.received(sender, record + pack_frame(Frame(1, b"")), 0)
    hub.settle(0)
    hub.wake(MBIT)
    ((kind, text),) = texts(sender)
    assert kind == KIND_REJECTED
    assert text.startswith(words)
    assert len(frames(receiver)) == 1
    assert (hub.refused, hub.buses["drive"].rejected) == (0, 1)


@pytest.mark.parametrize("surplus", [0, 1, 7])
def test_full_transmit_queue_drops_the_newest_and_tells_its_owner(surplus: int) -> None:
    """A port's transmit queue holds 64 frames, overflow drops the newest and is counted; other clients lose nothing."""
    hub = Hub(MBIT)
    sender, other, receiver = join(hub), join(hub), join(hub)
    hub.received(sender, b"".join(pack_frame(Frame(9, bytes((n,)))) for n in range(QUEUE_LENGTH + surplus)), 0)
    hub.received(other, pack_frame(Frame(1, b"")), 0)
    assert counts(sender, KIND_OVERRUN) == ([(LOST_SENDING, surplus)] if surplus else [])
    hub.settle(0)
    hub.wake(1000 * MBIT)
    assert [frame.data[0] for _, frame in frames(receiver) if frame.can_id == 9] == list(range(QUEUE_LENGTH))
    assert hub.buses["drive"].overflows == surplus
    assert len(frames(other)) == QUEUE_LENGTH


def test_frames_of_a_client_that_has_left_are_still_sent() -> None:
    """As with a driver: what was handed over goes out; its place is free only then."""
    hub = Hub(MBIT)
    sender, receiver = join(hub), join(hub)
    hub.received(sender, pack_frame(Frame(1, b"")) + pack_frame(Frame(2, b"")), 0)
    hub.settle(0)
    hub.left(sender)
    newcomer = join(hub)
    hub.wake(MBIT)
    assert len(frames(receiver)) == 2
    assert len(frames(newcomer)) == 2
    bus = hub.buses["drive"]
    assert isinstance(bus, TimedBus)
    assert len(bus.medium.ports) == 3
    join(hub)
    assert len(bus.medium.ports) == 3


def test_sender_hears_when_its_frames_have_left_the_queue() -> None:
    """OPTION_CONFIRM: every 16 frames one count, so that a sender can keep the queue full and lose nothing."""
    hub = Hub(MBIT)
    sender, receiver = join(hub, options=OPTION_CONFIRM), join(hub)
    hub.received(sender, b"".join(pack_frame(Frame(9, b"")) for _ in range(CONFIRM_EVERY * 2 + 1)), 0)
    hub.settle(0)
    hub.wake(1000 * MBIT)
    assert counts(sender, KIND_SENT) == [(0, CONFIRM_EVERY)] * 2
    assert len(frames(receiver)) == CONFIRM_EVERY * 2 + 1
