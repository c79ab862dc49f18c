"""Every fault in a gateway: outside its window, and to frames that are no target, nothing happens."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import NEVER, Out
from fi_gateway.effects import ConstantTime
from fi_gateway.events import At
from fi_gateway.faults import BitFlip, Delay, Fault
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from tests.fi_gateway.faults.bench import WORD
from tests.fi_gateway.faults.test_every_fault import EVERY

START, END = 100, 160
"""The window [100 ns, 160 ns)."""


class Sent(Out):
    """Keeps (port, frame)."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, Frame]] = []

    def send(self, port: int, frame: Frame) -> None:
        self.frames.append((port, frame))


def gateway(fault: Fault) -> Gateway:
    """With one injector on what a joint sends, in that window; time 0 is known."""
    cob_id = WORD.cob_id if fault.signal is not None and fault.signal.cob_id == WORD.cob_id else 0x185
    target = Target(True, False, (cob_id,))
    injector = Injector("x", target, fault, At((START,)), ConstantTime(END - START), None, stream(1, 0, "x"))
    found = Gateway([injector], 2_000_000)
    found.begin(0)
    return found


KINDS = [
    Frame(0x186, b"\x01\x02"),
    Frame(0x185, bytes(8), FLAG_EXTENDED),
    Frame(0x185, b"", FLAG_REMOTE, 8),
    Frame(0x185, bytes(12), FLAG_FD),
    Frame(0x285, b""),
    Frame(0x701, b"\x05"),
]
"""No targets, or of no use to those that have them."""

Step = tuple[int, int, Frame]
STEPS = st.lists(
    st.tuples(
        st.integers(1, 30),
        st.sampled_from([CONTROLLER_PORT, DRIVE_PORT, DRIVE_PORT]),
        st.one_of(st.sampled_from(KINDS), st.binary(min_size=8, max_size=8).map(lambda data: Frame(0x185, data))),
    ),
    max_size=30,
)


def drive(node: Gateway, steps: list[Step]) -> list[tuple[int, int, Frame, list[tuple[int, Frame]], list[Frame]]]:
    """Per step: time, port, frame, what went out with it, and what had gone out by itself since the last one."""
    now, rows, out = 0, [], Sent()
    for after, port, frame in [*steps, (1 << 50, CONTROLLER_PORT, KINDS[0])]:
        now += after
        while node.wake_at < min(now, NEVER):
            node.wake(node.wake_at, out)
        alone = [one for _, one in out.frames]
        out.frames.clear()
        node.receive(now, port, frame, out)
        rows.append((now, port, frame, list(out.frames), alone))
        out.frames.clear()
    return rows


@given(st.sampled_from(EVERY), STEPS)
def test_outside_its_window_no_fault_changes_a_bit(make: Callable[[], Fault], steps: list[Step]) -> None:
    """faults.md: window [t0, t0 + D) on the frame's arrival; anything else passes unchanged, in order, at once.

    A delay in order may let frames wait that come after the window; what becomes of them is the next test's.
    """
    fault = make()
    for now, port, frame, sent, _ in drive(gateway(fault), steps):
        is_target = port == DRIVE_PORT and frame.flags == 0 and frame.can_id in (0x185, 0x285)
        if is_target and (START <= now < END or (now >= END and isinstance(fault, Delay) and not sent)):
            continue
        assert [one for one in sent if one[1] is frame] == [(1 - port, frame)]
        assert len(sent) == 1 or now >= START  # others: what was put off or inserted from the window on


@given(st.sampled_from([make for make in EVERY if isinstance(make(), Delay)]), STEPS)
def test_a_delay_loses_and_changes_nothing(make: Callable[[], Fault], steps: list[Step]) -> None:
    """Every frame goes out once, each COB-ID in order unless reordering was asked for."""
    node = gateway(make())
    rows = drive(node, steps)
    out = [frame for *_, sent, alone in rows for frame in [*alone, *(one for _, one in sent)]]
    came = [frame for _, _, frame, _, _ in rows]
    assert sorted(map(repr, out)) == sorted(map(repr, came))
    assert node.lost == [0, 0]
    assert node.waiting == 0


@pytest.mark.parametrize("at", [START - 1, START, END - 1, END])
def test_the_window_is_half_open(at: int) -> None:
    """[t0, t0 + D), to the nanosecond."""
    ((_, _, frame, sent, _), _) = drive(gateway(BitFlip(None, 1, (0,))), [(at, DRIVE_PORT, Frame(0x185, bytes(8)))])
    assert ([(0, frame)] != sent) == (START <= at < END)
