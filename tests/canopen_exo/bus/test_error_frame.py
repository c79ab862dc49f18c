"""Error states as SocketCAN error frames; the numbers are those of linux/can/error.h."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.controller import (
    ACK_ERROR,
    BIT_DOMINANT,
    BIT_RECESSIVE,
    CRC_ERROR,
    FLAG,
    FORM_ERROR,
    FRAME,
    INTERMISSION,
    STUFF_ERROR,
    TAIL,
    Detected,
)
from canopen_exo.bus.error_frame import ERROR_FLAG, read_error_frame, write_bus_error, write_error_frame
from canopen_exo.bus.node import ErrorState, PortState

PASSIVE = PortState(3, ErrorState.ERROR_PASSIVE, 130, 7, "before")
COUNTS = bytes((0, 0, 0, 0, 0, 0, 12, 34))


def with_byte(index: int, value: int) -> bytes:
    data = bytearray(8)
    data[index] = value
    return bytes(data)


@pytest.mark.parametrize(
    ("detail", "state"),
    [
        (0x04, ErrorState.WARNING),
        (0x08, ErrorState.WARNING),
        (0x10, ErrorState.ERROR_PASSIVE),
        (0x20, ErrorState.ERROR_PASSIVE),
        (0x28, ErrorState.ERROR_PASSIVE),  # passive and warning at once: the worse one
        (0x40, ErrorState.ERROR_ACTIVE),
    ],
)
def test_controller_class_tells_the_state(detail: int, state: ErrorState) -> None:
    """CAN_ERR_CRTL, data[1]: warning 4/8, passive 0x10/0x20, active 0x40."""
    assert read_error_frame(ERROR_FLAG | 0x004, with_byte(1, detail), None).state is state


@pytest.mark.parametrize("detail", [1, 2])
def test_overflow_is_a_cause_and_keeps_the_state(detail: int) -> None:
    """CAN_ERR_CRTL_RX_OVERFLOW and TX_OVERFLOW say nothing of the error state."""
    notice = read_error_frame(ERROR_FLAG | 0x004, with_byte(1, detail), PASSIVE)
    assert notice.state is ErrorState.ERROR_PASSIVE
    assert notice.cause == "controller overflow"


def test_bus_off_and_restart() -> None:
    """CAN_ERR_BUSOFF 0x40; CAN_ERR_RESTARTED 0x100: error-active with counters at 0."""
    off = read_error_frame(ERROR_FLAG | 0x040, bytes(8), PASSIVE)
    assert (off.state, off.cause) == (ErrorState.BUS_OFF, "bus-off")
    back = read_error_frame(ERROR_FLAG | 0x100, bytes(8), off)
    assert (back.state, back.tec, back.rec) == (ErrorState.ERROR_ACTIVE, 0, 0)


def test_counters_are_read_only_when_announced() -> None:
    """CAN_ERR_CNT 0x200: data[6] TEC, data[7] REC; otherwise these bytes mean nothing."""
    told = read_error_frame(ERROR_FLAG | 0x280, COUNTS, PASSIVE)
    assert (told.tec, told.rec) == (12, 34)
    untold = read_error_frame(ERROR_FLAG | 0x080, COUNTS, PASSIVE)
    assert (untold.tec, untold.rec) == (130, 7)


@pytest.mark.parametrize(
    ("classes", "data", "cause"),
    [
        (0x002, bytes(8), "lost arbitration"),
        (0x020, bytes(8), "no acknowledge"),
        (0x088, with_byte(2, 0x84), "protocol violation, bus error, stuff error, on transmission"),
        (0x000, bytes(8), "error frame"),
    ],
)
def test_other_classes_become_the_cause(classes: int, data: bytes, cause: str) -> None:
    """They are reported in words and change no state."""
    notice = read_error_frame(ERROR_FLAG | classes, data, PASSIVE)
    assert (notice.cause, notice.state, notice.port) == (cause, ErrorState.ERROR_PASSIVE, 0)


@pytest.mark.parametrize("state", [state for state in ErrorState if state is not ErrorState.DOWN])
@pytest.mark.parametrize(("tec", "rec"), [(0, 0), (255, 127), (1, 200)])
def test_state_and_counters_survive_the_round_trip(state: ErrorState, tec: int, rec: int) -> None:
    """What the hub writes, SocketCAN readers and we read."""
    can_id, data = write_error_frame(PortState(2, state, tec, rec, "test"))
    assert can_id & ERROR_FLAG
    assert len(data) == 8
    back = read_error_frame(can_id, data, None)
    assert (back.state, back.tec, back.rec) == (state, tec, rec)


def test_transmit_counter_of_bus_off_is_cut_to_a_byte() -> None:
    """TEC reaches 256 at bus-off (ISO 11898-1); data[6] holds 255 at most."""
    assert write_error_frame(PortState(0, ErrorState.BUS_OFF, 256, 0, ""))[1][6] == 255


@given(st.integers(0, 0xFFFFFFFF), st.binary(max_size=70))
def test_any_bytes_give_a_notice(can_id: int, data: bytes) -> None:
    """What comes from a driver never raises."""
    assert read_error_frame(can_id, data, None).cause


@pytest.mark.parametrize("detail", [1, 2])
def test_overflow_is_marked_in_the_notice(detail: int) -> None:
    """A device tells it as CAN overrun."""
    assert read_error_frame(ERROR_FLAG | 0x004, with_byte(1, detail), None).overrun
    assert not read_error_frame(ERROR_FLAG | 0x004, with_byte(1, 0x20), None).overrun


def test_restart_is_a_class_of_its_own() -> None:
    """CAN_ERR_RESTARTED with the controller's new state and counters."""
    can_id, data = write_error_frame(PortState(0, ErrorState.ERROR_ACTIVE, 0, 0, ""), restarted=True)
    assert (can_id, data) == (0x20000304, bytes((0, 0x40, 0, 0, 0, 0, 0, 0)))
    assert read_error_frame(can_id, data, PASSIVE).state is ErrorState.ERROR_ACTIVE


