"""Emergency messages: producer, error register and error history.

Source: CiA 301, 7.2.7 (emergency object, error classes of table 26), objects 0x1001, 0x1003, 0x1014, 0x1015.
"""

import struct
from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.plan import EMCY

NO_ERROR: Final = 0x0000
OVERRUN: Final = 0x8110
"""CAN overrun: objects lost."""
ERROR_PASSIVE: Final = 0x8120
"""CAN in error passive mode."""
BUS_OFF_LEFT: Final = 0x8140
"""Recovered from bus-off."""
SYNC_LENGTH: Final = 0x8240
"""Unexpected SYNC data length."""
PDO_TOO_SHORT: Final = 0x8210
"""PDO not processed due to length error."""
PDO_TOO_LONG: Final = 0x8220
"""PDO length exceeded."""
RPDO_TIMEOUT: Final = 0x8250
HEARTBEAT_LOST: Final = 0x8130
"""Life guard error or heartbeat error."""
SYNC_LOST: Final = 0x8700
"""CiA 402-2: sync controller, loss of the synchronisation in a cyclic synchronous mode."""

_WORDS: Final = {
    SYNC_LENGTH: "SYNC of unexpected length",
    PDO_TOO_SHORT: "PDO too short, not processed",
    PDO_TOO_LONG: "PDO longer than its mapping",
    RPDO_TIMEOUT: "RPDO time-out",
    HEARTBEAT_LOST: "heartbeat lost",
    SYNC_LOST: "SYNC lost",
}


def error_words(code: int) -> str:
    """An error code for people: "SYNC lost (8700)"; for one that is not of this module the code alone."""
    return f"{_WORDS[code]} ({code:04X})" if code in _WORDS else f"error {code:04X}"


GENERIC_BIT: Final = 0x01
COMMUNICATION_BIT: Final = 0x10


@final
class Emergency:
    """An EMCY message as received. code: error code; register: object 0x1001; node_id: who sent it."""

    __slots__ = ("code", "node_id", "register")

    def __init__(self, node_id: int, code: int, register: int) -> None:
        self.node_id: Final[int] = node_id
        self.code: Final[int] = code
        self.register: Final[int] = register


def decode_emcy(node_id: int, data: bytes) -> Emergency | None:
    """The message; None when it is not 8 bytes long."""
    if len(data) != 8:
        return None
    return Emergency(node_id, data[0] | data[1] << 8, data[2])


QUEUE_LENGTH: Final = 16
"""Messages that wait for the inhibit time; further ones are not sent, and counted."""


@final
class EmcyProducer:
    """Active errors of one device. queue: messages not sent yet; due: when the next may go (inhibit time).

    active: code -> class bit; history: codes, the newest first, at most 8; dropped: messages that found the queue full.
    """

    def __init__(self, node_id: int) -> None:
        self.node_id: Final[int] = node_id
        self.inhibit_ns: int = 0
        self.active: dict[int, int] = {}
        self.history: list[int] = []
        self.queue: list[Frame] = []
        self.dropped: int = 0
        self.free_at: int = 0

    @property
    def register(self) -> int:
        """Object 0x1001: the class bits of all active errors, the generic bit with any of them."""
        register = GENERIC_BIT if self.active else 0
        for bits in self.active.values():
            register |= bits
        return register

    @property
    def due(self) -> int:
        """When the next message may be sent [ns]; NEVER when none waits."""
        return self.free_at if self.queue else NEVER

    def occur(self, code: int, class_bit: int) -> bool:
        """An error appeared; False when it is active already (it is reported once)."""
        if code in self.active:
            return False
        self.active[code] = class_bit
        self.history.insert(0, code)
        del self.history[8:]
        self._queue(code)
        return True

    def vanish(self, code: int) -> None:
        """An error is gone: the code 0000 tells when it was the last one."""
        if self.active.pop(code, None) is not None and not self.active:
            self._queue(NO_ERROR)

    def clear(self) -> None:
        """All errors are gone (fault reset)."""
        if self.active:
            self.active.clear()
            self._queue(NO_ERROR)

    def _queue(self, code: int) -> None:
        if len(self.queue) >= QUEUE_LENGTH:
            self.dropped += 1
            return
        self.queue.append(Frame(EMCY + self.node_id, struct.pack("<HB5x", code, self.register)))

    def wake(self, now: int) -> Frame | None:
        """The next message, when the inhibit time is over."""
        if not self.queue or now < self.free_at:
            return None
        self.free_at = now + self.inhibit_ns
        return self.queue.pop(0)
