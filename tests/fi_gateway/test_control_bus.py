"""Live control of a gateway: commands in frames on the bus, and ports that go away."""

import binascii
import copy
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, ErrorState, PortState
from fi_gateway import bus_control as wire
from fi_gateway.bus_control import BusControl, Command, Status, read_command, read_status
from fi_gateway.control import ControlRow, LiveControl
from fi_gateway.effects import ConstantTime
from fi_gateway.errors import FaultError
from fi_gateway.events import At
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.trigger import Trigger
from tests.fi_gateway.live_gateway import ZERO, Sink, injector, live

# ---- frames on the bus --------------------------------------------------------------------------------------------


def on_bus(control: LiveControl, port: int = CONTROLLER_PORT) -> BusControl:
    bus = BusControl(control, port)
    control.gateway.attach(bus)
    return bus


def send(control: LiveControl, now: int, frame: Frame, port: int = CONTROLLER_PORT) -> list[tuple[int, Frame]]:
    sink = Sink()
    control.gateway.receive(now, port, frame, sink)
    return sink.sent


def answer(control: LiveControl, now: int, command: Command, port: int = CONTROLLER_PORT) -> Status:
    ((side, frame),) = [
        (side, frame)
        for side, frame in send(control, now, command.frame(0x6C0), port)
        if frame.data[1] != wire.ACTIVATED
    ]
    status = read_status(frame.data)
    assert (side, frame.can_id) == (port, 0x6C1)
    assert status is not None
    return status


def number(word: str) -> int:
    return {text: code for code, text in wire.WORDS.items()}[word]


def test_the_checksum_is_the_published_one() -> None:
    """CRC-16/IBM-3740: the check value of "123456789" is 0x29B1 (catalogue of parametrised CRC algorithms)."""
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1
    data = Command(3, 0, 1).frame(0x6C0).data
    assert data[6:] == binascii.crc_hqx(data[:6], 0xFFFF).to_bytes(2, "big")


@given(st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))
def test_commands_survive_the_wire(word: int, injector_number: int, sequence: int) -> None:
    """Round trip of every field."""
    command = Command(word, injector_number, sequence)
    assert read_command(command.frame(0x6C0).data) == command
    assert read_status(command.frame(0x6C0).data) is None


@given(
    st.integers(0, 255), st.integers(0, 255), st.integers(0, 255), st.integers(0, 7), st.sampled_from(list(wire.PHASES))
)
def test_statuses_survive_the_wire(result: int, injector_number: int, sequence: int, bits: int, phase: str) -> None:
    """Round trip of every field."""
    status = Status(result, injector_number, sequence, bits, phase)
    assert read_status(status.frame(0x6C1).data) == status
    assert read_command(status.frame(0x6C1).data) is None


@pytest.mark.parametrize("bit", range(64))
def test_one_wrong_bit_makes_a_command_none(bit: int) -> None:
    """A CRC-16 finds every single bit error; the frame is counted, not answered, not forwarded."""
    control = live(injector())
    bus = on_bus(control)
    good = int.from_bytes(Command(number("trigger"), 0, 1).frame(0x6C0).data, "big")
    assert send(control, ZERO, Frame(0x6C0, (good ^ 1 << bit).to_bytes(8, "big"))) == []
    assert (bus.bad, control.rows, control.gateway.records) == (1, [], [])


@given(st.binary(max_size=8))
def test_no_bytes_on_the_command_id_raise(data: bytes) -> None:
    """Bad bytes from the wire are data."""
    control = live(injector())
    bus = on_bus(control)
    send(control, ZERO, Frame(0x6C0, data))
    assert bus.bad == (read_command(data) is None)


@pytest.mark.parametrize("port", [CONTROLLER_PORT, DRIVE_PORT])
def test_a_command_frame_starts_a_chain_and_is_answered_on_its_side(port: int) -> None:
    """So that a real device can start a chain; the command goes no further."""
    control = live(injector("first"), injector("second", trigger=Trigger(("first",))))
    on_bus(control, port)
    status = answer(control, ZERO + 5, Command(number("trigger"), 0, 9), port)
    expected = Status(wire.DONE, 0, 9, wire.TIME_ZERO_KNOWN | wire.INJECTING, "active")
    assert status == expected
    assert [(r.injector, r.cause, r.start_ns) for r in control.gateway.records] == [
        ("first", "command", ZERO + 5),
        ("second", "trigger:first", ZERO + 5),
    ]
    assert control.rows == [ControlRow(ZERO + 5, "trigger", "first", "bus 0x6c0")]