@pytest.mark.parametrize(
    ("kind", "place", "index", "extended", "can_id", "detail", "location"),
    [
        (BIT_DOMINANT, FRAME, 0, False, 0x20000288, 0x88, 0x03),
        (BIT_DOMINANT, FRAME, 1, False, 0x20000288, 0x88, 0x02),
        (BIT_DOMINANT, FRAME, 8, False, 0x20000288, 0x88, 0x02),
        (BIT_DOMINANT, FRAME, 9, False, 0x20000288, 0x88, 0x06),
        (STUFF_ERROR, FRAME, 12, False, 0x20000288, 0x84, 0x0C),
        (STUFF_ERROR, FRAME, 12, True, 0x20000288, 0x84, 0x04),
        (BIT_RECESSIVE, FRAME, 15, False, 0x20000288, 0x90, 0x0B),
        (BIT_RECESSIVE, FRAME, 19, False, 0x20000288, 0x90, 0x0A),
        (BIT_RECESSIVE, FRAME, 19, True, 0x20000288, 0x90, 0x0F),
        (BIT_RECESSIVE, FRAME, 32, True, 0x20000288, 0x90, 0x0C),
        (BIT_RECESSIVE, FRAME, 82, False, 0x20000288, 0x90, 0x0A),
        (BIT_RECESSIVE, FRAME, 83, False, 0x20000288, 0x90, 0x08),
        (CRC_ERROR, TAIL, 2, False, 0x20000288, 0x80, 0x08),
        (FORM_ERROR, TAIL, 0, False, 0x20000288, 0x82, 0x18),
        (ACK_ERROR, TAIL, 1, False, 0x200002A0, 0x80, 0x19),
        (FORM_ERROR, TAIL, 2, False, 0x20000288, 0x82, 0x1B),
        (FORM_ERROR, TAIL, 3, False, 0x20000288, 0x82, 0x1A),
        (FORM_ERROR, TAIL, 9, False, 0x20000288, 0x82, 0x1A),
        (FORM_ERROR, INTERMISSION, 0, False, 0x20000288, 0x82, 0x12),
        (BIT_DOMINANT, FLAG, 3, False, 0x20000288, 0x88, 0x00),
    ],
)
def test_bus_error_tells_kind_and_place(
    kind: int, place: int, index: int, extended: bool, can_id: int, detail: int, location: int
) -> None:
    """CAN_ERR_PROT data[2] and data[3], CAN_ERR_ACK, CAN_ERR_BUSERROR, CAN_ERR_CNT; 8 data bytes: CRC from bit 83."""
    error = Detected(50, kind, True, place, index, extended, 98, 136, 300)
    assert write_bus_error(error) == (can_id, bytes((0, 0, detail, location, 0, 0, 136, 255)))


def test_receiver_s_error_is_not_marked_as_the_sender_s() -> None:
    """CAN_ERR_PROT_TX only where it was sending; reading keeps the state and takes the counters."""
    can_id, data = write_bus_error(Detected(50, FORM_ERROR, False, TAIL, 0, False, 98, 3, 9))
    assert data[2] == 0x02
    notice = read_error_frame(can_id, data, PASSIVE)
    assert (notice.state, notice.tec, notice.rec) == (ErrorState.ERROR_PASSIVE, 3, 9)
