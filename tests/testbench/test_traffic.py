"""The load of a bus: what it was busy with, errors included; frames are counted apart."""

import pytest

from canopen_exo.bus.bit_stream import field_positions
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, Node, Out
from canopen_exo.bus.wire import Wire
from fi_gateway.wire_faults import BitError, StuckDominant, WireFault
from testbench.run import traffic

BIT = 1000
FRAME = Frame(0x181, bytes(8))
LENGTH = FRAME.measure() * BIT


class Talker(Node):
    """Sends the frame every millisecond, ten times."""

    def __init__(self, sends: int) -> None:
        super().__init__()
        self.sends = sends
        self.wake_at = 0 if sends else NEVER

    def wake(self, now: int, out: Out) -> None:
        out.send(0, FRAME)
        self.sends -= 1
        self.wake_at = now + MS if self.sends else NEVER


def load_of(fault: WireFault | None) -> tuple[int, int]:
    """Frames and busy time of 12 ms, the fault begun at 1 ms."""
    medium = Medium("drive", 0, 1_000_000)
    loop = Loop([medium])
    for sends in (10, 0):
        loop.connect(Talker(sends), [medium])
    if fault is not None:
        wire = Wire(medium, [fault])
        loop.install(wire, medium)
    loop.run_until(12 * MS)
    (found,) = traffic(loop.trace, [medium], 0, 12 * MS)
    return found


def test_without_errors_it_is_the_length_of_the_frames() -> None:
    """As before: 10 frames."""
    assert load_of(None) == (10, 10 * LENGTH)
    assert load_of(StuckDominant()) == (10, 10 * LENGTH)


@pytest.mark.parametrize("attempts", [1, 3])
def test_what_an_error_breaks_off_and_its_error_frames_count(attempts: int) -> None:
    """Bits up to the one in error, flags, delimiter, intermission, and the frame again; frames are still ten.

    The sender notices the bit at once; the receivers notice six dominant bits and answer with a flag of their own, so
    that there are 6 to 12 dominant bits.
    """
    at = field_positions(FRAME, "data")[0]
    fault = BitError("data", 0)
    fault.begin(MS, MS + attempts * (at + 1 + 12 + 8 + 3) * BIT - 20 * BIT)
    frames, busy_ns = load_of(fault)
    extra = busy_ns - 10 * LENGTH
    assert frames == 10
    assert attempts * (at + 1 + 6 + 8 + 3) * BIT <= extra <= attempts * (at + 1 + 12 + 8 + 3) * BIT


def test_a_bus_that_is_held_dominant_is_busy_all_the_time() -> None:
    """Half a millisecond without a sender, and what the error frame takes until the bus is idle again."""
    fault = StuckDominant()
    fault.begin(10 * MS, 10 * MS + 500 * BIT)
    frames, busy_ns = load_of(fault)
    assert frames == 10
    assert 500 * BIT < busy_ns - 10 * LENGTH <= (500 + 6 + 8 + 3 + 8) * BIT
