"""A CAN controller bit by bit: what it sends next, and what it makes of what it sees.

Source: ISO 11898-1 (Bosch CAN 2.0 part B), data link layer and fault confinement. Controllers that see the same and
count the same are one Controller here; `bit_engine` puts them on a bus.
A bit is 0 (dominant) or 1 (recessive); positions count from the SOF of the attempt.
Choices where the standard is silent: a third dominant start of the intermission in a row, after two overload frames, is
a form error; a controller that reaches TEC 256 sends nothing more, also no flag.
Leaves out: CAN FD, propagation and resynchronisation within a bit.
"""

from typing import Final, final

from canopen_exo.bus.bit_stream import BASE_HEADER, CRC_BITS, EXTENDED_HEADER, STUFF_AFTER, frame_of, wire_bits
from canopen_exo.bus.bits import CRC_POLYNOMIAL
from canopen_exo.bus.confinement import (
    BUS_OFF_LIMIT,
    RX_DOMINANT_RUN,
    RX_ERROR,
    RX_FIRST_DOMINANT,
    RX_FLAG_BIT,
    RX_SUCCESS,
    TX_DOMINANT_RUN,
    TX_ERROR,
    TX_FLAG_BIT,
    TX_SUCCESS,
    count,
    is_passive,
)
from canopen_exo.bus.frame import FLAG_EXTENDED, Frame

IDLE: Final = 0
FRAME: Final = 1
TAIL: Final = 2
FLAG: Final = 3
WAIT: Final = 4
DELIMITER: Final = 5
INTERMISSION: Final = 6
OFF: Final = 7

BIT_DOMINANT: Final = 0
"""A dominant bit was sent and recessive seen."""
BIT_RECESSIVE: Final = 1
"""A recessive bit was sent and dominant seen."""
STUFF_ERROR: Final = 2
FORM_ERROR: Final = 3
CRC_ERROR: Final = 4
ACK_ERROR: Final = 5
OVERLOAD: Final = 6
"""No error: it began an overload frame. Only in `Controller.overloads`."""

FLAG_LENGTH: Final = 6
DELIMITER_LENGTH: Final = 8
INTERMISSION_LENGTH: Final = 3
EOF_LENGTH: Final = 7
SUSPEND_LENGTH: Final = 8
OVERLOADS: Final = 2
"""Overload frames in a row."""

ACCEPT_TO_END: Final = 5
"""Bits from the last but one of EOF, which a receiver accepts with, to the end of the intermission."""

_ACK_AT: Final = 1
_ACK_DELIMITER_AT: Final = 2
_EOF_AT: Final = 3
_ACCEPT_AT: Final = _EOF_AT + EOF_LENGTH - 2
_LAST_AT: Final = _EOF_AT + EOF_LENGTH - 1

_UNKNOWN: Final = 1 << 20


@final
class Detected:
    """An error that a controller noticed. at: bit; kind: see above; transmitting: it was the sender.

    place: state it was in; index: destuffed bits before it (FRAME) or position (others); extended, size (destuffed bits
    SOF..CRC): as far as known. tec, rec: afterwards.
    """

    __slots__ = ("at", "extended", "index", "kind", "place", "rec", "size", "tec", "transmitting")

    def __init__(
        self, at: int, kind: int, transmitting: bool, place: int, index: int, extended: bool, size: int,
        tec: int, rec: int,
    ) -> None:  # fmt: skip
        self.at: Final[int] = at
        self.kind: Final[int] = kind
        self.transmitting: Final[bool] = transmitting
        self.place: Final[int] = place
        self.index: Final[int] = index
        self.extended: Final[bool] = extended
        self.size: Final[int] = size
        self.tec: Final[int] = tec
        self.rec: Final[int] = rec


@final
class Counted:
    """A rule of fault confinement was applied. at: bit; tec, rec: afterwards."""

    __slots__ = ("at", "rec", "rule", "tec")

    def __init__(self, at: int, rule: int, tec: int, rec: int) -> None:
        self.at: Final[int] = at
        self.rule: Final[int] = rule
        self.tec: Final[int] = tec
        self.rec: Final[int] = rec


