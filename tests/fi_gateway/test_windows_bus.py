"""Windows and triggers over the bus: frames that trigger, reports, two gateways in a chain."""

import pytest

from canopen_exo.bus.frame import FLAG_EXTENDED, Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, Node, Out
from fi_gateway.bus_control import BusControl
from fi_gateway.control import LiveControl
from fi_gateway.effects import ConstantTime
from fi_gateway.errors import FaultError
from fi_gateway.events import At
from fi_gateway.faults import Drop
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Target
from fi_gateway.trigger import BusFrame, Report, Trigger
from tests.fi_gateway.power_up_injectors import Sink, injector, opened, run, tpdo

# ---- over the bus -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "port", "fires"),
    [
        (Frame(0x6F0, b"\x01\x10"), CONTROLLER_PORT, True),
        (Frame(0x6F0, b"\x01\x1f"), CONTROLLER_PORT, True),
        (Frame(0x6F0, b"\x01\x2f"), CONTROLLER_PORT, False),
        (Frame(0x6F0, b"\x02\x10"), CONTROLLER_PORT, False),
        (Frame(0x6F0, b"\x01"), CONTROLLER_PORT, False),
        (Frame(0x6F0, b"\x01\x10\x00"), CONTROLLER_PORT, False),
        (Frame(0x6F1, b"\x01\x10"), CONTROLLER_PORT, False),
        (Frame(0x6F0, b"\x01\x10"), DRIVE_PORT, False),
        (Frame(0x6F0, b"\x01\x10", FLAG_EXTENDED), CONTROLLER_PORT, False),
    ],
)
def test_a_frame_of_that_id_and_payload_is_a_trigger(frame: Frame, port: int, fires: bool) -> None:
    """A given id and payload, under a mask, on one side; the frame itself passes."""
    pattern = BusFrame(0x6F0, b"\x01\x10", b"\xff\xf0", False, True)
    gateway, sink = Gateway([injector("a", trigger=Trigger(frame=pattern))], 2 * MS), Sink()
    gateway.receive(0, DRIVE_PORT, Frame(0x7FF, b""), sink)
    gateway.receive(50, port, frame, sink)
    assert sink.sent[-1] == (1 - port, frame)
    assert opened(gateway) == ([("a", 50, "frame:0x6F0")] if fires else [])


def test_a_frame_can_be_trigger_and_target() -> None:
    """Triggers settle before faults apply: it is met by what it starts."""
    pattern = BusFrame(0x181, b"\x05", b"\xff", True, True)
    _, sink = run(1000, [injector("a", trigger=Trigger(frame=pattern))], ((50, tpdo(4)), (60, tpdo(5)), (70, tpdo(4))))
    assert [frame.data for _, frame in sink.sent[1:]] == [b"\x04", b"\x06", b"\x05"]


@pytest.mark.parametrize(
    ("on", "times"), [("activated", [100, 200]), ("manifested", [120, 200]), ("ended", [150, 250])]
)
def test_a_report_goes_out_each_time_the_signal_rises(on: str, times: list[int]) -> None:
    """report: a frame with that id and payload, on the sides asked for."""
    frame = Frame(0x6F1, b"\x01")
    one = injector("a", At((100, 200)), reports=(Report(frame, on, True, True), Report(frame, on, False, True)))
    gateway, sink = Gateway([one], 2 * MS), Sink()
    said: list[int] = []
    for now, given in ((0, Frame(0x7FF, b"")), (120, tpdo()), (200, tpdo()), (1000, tpdo())):
        while gateway.wake_at < now:
            at = gateway.wake_at
            gateway.wake(at, sink)
            said += [at] * [row for row in sink.sent if row[1] is frame].count((0, frame))
            sink.sent.clear()
        gateway.receive(now, DRIVE_PORT, given, sink)
        rows = [row for row in sink.sent if row[1] is frame]
        assert rows.count((1, frame)) == 2 * rows.count((0, frame))
        said += [now] * rows.count((0, frame))
        sink.sent.clear()
    assert said == times


def test_live_control_keeps_its_cob_id_for_itself() -> None:
    """A trigger frame with the COB-ID of commands would never be seen."""
    gateway = Gateway([injector("a", trigger=Trigger(frame=BusFrame(0x6C0, b"", b"", True, True)))], 2 * MS)
    with pytest.raises(FaultError, match=r"injector a: .*0x6c0 is the COB-ID of live control"):
        gateway.attach(BusControl(LiveControl(gateway), CONTROLLER_PORT))


class Talker(Node):
    """Sends a frame every `period` ns."""

    def __init__(self, period: int, frame: Frame) -> None:
        super().__init__()
        self.period = period
        self.frame = frame
        self.wake_at = period

    def wake(self, now: int, out: Out) -> None:
        self.wake_at = now + self.period
        out.send(0, self.frame)


def test_two_gateways_chain_over_the_bus() -> None:
    """One reports, the other is fired by it: three buses, two gateways, a talker, in one lock-step loop.

    The report is queued at 1 ms on the middle bus and the gateway beyond is fired at its end: its length in bits later.
    """
    report = Frame(0x6F0, b"\x2a")
    first = Gateway(
        [injector("first", At((1_000_000,)), ConstantTime(500_000), reports=(Report(report, "activated", True, False),),
                  target=Target(True, False, (0x182,)), fault=Drop())],
        2 * MS,
    )  # fmt: skip
    pattern = BusFrame(0x6F0, b"\x2a", b"\xff", True, False)
    trigger = Trigger(frame=pattern)
    second = Gateway([injector("second", effect=ConstantTime(MS), trigger=trigger, fault=Drop())], 2 * MS)
    media = [Medium(name, index, 1_000_000) for index, name in enumerate(("controller", "middle", "drive"))]
    loop = Loop(media)
    loop.connect(second, [media[0], media[1]])
    loop.connect(first, [media[1], media[2]])
    loop.connect(Talker(100_000, tpdo()), [media[2]])
    loop.run_until(4 * MS)
    hop = tpdo().measure() * 1000
    power_up = 100_000 + hop
    start = power_up + 1_000_000
    sent = [row for row in loop.trace if row.frame == report]
    assert [row.bus for row in sent] == [1, 0]
    (record,) = second.records
    assert (record.cause, record.start_ns) == ("frame:0x6F0", sent[0].end_ns)
    assert first.records[0].start_ns == start <= sent[0].end_ns - report.measure() * 1000 < start + 2 * hop
    came = [row.end_ns for row in loop.trace if row.bus == 0 and row.frame.can_id == 0x181]
    assert came
    assert not any(record.start_ns + hop < end <= record.end_ns for end in came)
    assert second.lost == [0, 10] == [0, record.frames_lost]
