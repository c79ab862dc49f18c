"""Error states and errors on the bus as SocketCAN error frames.

Source: linux/can/error.h. An error frame is a CAN id of 0x20000000 | classes with 8 data bytes; the classes and bytes
used here are listed below. Leaves out: arbitration-lost positions, transceiver and per-bit details, which become the
cause of a notice but change no state.
"""

from typing import Final

from canopen_exo.bus.bit_stream import CRC_BITS
from canopen_exo.bus.controller import (
    ACK_ERROR,
    BIT_DOMINANT,
    BIT_RECESSIVE,
    CRC_ERROR,
    FORM_ERROR,
    FRAME,
    INTERMISSION,
    OVERLOAD,
    STUFF_ERROR,
    TAIL,
    Detected,
)
from canopen_exo.bus.node import ErrorState, PortState

ERROR_FLAG: Final = 0x20000000
"""CAN_ERR_FLAG: this CAN id is an error frame."""

_LOST_ARBITRATION: Final = 0x002
_CONTROLLER: Final = 0x004
_PROTOCOL: Final = 0x008
_NO_ACK: Final = 0x020
_BUS_OFF: Final = 0x040
_BUS_ERROR: Final = 0x080
_RESTARTED: Final = 0x100
_COUNTERS: Final = 0x200

_OVERFLOW: Final = 0x03
_WARNING: Final = 0x0C
_PASSIVE: Final = 0x30
_ACTIVE: Final = 0x40

_CLASSES: Final = (
    (0x001, "transmit timeout"),
    (_LOST_ARBITRATION, "lost arbitration"),
    (_PROTOCOL, "protocol violation"),
    (0x010, "transceiver"),
    (_NO_ACK, "no acknowledge"),
    (_BUS_OFF, "bus-off"),
    (_BUS_ERROR, "bus error"),
    (_RESTARTED, "controller restarted"),
)

_DETAIL: Final = {BIT_DOMINANT: 0x08, BIT_RECESSIVE: 0x10, FORM_ERROR: 0x02, STUFF_ERROR: 0x04, OVERLOAD: 0x20}
"""data[2] by kind of error; a CRC error has no bit of its own, its location says it."""

_DATA: Final = 0x0A
_CRC_SEQUENCE: Final = 0x08
_END_OF_FRAME: Final = 0x1A
_INTERMISSION: Final = 0x12
_TAIL_PLACES: Final = (0x18, 0x19, 0x1B)
"""CRC delimiter, ACK slot, ACK delimiter."""
_BASE_PLACES: Final = ((1, 0x03), (9, 0x02), (12, 0x06), (13, 0x0C), (14, 0x05), (15, 0x09), (19, 0x0B))
"""By unstuffed bits before it: SOF, ID28-21, ID20-18, RTR, IDE, reserved bit 0, DLC."""
_EXTENDED_PLACES: Final = (
    *((1, 0x03), (9, 0x02), (12, 0x06), (13, 0x04), (14, 0x05)),  # SOF, ID28-21, ID20-18, SRR, IDE
    *((19, 0x07), (27, 0x0F), (32, 0x0E), (33, 0x0C)),  # ID17-13, ID12-5, ID4-0, RTR
    *((34, 0x0D), (35, 0x09), (39, 0x0B)),  # reserved bits 1 and 0, DLC
)

_PROTOCOL_BITS: Final = (
    (0x01, "bit error"),
    (0x02, "form error"),
    (0x04, "stuff error"),
    (0x08, "dominant bit not sent"),
    (0x10, "recessive bit not sent"),
    (0x20, "overload"),
    (0x80, "on transmission"),
)