@final
class Controller:
    """One controller, or several that see the same. ports: their numbers; out: the bit they send next.

    frame: what it sends or wants to send; transmitter: it is the sender of the frame under way, also while error frames
    follow; sent_at, accepted_at: bits at which it knew its frame sent, and another one received (-1: not);
    accepted: that frame; idle_at: last bit of its intermission; suspends: it must wait 8 bits more then.
    found, overloads, counted: what happened in this attempt.
    """

    __slots__ = (
        "_acks", "_arbitration_bits", "_count", "_crc", "_cursor", "_extended", "_has_failed",
        "_is_overload", "_last", "_overloads",
        "_passive", "_pending_ack", "_position", "_run", "_sending", "_stream", "_total", "_value", "accepted",
        "accepted_at", "counted", "found", "frame", "idle_at", "out", "overloads", "ports", "rec", "sent_at", "state",
        "suspends", "tec", "transmitter",
    )  # fmt: skip

    def __init__(self, ports: list[int], tec: int, rec: int) -> None:
        self.ports: Final[list[int]] = ports
        self.tec: int = tec
        self.rec: int = rec
        self.state: int = IDLE
        self.out: int = 1
        self.frame: Frame | None = None
        self.transmitter: bool = False
        self.sent_at: int = -1
        self.accepted: Frame | None = None
        self.accepted_at: int = -1
        self.idle_at: int = -1
        self.suspends: bool = False
        self.found: list[Detected] = []
        self.overloads: list[Detected] = []
        self.counted: list[Counted] = []
        self._acks: bool = True
        self._sending: bool = False
        self._stream: list[int] = []
        self._cursor: int = 0
        self._arbitration_bits: int = 0
        self._value: int = 0
        self._count: int = 0
        self._total: int = _UNKNOWN
        self._crc: int = 0
        self._last: int = 1
        self._run: int = 0
        self._extended: bool = False
        self._position: int = 0
        self._passive: bool = False
        self._is_overload: bool = False
        self._pending_ack: bool = False
        self._overloads: int = 0
        self._has_failed: bool = False

    # --- what the medium asks ------------------------------------------------------------------------------------

    @property
    def is_sending(self) -> bool:
        """It sends a frame, and has not lost arbitration or seen an error."""
        return self._sending

    @property
    def will_drive(self) -> bool:
        """It may send a dominant bit though nobody sends anything new."""
        return self.state == FRAME or self.state == TAIL or (self.state == FLAG and not self._passive)

    @property
    def may_join(self) -> bool:
        """It has seen an SOF in the last bit of its intermission, and may send its own frame from the id on."""
        return self.state == FRAME and self._count == 1 and not self._sending

    @property
    def has_failed(self) -> bool:
        """It saw an error in a frame of its own."""
        return self._has_failed

    @property
    def idle_in(self) -> int:
        """Recessive bits until the bus is idle for it; only for one that will send nothing dominant."""
        if self.state == FLAG:
            seen = self._run if self._last == 1 else 0
            return FLAG_LENGTH - seen + DELIMITER_LENGTH + INTERMISSION_LENGTH
        if self.state == WAIT:
            return DELIMITER_LENGTH + INTERMISSION_LENGTH
        if self.state == DELIMITER:
            return DELIMITER_LENGTH - self._position + INTERMISSION_LENGTH
        if self.state == INTERMISSION:
            return INTERMISSION_LENGTH - self._position
        return 0

    def part(self, ports: list[int]) -> "Controller":
        """The same for some of its ports, which from now on see something else than the others."""
        other = Controller(ports, self.tec, self.rec)
        other.state, other.out = self.state, self.out
        other.frame, other.transmitter = self.frame, self.transmitter
        other._sending, other._stream, other._cursor = self._sending, self._stream, self._cursor
        other._arbitration_bits = self._arbitration_bits
        other._value, other._count, other._total, other._crc = self._value, self._count, self._total, self._crc
        other._last, other._run, other._extended = self._last, self._run, self._extended
        other._position, other._passive = self._position, self._passive
        other._is_overload, other._pending_ack = self._is_overload, self._pending_ack
        other._overloads = self._overloads
        return other

    def refuse_acknowledge(self) -> None:
        """It acknowledges nothing in this attempt."""
        self._acks = False

    def send(self, frame: Frame) -> None:
        """Begin to send with the next bit; where a dominant bit was the last of the intermission, that was the SOF."""
        after_sof = self.state == FRAME and self._count == 1
        if not after_sof:
            self._begin()
        self.frame = frame
        self.transmitter = True
        self._sending = True
        self._stream = wire_bits(frame)
        self._cursor = 1 if after_sof else 0
        self._arbitration_bits = 32 if frame.flags & FLAG_EXTENDED else 12
        self.out = self._stream[self._cursor]

    def step(self, at: int, seen: int) -> None:
        """A bit has passed: `seen` by this controller."""
        state = self.state
        if state == FRAME:
            self._field(at, seen)
        elif state == IDLE:
            if seen == 0:
                self._begin()
                self._field(at, seen)
        elif state == TAIL:
            self._tail(at, seen)
        elif state == FLAG:
            self._flag(at, seen)
        elif state == WAIT:
            self._wait(at, seen)
        elif state == DELIMITER:
            self._delimiter(at, seen)
        elif state == INTERMISSION:
            self._intermission(at, seen)

    # --- SOF to CRC ----------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        self.state, self.out = FRAME, 1
        self.transmitter = self._sending = False
        self._value = self._count = self._crc = self._run = 0
        self._total = _UNKNOWN
        self._last = 1
        self._extended = False
        self._overloads = 0

    def _field(self, at: int, seen: int) -> None:
        if self._sending and seen != self.out:
            if self.out == 0 or not 0 < self._count <= self._arbitration_bits:
                self._error(at, BIT_RECESSIVE if self.out else BIT_DOMINANT)
                return
            if self._run == STUFF_AFTER:
                self._error(at, STUFF_ERROR, True)
                return
            self._sending = self.transmitter = False  # lost arbitration: a receiver from here on
            self.out = 1
        if self._run == STUFF_AFTER:
            if seen == self._last:
                self._error(at, STUFF_ERROR)
                return
            self._last, self._run = seen, 1
        else:
            self._run = self._run + 1 if seen == self._last else 1
            self._last = seen
            self._value = self._value << 1 | seen
            self._count += 1
            top = self._crc >> 14 & 1
            self._crc = self._crc << 1 & 0x7FFF
            if top != seen:
                self._crc ^= CRC_POLYNOMIAL
            if self._count == 14:
                self._extended = seen == 1
            elif self._count == (EXTENDED_HEADER if self._extended else BASE_HEADER) and self._count > 14:
                size = 0 if self._value >> 6 & 1 else min(self._value & 15, 8)
                self._total = self._count + 8 * size + CRC_BITS
        if self._count == self._total and self._run < STUFF_AFTER:
            self.state, self._position, self.out = TAIL, 0, 1
        elif self._sending:
            self._cursor += 1
            self.out = self._stream[self._cursor]

    # --- CRC delimiter to the last bit of EOF ---------------------------------------------------------------------

    def _tail(self, at: int, seen: int) -> None:
        position, sending = self._position, self._sending
        if position == _ACK_AT:
            if sending and seen:
                self._error(at, ACK_ERROR)
                return
            if self.out == 0 and seen:
                self._error(at, BIT_DOMINANT)
                return
            self.out = 1
        elif position == _LAST_AT:
            self._end_of_frame(at, seen)
            return
        elif seen == 0:
            self._error(at, BIT_RECESSIVE if sending else FORM_ERROR)
            return
        elif not sending:
            if position == 0:
                if self._crc == 0 and self._acks:
                    self.out = 0
            elif position == _ACK_DELIMITER_AT:
                if self._crc:
                    self._error(at, CRC_ERROR)
                    return
            elif position == _ACCEPT_AT:
                self._apply(at, RX_SUCCESS)
                self.accepted, self.accepted_at = frame_of(self._value, self._count), at
        self._position += 1

    def _end_of_frame(self, at: int, seen: int) -> None:
        """The last bit: dominant there is an error for the sender only, who sends again what the others have."""
        if seen == 0:
            if self._sending:
                self._error(at, BIT_RECESSIVE)
            else:
                self._overload(at)
            return
        if self._sending:
            self._sending = False
            self.sent_at = at
            self._apply(at, TX_SUCCESS)
        self.state, self._position = INTERMISSION, 0

    # --- error and overload frames --------------------------------------------------------------------------------

    def _error(self, at: int, kind: int, spared: bool = False) -> None:
        """Note an error and send a flag from the next bit on. spared: the TEC does not grow."""
        place = self.state
        index = self._count if place == FRAME else self._position
        self._has_failed = self._has_failed or self._sending
        passive = is_passive(self.tec, self.rec)
        self._sending = False
        self._pending_ack = passive and kind == ACK_ERROR
        if not self.transmitter:
            self._apply(at, RX_ERROR)
        elif not self._pending_ack and not spared:
            self._apply(at, TX_ERROR)
        self._note(self.found, at, kind, place, index)
        self._start_flag(passive, False)

    def _note(self, notices: list[Detected], at: int, kind: int, place: int, index: int) -> None:
        notices.append(
            Detected(at, kind, self.transmitter, place, index, self._extended, self._total, self.tec, self.rec)
        )

    def _overload(self, at: int) -> None:
        if self._overloads == OVERLOADS:
            self._error(at, FORM_ERROR)
            return
        self._overloads += 1
        self._note(self.overloads, at, OVERLOAD, self.state, self._position)
        self._start_flag(False, True)

    def _start_flag(self, passive: bool, is_overload: bool) -> None:
        if self.state == OFF:
            return
        self.state, self._position, self._run = FLAG, 0, 0
        self._passive, self._is_overload = passive, is_overload
        self.out = 1 if passive else 0

    def _flag(self, at: int, seen: int) -> None:
        if self._passive:
            if self._pending_ack and seen == 0:  # somebody else sends a flag: it was no lone node after all
                self._pending_ack = False
                self._apply(at, TX_ERROR)
                if self.state == OFF:
                    return
            self._run = self._run + 1 if self._run and seen == self._last else 1
            self._last = seen
            if self._run < FLAG_LENGTH:
                return
        elif seen:
            passive = is_passive(self.tec, self.rec)
            self._apply(at, TX_FLAG_BIT if self.transmitter else RX_FLAG_BIT)
            self._note(self.found, at, BIT_DOMINANT, FLAG, self._position)
            self._start_flag(passive, False)
            return
        else:
            self._position += 1
            if self._position < FLAG_LENGTH:
                return
        self.state, self._position, self.out = WAIT, 0, 1

    def _wait(self, at: int, seen: int) -> None:
        """After its own flag: the flags of the others may last longer."""
        if seen:
            self.state, self._position = DELIMITER, 1
            return
        self._position += 1
        if self._position == 1 and not self.transmitter and not self._is_overload:
            self._apply(at, RX_FIRST_DOMINANT)
        if self._position % 8 == 0:
            self._apply(at, TX_DOMINANT_RUN if self.transmitter else RX_DOMINANT_RUN)

    def _delimiter(self, at: int, seen: int) -> None:
        if seen:
            self._position += 1
            if self._position == DELIMITER_LENGTH:
                self.state, self._position = INTERMISSION, 0
        elif self._position == DELIMITER_LENGTH - 1:
            self._overload(at)
        else:
            self._error(at, FORM_ERROR)

    def _intermission(self, at: int, seen: int) -> None:
        if seen:
            self._position += 1
            if self._position == INTERMISSION_LENGTH:
                self.suspends = self.transmitter and is_passive(self.tec, self.rec)
                self.state, self.idle_at = IDLE, at
                self.transmitter = False
                self._overloads = 0
        elif self._position < INTERMISSION_LENGTH - 1:
            self._overload(at)
        else:  # somebody's SOF
            self.suspends = self.transmitter and is_passive(self.tec, self.rec)
            self.idle_at = at
            self._begin()
            self._field(at, seen)

    def _apply(self, at: int, rule: int) -> None:
        self.tec, self.rec = count(rule, self.tec, self.rec)
        self.counted.append(Counted(at, rule, self.tec, self.rec))
        if self.tec >= BUS_OFF_LIMIT:
            self.state, self.out = OFF, 1
            self._sending = False
