"""Error states as SocketCAN error frames, both ways.

Source: linux/can/error.h. An error frame is a CAN id of 0x20000000 | classes with 8 data bytes; the classes and bytes
used here are listed below. Leaves out: arbitration-lost positions, transceiver and per-bit details, which become the
cause of a notice but change no state.
"""

from typing import Final

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
    causes: list[str] = []
    for mask, text in _CLASSES:
        if can_id & mask:
            causes.append(text)
    if can_id & _CONTROLLER:
        if data[1] & _OVERFLOW:
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
    return PortState(0, state, tec, rec, ", ".join(causes) or "error frame")


def write_error_frame(state: PortState) -> tuple[int, bytes]:
    """CAN id (with ERROR_FLAG) and 8 data bytes that show `state`; DOWN shows as bus-off, the cause does not show."""
    can_id = ERROR_FLAG | _COUNTERS
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
    return can_id, bytes((0, detail, 0, 0, 0, 0, min(max(state.tec, 0), 255), min(max(state.rec, 0), 255)))