def read_error_frame(can_id: int, data: bytes, before: PortState | None) -> PortState:
    """The notice in an error frame (port 0). before: the last notice of this interface, None at the start.

    State and counters that the frame does not tell stay as before.
    """
    data = data[:8].ljust(8, b"\0")
    state = ErrorState.ERROR_ACTIVE if before is None else before.state
    tec = 0 if before is None else before.tec
    rec = 0 if before is None else before.rec
    overrun = False
    causes: list[str] = []
    for mask, text in _CLASSES:
        if can_id & mask:
            causes.append(text)
    if can_id & _CONTROLLER:
        if data[1] & _OVERFLOW:
            overrun = True
            causes.append("controller overflow")
        if data[1] & _PASSIVE:
            state = ErrorState.ERROR_PASSIVE
        elif data[1] & _WARNING:
            state = ErrorState.WARNING
        elif data[1] & _ACTIVE:
            state = ErrorState.ERROR_ACTIVE
        if data[1] & ~_OVERFLOW:
            causes.append(state.value.replace("_", " "))
    if can_id & _PROTOCOL:
        for mask, text in _PROTOCOL_BITS:
            if data[2] & mask:
                causes.append(text)
    if can_id & _COUNTERS:
        tec = data[6]
        rec = data[7]
    if can_id & _RESTARTED:
        state = ErrorState.ERROR_ACTIVE
        tec = rec = 0
    if can_id & _BUS_OFF:
        state = ErrorState.BUS_OFF
    return PortState(0, state, tec, rec, ", ".join(causes) or "error frame", overrun)


def write_error_frame(state: PortState, restarted: bool = False) -> tuple[int, bytes]:
    """CAN id (with ERROR_FLAG) and 8 data bytes that show `state`; DOWN shows as bus-off, the cause does not show.

    restarted: the controller has just left bus-off.
    """
    can_id = ERROR_FLAG | _COUNTERS | (_RESTARTED if restarted else 0)
    detail = 0
    if state.state is ErrorState.BUS_OFF or state.state is ErrorState.DOWN:
        can_id |= _BUS_OFF
    else:
        can_id |= _CONTROLLER
        transmit = state.tec >= state.rec
        if state.state is ErrorState.ERROR_PASSIVE:
            detail = 0x20 if transmit else 0x10
        elif state.state is ErrorState.WARNING:
            detail = 0x08 if transmit else 0x04
        else:
            detail = _ACTIVE
    return can_id, bytes((0, detail, 0, 0, 0, 0, _byte(state.tec), _byte(state.rec)))


def write_bus_error(error: Detected) -> tuple[int, bytes]:
    """The same for one error that a controller noticed, with its counters afterwards."""
    can_id = ERROR_FLAG | (0 if error.kind == OVERLOAD else _BUS_ERROR) | _COUNTERS
    if error.kind == ACK_ERROR:
        can_id |= _NO_ACK
    else:
        can_id |= _PROTOCOL
    detail = _DETAIL.get(error.kind, 0) | (0x80 if error.transmitting else 0)
    return can_id, bytes((0, 0, detail, _location(error), 0, 0, _byte(error.tec), _byte(error.rec)))


def of_another(can_id: int, data: bytes) -> tuple[int, bytes]:
    """A bus error as another controller would tell it: not the sender's, and without counters."""
    return can_id & ~_COUNTERS, bytes((0, 0, data[2] & 0x7F, data[3], 0, 0, 0, 0))


def _location(error: Detected) -> int:
    """Where in the frame, in the codes of linux/can/error.h; 0 within error frames, for which it has none."""
    if error.place == FRAME:
        for end, code in _EXTENDED_PLACES if error.extended else _BASE_PLACES:
            if error.index < end:
                return code
        return _DATA if error.index < error.size - CRC_BITS else _CRC_SEQUENCE
    if error.kind == CRC_ERROR:
        return _CRC_SEQUENCE
    if error.place == TAIL:
        return _TAIL_PLACES[error.index] if error.index < len(_TAIL_PLACES) else _END_OF_FRAME
    return _INTERMISSION if error.place == INTERMISSION else 0


def _byte(counter: int) -> int:
    return min(max(counter, 0), 255)
