"""The gateway on real interfaces: real sockets with the kernel's CAN records on them, served by the real-time loop.

The records are made by hand from linux/can.h, byte for byte, and compared byte for byte: nothing of our codec is
in the comparison. Socket pairs take the place of AF_CAN, which is tried out in tests/vcan. Every test runs on both ways
through the loop: every frame made and handled (with a trace), and what only passes sent on as the record that came.
"""

import errno
import random
import select
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from canopen_exo.bus import recvmmsg
from canopen_exo.bus.losses import Losses
from canopen_exo.bus.node import NEVER, ErrorState
from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.bus.socketcan import SocketCanChannel
from fi_gateway.control import statistics
from fi_gateway.faults import BitFlip, Drop
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT
from fi_gateway.injector import Injector
from tests.fi_gateway.socket_bench import (
    ERROR,
    PATIENCE_NS,
    WAYS,
    Bench,
    MakeBench,
    classical,
    injector,
    kinds,
    udp_pair,
    unix_pair,
)


@pytest.fixture(params=WAYS)
def bench(request: pytest.FixtureRequest) -> MakeBench:
    """`bench(*injectors)`, as a context."""
    record, pair = WAYS[request.param]

    @contextmanager
    def make(*injectors: Injector) -> Iterator[Bench]:
        made = Bench(list(injectors), record, pair)
        try:
            yield made
        finally:
            made.close()

    return make


def test_every_kind_of_frame_passes_both_ways_byte_for_byte(bench: MakeBench) -> None:
    """Id type, DLC (raw ones too), RTR, FD, BRS and ESI kept; in order; nothing comes back to where it came from."""
    records = kinds()
    with bench() as made:
        made.pass_all([records, records[::-1]], [len(records)] * 2)
        assert made.came[DRIVE_PORT] == records
        assert made.came[CONTROLLER_PORT] == records[::-1]
        assert made.gateway.frames == [len(records)] * 2
        assert made.loop.losses() == 0


@pytest.mark.long
def test_armed_faults_elsewhere_change_nothing(bench: MakeBench) -> None:
    """A fault acts on classical data frames of its target; every other kind with the same id passes."""
    records = [record for record in kinds() if struct.unpack_from("=I", record)[0] != 0x185 or len(record) == 72]
    target = [injector("drop", 0x185, Drop()), injector("flip", 0x123, BitFlip(None, 1))]
    with bench(*target) as made:
        made.pass_all([[], [classical(0x701, b"\0"), *records]], [1 + len(records), 0])
        assert [one.phase.value for one in target] == ["active", "active"]
        assert made.came == [[classical(0x701, b"\0"), *records], []]


def test_error_frames_are_counted_reported_and_not_forwarded(bench: MakeBench) -> None:
    """design.md: SocketCAN error frames become PortState notices; bus-off to restart as linux/can/error.h has it."""
    passive = classical(ERROR | 0x204, bytes((0, 0x20, 0, 0, 0, 0, 130, 7)))
    bus_off = classical(ERROR | 0x40, bytes(8))
    restarted = classical(ERROR | 0x100, bytes(8))
    frames = [classical(0x100 + number, b"\1") for number in range(4)]
    with bench() as made:
        came = [frames[0], passive, frames[1], bus_off, restarted, frames[2], passive, frames[3]]
        made.pass_all([[], came], [4, 0])
        assert made.came == [frames, []]
        assert [change.state for change in made.gateway.port_changes] == [
            ErrorState.ERROR_PASSIVE,
            ErrorState.BUS_OFF,
            ErrorState.ERROR_ACTIVE,
            ErrorState.ERROR_PASSIVE,
        ]
        assert {change.port for change in made.gateway.port_changes} == {DRIVE_PORT}
        to_drives, to_controller = statistics(made.gateway, made.loop.latency)
        assert (to_drives.notices, to_controller.notices) == (0, 4)
        assert made.channels[DRIVE_PORT].errors == 4


def test_records_that_are_no_frames_are_counted_and_not_forwarded(bench: MakeBench) -> None:
    """Bad bytes are data: nothing raises, the frames around them pass."""
    good = [classical(0x100, b"\1"), classical(0x101, b"\2")]
    bad = [b"x", bytes(15), bytes(17), classical(0x100, bytes(8), length=9), bytes(71)]
    with bench() as made:
        made.pass_all([[good[0], *bad, good[1]], []], [0, 2])
        assert made.came == [[], good]
        assert made.channels[CONTROLLER_PORT].malformed == len(bad)