def test_what_opens_is_reported_with_the_next_frame_or_wake_up() -> None:
    """An unasked status for each window, so that the next gateway or device in a chain learns of it."""
    control = live(injector("a", event=At((MS,))), injector("b", event=At((20 * MS,))))
    on_bus(control)
    sink = Sink()
    control.gateway.wake(ZERO + MS, sink)
    control.gateway.receive(ZERO + 20 * MS, DRIVE_PORT, Frame(0x185, bytes(8)), sink)
    control.gateway.receive(ZERO + 21 * MS, DRIVE_PORT, Frame(0x700, bytes(1)), sink)
    reports = [read_status(frame.data) for _, frame in sink.sent if frame.can_id == 0x6C1]
    bits = wire.TIME_ZERO_KNOWN | wire.INJECTING
    assert reports == [Status(wire.ACTIVATED, 0, 0, bits, "active"), Status(wire.ACTIVATED, 1, 0, bits, "active")]


def test_a_repeated_command_is_answered_and_not_done_again() -> None:
    """EN 50159 repetition; CAN doubles a frame whose last bit is disturbed."""
    control = live(injector(effect=ConstantTime(MS)))
    on_bus(control)
    command = Command(number("trigger"), 0, 1)
    assert answer(control, ZERO, command).result == wire.DONE
    assert answer(control, ZERO + 2 * MS, command).result == wire.REPEATED
    assert len(control.gateway.records) == 1
    assert answer(control, ZERO + 4 * MS, Command(number("trigger"), 0, 2)).result == wire.DONE
    assert len(control.gateway.records) == 2


@pytest.mark.parametrize(
    ("command", "result", "phase"),
    [
        (Command(1, 0, 1), wire.DONE, "armed"),
        (Command(2, 0, 1), wire.DONE, "disarmed"),
        (Command(3, 1, 1), wire.REFUSED, "disarmed"),
        (Command(4, 0xFF, 1), wire.REFUSED, ""),
        (Command(5, 0xFF, 1), wire.DONE, ""),
        (Command(5, 0, 1), wire.DONE, "held"),
        (Command(6, 0xFF, 1), wire.DONE, ""),
        (Command(7, 0, 1), wire.DONE, "armed"),
        (Command(7, 0xFF, 1), wire.DONE, ""),
        (Command(1, 2, 1), wire.UNKNOWN_INJECTOR, ""),
        (Command(3, 0xFF, 1), wire.UNKNOWN_INJECTOR, ""),
        (Command(7, 254, 1), wire.UNKNOWN_INJECTOR, ""),
        (Command(0, 0, 1), wire.UNKNOWN_WORD, "armed"),
        (Command(8, 0, 1), wire.UNKNOWN_WORD, "armed"),
    ],
)
def test_every_command_has_its_answer(command: Command, result: int, phase: str) -> None:
    """The table of docs/live_control.md."""
    control = live(injector("a"), injector("b", enabled=False))
    on_bus(control)
    status = answer(control, ZERO + 1, command)
    assert (status.result, status.injector, status.sequence, status.phase) == (result, command.injector, 1, phase)


def test_a_trigger_for_an_active_injector_is_answered_as_ignored() -> None:
    """As a trigger in the file."""
    control = live(injector())
    on_bus(control)
    answer(control, ZERO, Command(number("trigger"), 0, 1))
    assert answer(control, ZERO + 1, Command(number("trigger"), 0, 2)).result == wire.IGNORED


def test_commands_on_the_other_side_or_of_another_kind_pass() -> None:
    """Only classical 11-bit data frames on the chosen side are read."""
    control = live(injector())
    on_bus(control)
    command = Command(number("trigger"), 0, 1).frame(0x6C0)
    others = [
        Frame(0x6C0, command.data, FLAG_EXTENDED),
        Frame(0x6C0, command.data, FLAG_FD),
        Frame(0x6C0, b"", FLAG_REMOTE, 8),
    ]
    assert send(control, ZERO, command, DRIVE_PORT) == [(CONTROLLER_PORT, command)]
    for frame in others:
        assert send(control, ZERO, frame) == [(DRIVE_PORT, frame)]
    assert control.gateway.records == []


def test_bus_control_is_off_by_default() -> None:
    """A command frame is a frame like any other to a gateway that was not told."""
    control = live(injector())
    command = Command(number("trigger"), 0, 1).frame(0x6C0)
    assert send(control, ZERO, command) == [(DRIVE_PORT, command)]
    assert control.rows == []


@pytest.mark.parametrize(
    ("port", "command_id", "status_id"),
    [(2, 1, 2), (0, 0, 2), (0, 0x80, 2), (0, 1, 0x2FF), (0, 0x800, 1), (0, 1, 1), (1, 5, 0)],
)
def test_ids_that_mean_something_else_are_refused(port: int, command_id: int, status_id: int) -> None:
    """NMT, SYNC, the controller's status, one id for both, no CAN id at all."""
    with pytest.raises(FaultError, match="bus control"):
        BusControl(live(), port, command_id, status_id)