@pytest.mark.long
def test_bus_off_on_one_side_loses_what_is_sent_there_and_ends_by_itself(bench: MakeBench) -> None:
    """Counted as undelivered, nothing old comes out afterwards; the other direction goes on."""
    away = [classical(0x200 + number, bytes((number,))) for number in range(5)]
    back = [classical(0x300, b"\7")]
    with bench() as made:
        made.pass_all([[], [classical(ERROR | 0x40, bytes(8))]], [0, 0])
        made.gateway._probe_at[DRIVE_PORT] = NEVER  # a slow machine must not reach the first probe
        made.pass_all([away, []], [0, 0])
        assert made.gateway.undelivered == [5, 0]
        made.pass_all([[], [classical(ERROR | 0x100, bytes(8))]], [0, 0])
        made.pass_all([back, [classical(0x181, b"\1")]], [1, 1])
        assert made.came == [[classical(0x181, b"\1")], back]


class Stalled(socket.socket):
    """An interface whose queue is full (ENOBUFS) while `full`."""

    full = True

    def send(self, *given: object) -> int:
        if self.full:
            raise OSError(errno.ENOBUFS, "No buffer space available")
        return super().send(*given)  # type: ignore[arg-type]


@contextmanager
def stalled(made: Bench) -> Iterator[Stalled]:
    """The drive side, with a queue that is full."""
    near, far = unix_pair()
    far.setblocking(False)
    opened = Stalled(fileno=near.detach())
    made.channels[DRIVE_PORT].close()
    made.far[DRIVE_PORT].close()
    made.far[DRIVE_PORT] = far
    made.channels[DRIVE_PORT] = SocketCanChannel("socketcan:stalled", lambda: opened)
    made.loop = RealTimeLoop(made.gateway, list(made.channels), [0, 1], time.monotonic_ns(), record=made.record)
    yield opened


@pytest.fixture
def readable_by_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """A socket of our own class is not read by the kernel's recvmmsg."""
    monkeypatch.setattr(recvmmsg, "find_call", lambda *_: None)


def test_frames_that_wait_for_a_busy_interface_keep_their_order(bench: MakeBench, readable_by_python: None) -> None:
    """Whatever their ids: a command and the SYNC behind it must not change places on the way."""
    records = [classical(number, b"\1") for number in (0x205, 0x605, 0x80, 0x205, 0x7FF, 0)]
    with bench() as made, stalled(made) as drive:
        made.pass_all([records, []], [0, 0])
        assert made.came[DRIVE_PORT] == []
        drive.full = False
        made.pass_all([[], []], [0, len(records)])
        assert made.came[DRIVE_PORT] == records
        assert made.loop.losses() == 0


def test_a_bus_that_takes_only_some_of_many_frames_gets_all_of_them_in_order() -> None:
    """A local socket takes 10 messages until they are read: the kernel ends a run in its middle."""
    records = [classical(0x200 + number, bytes((number,))) for number in range(60)]
    pairs = iter((udp_pair, unix_pair))
    made = Bench([injector("flip", 0x210, BitFlip(None, 1))], False, lambda: next(pairs)())
    try:
        for record in records:
            made.far[CONTROLLER_PORT].send(record)
        made.loop.poll()
        assert made.gateway.frames == [60, 0]
        made.pass_all([[], []], [0, 60])
        came = made.came[DRIVE_PORT]
        assert [record for record in came if record[0] != 0x10] == [record for record in records if record[0] != 0x10]
        assert [record[0] for record in came] == list(range(60))
        assert made.loop.losses() == 0
    finally:
        made.close()


@pytest.mark.long
def test_no_command_from_before_or_during_bus_off_comes_out_after_it(
    bench: MakeBench, readable_by_python: None
) -> None:
    """A controller that is going bus-off stops taking frames (ENOBUFS) before the driver says so, and goes on so.

    What waits then, and the frames by which the gateway tries whether it is back, are counted, not kept.
    """
    before = [classical(0x205, bytes((number,))) for number in range(6)]
    during = [classical(0x205, bytes((100 + number,))) for number in range(6)]
    with bench() as made, stalled(made) as drive:
        made.pass_all([before, []], [0, 0])
        made.pass_all([[], [classical(ERROR | 0x40, bytes(8))]], [0, 0])
        for record in during:
            made.gateway._probe_at[DRIVE_PORT] = -NEVER  # each of them tries
            made.pass_all([[record], []], [0, 0])
        assert made.gateway.undelivered == [0, 0]
        drive.full = False
        made.pass_all([[], [classical(ERROR | 0x100, bytes(8))]], [0, 0])
        after = classical(0x205, b"\xff")
        made.pass_all([[after], []], [0, 1])
        assert made.came[DRIVE_PORT] == [after]
        assert made.loop.losses_by_channel()[DRIVE_PORT] == Losses(discarded=len(before) + len(during))
        assert made.loop.losses() == len(before) + len(during)


def test_time_0_is_told_by_a_sync_that_passes(bench: MakeBench) -> None:
    """It is only looked at, and goes on with the others; the status frame behind it counts from when it came."""
    with bench() as made:
        sync, others = classical(0x080, b"\1"), [classical(0x200 + number, b"\0\0") for number in range(1, 7)]
        begun = made.loop.now()
        made.pass_all([[*others, sync, *others, sync, classical(0x2FF, struct.pack("<BHH", 2, 5, 0))], []], [0, 15])
        assert made.came[DRIVE_PORT] == [*others, sync, *others, sync, classical(0x2FF, struct.pack("<BHH", 2, 5, 0))]
        assert begun <= made.gateway.cadence.last <= made.loop.now()
        assert made.gateway.time_zero == made.gateway.cadence.last - 5 * 2_000_000


def test_latency_is_measured_for_every_frame_sent(bench: MakeBench) -> None:
    """From the stamp of the frame to its sending, by direction."""
    with bench() as made:
        made.pass_all([[classical(0x200, b"\1")] * 7, [classical(0x180, b"\1")] * 5], [5, 7])
        to_drives, to_controller = statistics(made.gateway, made.loop.latency)
        assert to_drives.latency is not None
        assert to_controller.latency is not None
        assert (to_drives.latency.count, to_controller.latency.count) == (7, 5)
        assert 0 <= to_drives.latency.percentile(0.5) <= to_drives.latency.worst_ns


def test_an_interface_that_goes_away_and_comes_back_is_survived(
    bench: MakeBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ENODEV: reported, opened again with back-off; the gateway resumes without being told."""
    monkeypatch.setattr(recvmmsg, "find_call", lambda *_: None)  # what a socket of our own can play is recvmsg

    class Gone(socket.socket):
        """A socket whose interface has been pulled out."""

        def recvmsg(self, *_: object) -> tuple[bytes, list[tuple[int, int, bytes]], int, object]:
            raise OSError(errno.ENODEV, "No such device")

    with bench() as made:
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        broken, trigger = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        opened: list[socket.socket] = [Gone(fileno=broken.detach()), near]
        unstable = SocketCanChannel("socketcan:unstable", lambda: opened.pop(0))
        made.loop = RealTimeLoop(made.gateway, [made.channels[0], unstable], [0, 1], time.monotonic_ns())
        made.far[DRIVE_PORT].close()
        made.far[DRIVE_PORT] = far
        far.setblocking(False)
        trigger.send(b"x")
        limit = made.loop.now() + PATIENCE_NS
        made.loop.run(lambda now: now > limit or (not opened and unstable.fileno() >= 0))
        assert [change.state for change in made.gateway.port_changes] == [ErrorState.DOWN]
        frame = classical(0x200, b"\1")

        def repeat(now: int) -> bool:
            if select.select([far], [], [], 0)[0]:
                return True
            made.far[CONTROLLER_PORT].send(frame)
            return now > limit

        made.loop.run(repeat)
        assert far.recv(72) == frame
        made.loop.run(lambda now: now > limit or len(made.gateway.port_changes) > 1)
        assert made.gateway.port_changes[-1].state is ErrorState.ERROR_ACTIVE
        unstable.close()
        trigger.close()


@pytest.mark.long
def test_no_frame_is_lost_doubled_or_moved_in_a_long_stream(bench: MakeBench) -> None:
    """None without a fault asking for it: 20 000 random frames, both ways; `make soak` takes 10 million."""
    chance = random.Random(11)
    pool = kinds()
    given: list[list[bytes]] = [[], []]
    for number in range(20_000):
        record = bytearray(chance.choice(pool))
        size = record[4] if len(record) == 72 or not record[3] & 0x40 else 0
        if size >= 4:
            record[8:12] = number.to_bytes(4, "little")
        given[number % 2].append(bytes(record))
    with bench(injector("drop", 0x555, Drop())) as made:
        made.pass_all(given, [len(given[1]), len(given[0])])
        assert made.came[DRIVE_PORT] == given[CONTROLLER_PORT]
        assert made.came[CONTROLLER_PORT] == given[DRIVE_PORT]
        assert (made.loop.losses(), made.gateway.lost, made.gateway.undelivered) == (0, [0, 0], [0, 0])