def test_a_target_of_a_fault_cannot_be_the_command_id() -> None:
    """No fault has its hands on the commands."""
    control = live(injector())
    with pytest.raises(FaultError, match="x: its target or trigger 0x185"):
        control.gateway.attach(BusControl(control, CONTROLLER_PORT, 0x185))


# ---- ports that go away -------------------------------------------------------------------------------------------


def port(gateway: Gateway, now: int, side: int, state: ErrorState) -> None:
    gateway.port_changed(now, PortState(side, state, 0, 0, "test"), Sink())


@pytest.mark.parametrize("state", [ErrorState.BUS_OFF, ErrorState.DOWN])
def test_nothing_is_queued_for_a_port_that_is_away(state: ErrorState) -> None:
    """No old command waits for the bus to come back: counted as undelivered, one probe every 20 ms."""
    control, sink = live(), Sink()
    gateway = control.gateway
    port(gateway, 0, DRIVE_PORT, state)
    for now in range(0, 50 * MS, MS):
        gateway.receive(now, CONTROLLER_PORT, Frame(0x205, now.to_bytes(8)), sink)
    assert [int.from_bytes(frame.data) for _, frame in sink.sent] == [20 * MS, 40 * MS]
    assert gateway.undelivered == [48, 0]
    port(gateway, 50 * MS, DRIVE_PORT, ErrorState.ERROR_ACTIVE)
    gateway.receive(50 * MS, CONTROLLER_PORT, Frame(0x205, b"\1"), sink)
    assert sink.sent[-1][1].data == b"\1"
    assert [(c.port, c.state) for c in gateway.port_changes] == [(1, state), (1, ErrorState.ERROR_ACTIVE)]


def test_the_other_direction_goes_on_and_ends_the_outage() -> None:
    """A frame received on a port shows that it is back."""
    control, sink = live(), Sink()
    gateway = control.gateway
    port(gateway, 0, DRIVE_PORT, ErrorState.DOWN)
    gateway.receive(1, DRIVE_PORT, Frame(0x185, bytes(8)), sink)
    gateway.receive(2, CONTROLLER_PORT, Frame(0x205, b""), sink)
    assert [side for side, _ in sink.sent] == [CONTROLLER_PORT, DRIVE_PORT]
    assert gateway.undelivered == [0, 0]


@pytest.mark.parametrize("state", [ErrorState.WARNING, ErrorState.ERROR_PASSIVE, ErrorState.ERROR_ACTIVE])
def test_a_port_in_trouble_still_gets_frames(state: ErrorState) -> None:
    """ISO 11898-1: warning and error-passive controllers take part."""
    control, sink = live(), Sink()
    port(control.gateway, 0, DRIVE_PORT, state)
    port(control.gateway, 0, DRIVE_PORT, state)
    control.gateway.receive(1, CONTROLLER_PORT, Frame(0x205, b""), sink)
    assert len(sink.sent) == 1
    assert control.gateway.notices == [0, 2]
    assert len(control.gateway.port_changes) == (state is not ErrorState.ERROR_ACTIVE)


def test_a_gateway_can_be_copied_while_a_port_is_away() -> None:
    """Snapshots carry the ports' states; what is attached stays with the original."""
    control = live(injector(event=At((0,))))
    on_bus(control)
    port(control.gateway, 0, DRIVE_PORT, ErrorState.BUS_OFF)
    control.disarm("x", ZERO + 1)
    twin = copy.deepcopy(control.gateway)
    sink = Sink()
    twin.receive(MS, CONTROLLER_PORT, Frame(0x205, b""), sink)
    assert (sink.sent, twin.undelivered, control.gateway.undelivered) == ([], [1, 0], [0, 0])
    assert not twin.injectors[0].enabled


# ---- the documentation --------------------------------------------------------------------------------------------


def test_the_example_in_the_documentation_is_what_happens() -> None:
    """docs/live_control.md: commands and answers, byte for byte."""
    text = (Path(__file__).resolve().parents[2] / "docs" / "live_control.md").read_text(encoding="utf-8")
    lines = re.findall(r"^(6C[01])#([0-9A-F]{16}) ", text, re.MULTILINE)
    assert [cob_id for cob_id, _ in lines] == ["6C0", "6C1"] * 3
    control = live(injector(enabled=False))
    on_bus(control)
    for at in range(0, len(lines), 2):
        sent = send(control, ZERO + at, Frame(0x6C0, bytes.fromhex(lines[at][1])))
        answers = [frame for _, frame in sent if frame.data[1] != wire.ACTIVATED]
        assert [repr(frame) for frame in answers] == [f"6C1#{lines[at + 1][1]}"]
