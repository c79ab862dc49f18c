"""Process data objects of one device, configured by its object dictionary.

Source: CiA 301, 7.2.2 (PDO), objects 0x1400.. 0x1600.. (receive) and 0x1800.. 0x1A00.. (transmit).
Transmission types: transmit 1-240 (every n-th SYNC, with SYNC start value); receive 0-240 (value applied with the
next SYNC) and 254, 255 (applied at once). Leaves out: transmit types 0 and 252-255, inhibit time, event timer.
"""

from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.emcy import PDO_TOO_LONG, PDO_TOO_SHORT
from canopen_exo.errors import CanopenExoError
from canopen_exo.od import Entry, ObjectDictionary
from canopen_exo.od import key_of as key_of
from canopen_exo.signal import Codec, compile_codec

PDO_COUNT: Final = 4
"""Receive and transmit PDOs of a device."""

INVALID: Final = 1 << 31
"""Bit 31 of a PDO's COB-ID: the PDO does not exist."""

ABORT_NOT_MAPPABLE: Final = 0x06040041
ABORT_PDO_LENGTH: Final = 0x06040042


_RESTRICTED: Final = ((0x000, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 1 << 30))
"""CiA 301, 7.3.5, restricted CAN-IDs; above 0x7FF are 29-bit ids and bit 29, which this device does not support."""


def is_restricted(cob_id: int) -> bool:
    """Whether a PDO may not have this COB-ID (bits 0-29)."""
    return any(low <= cob_id <= high for low, high in _RESTRICTED)


def mapping_abort(od: ObjectDictionary, map_index: int, count: int) -> int:
    """SDO abort code of enabling `count` mapped objects; 0 when they make a PDO."""
    bits = 0
    for sub in range(1, count + 1):
        word = od.values.get(key_of(map_index, sub), 0)
        entry = od.entries.get(word >> 8)
        if entry is None or entry.bits != word & 0xFF:
            return ABORT_NOT_MAPPABLE
        if not (entry.tpdo_mappable if map_index >= 0x1A00 else entry.rpdo_mappable):
            return ABORT_NOT_MAPPABLE
        bits += entry.bits
    return ABORT_PDO_LENGTH if bits > 64 else 0


def _mapping(od: ObjectDictionary, map_index: int) -> tuple[list[int], Codec]:
    """Keys of the mapped objects and their codec."""
    keys: list[int] = []
    fields: list[tuple[int, bool]] = []
    for sub in range(1, od.values[key_of(map_index, 0)] + 1):
        word = od.values[key_of(map_index, sub)]
        entry = od.entries.get(word >> 8)
        if entry is None:
            raise CanopenExoError(
                f"PDO mapping {map_index:04X}:{sub}: object {word >> 16:04X}:{word >> 8 & 0xFF} is not in the "
                "object dictionary; map an object of the EDS"
            )
        keys.append(entry.key)
        fields.append((entry.bits, entry.signed))
    return keys, compile_codec(fields)


def _reader(keys: list[int]) -> Callable[[dict[int, int]], Sequence[int]]:
    """Takes the values of `keys` out of a dictionary, in one call."""
    if len(keys) > 1:
        return itemgetter(*keys)
    return lambda values: [values[key] for key in keys]


def _is_limited(entry: Entry) -> bool:
    """Whether the object's limits are narrower than what its bits can hold."""
    low = -(1 << (entry.bits - 1)) if entry.signed else 0
    return entry.low > low or entry.high < low + (1 << entry.bits) - 1


@final
class TransmitPdo:
    """A TPDO. active: exists and has a synchronous type; cob_id: its id; every: sent on each n-th SYNC.

    start: SYNC start value (18xx:6); 0 counts from the first SYNC, else from the SYNC that carries this counter.
    always: sent on every SYNC, `on_sync` need not be asked.
    """

    def __init__(self, od: ObjectDictionary, number: int) -> None:
        comm, map_index = 0x1800 + number, 0x1A00 + number
        cob = od.values[key_of(comm, 1)]
        self.every: Final[int] = od.values[key_of(comm, 2)]
        self.cob_id: Final[int] = cob & 0x7FF
        keys, codec = _mapping(od, map_index)
        self.keys: Final[list[int]] = keys
        self.codec: Final[Codec] = codec
        self._read: Final[Callable[[dict[int, int]], Sequence[int]]] = _reader(keys)
        self._encode: Final[Callable[..., bytes]] = codec.encode
        self.active: Final[bool] = not cob & INVALID and 1 <= self.every <= 240 and len(keys) > 0
        self.start: Final[int] = od.values[key_of(comm, 6)]
        self.always: Final[bool] = self.every == 1 and self.start == 0
        self.countdown: int = 0 if self.start else self.every

    def restart(self) -> None:
        """Count anew: the device entered Operational."""
        self.countdown = 0 if self.start else self.every

    def on_sync(self, counter: int) -> bool:
        """Whether this SYNC sends the PDO. counter: the SYNC's counter, 0 when it has none."""
        if self.countdown > 1:
            self.countdown -= 1
            return False
        if self.countdown == 0:  # waiting for the start value; without a counter it is ignored (CiA 301, 18xx:6)
            if counter != self.start and counter != 0:
                return False
            self.countdown = self.every
            if counter:
                return True
        self.countdown -= 1
        if self.countdown:
            return False
        self.countdown = self.every
        return True

    def frame(self, values: dict[int, int]) -> Frame:
        """The PDO with the present values of its objects."""
        return Frame(self.cob_id, self._encode(*self._read(values)))


@final
class ReceivePdo:
    """An RPDO. pending: payload waiting for SYNC (synchronous types); last: time of the last reception.

    late, wrong: its silence (8250) or the length of its last payload (8210, 8220) is an error now. is_steady: it has
    none, so that the next payload of `size` bytes does no more than move `pending` and `last`.
    deadline: when its silence must be looked at (14xx:5, lazy as in the SYNC consumer), NEVER before the first.
    """

    def __init__(self, od: ObjectDictionary, number: int) -> None:
        comm, map_index = 0x1400 + number, 0x1600 + number
        cob = od.values[key_of(comm, 1)]
        kind = od.values[key_of(comm, 2)]
        self.cob_id: Final[int] = cob & 0x7FF
        keys, codec = _mapping(od, map_index)
        self.keys: Final[list[int]] = keys
        self.codec: Final[Codec] = codec
        self.size: Final[int] = codec.size
        self._unpack: Final[Callable[[bytes], tuple[int, ...]]] = codec.unpack
        self._low: Final[list[int]] = [od.entries[key].low for key in keys]
        self._high: Final[list[int]] = [od.entries[key].high for key in keys]
        self._limited: Final[bool] = any(_is_limited(od.entries[key]) for key in keys)
        self.active: Final[bool] = not cob & INVALID and len(keys) > 0
        self.synchronous: Final[bool] = kind <= 240
        self.timeout_ns: Final[int] = od.values[key_of(comm, 5)] * MS
        self.pending: bytes | None = None
        self.last: int = NEVER
        self.deadline: int = NEVER
        self.late: bool = False
        self.wrong: int = 0
        self.is_steady: bool = False

    def received(self, now: int, data: bytes) -> int:
        """Take a payload; the EMCY code of a wrong length (too long is served, too short is not), else 0."""
        size = len(data)
        self.is_steady = False
        if size < self.size:
            self.wrong = PDO_TOO_SHORT
            return PDO_TOO_SHORT
        self.wrong = PDO_TOO_LONG if size > self.size else 0
        self.late = False
        self.pending = data
        self.last = now
        if self.deadline == NEVER and self.timeout_ns:
            self.deadline = now + self.timeout_ns
        self.is_steady = self.wrong == 0
        return self.wrong

    def apply(self, od: ObjectDictionary) -> bool:
        """Move the pending payload into the object dictionary; False when there is none.

        A value beyond the limits of its object is left out, as an SDO write of it would be refused.
        """
        data = self.pending
        if data is None:
            return False
        self.pending = None
        values = od.values
        if self._limited:
            for key, raw, low, high in zip(self.keys, self._unpack(data), self._low, self._high, strict=True):
                if low <= raw <= high:
                    values[key] = raw
        else:
            raws = self._unpack(data)
            for at, key in enumerate(self.keys):
                values[key] = raws[at]
        return True

    def stop(self) -> None:
        """Not operational: nothing pends, nothing is watched."""
        self.is_steady = False
        self.pending = None
        self.deadline = NEVER
        self.late = False
        self.wrong = 0

    def wake(self, now: int) -> bool:
        """True once, when the PDO has been silent for its deadline (EMCY 8250). Looking early moves the deadline on."""
        if self.deadline == NEVER:
            return False
        self.deadline = self.last + self.timeout_ns
        if now < self.deadline:
            return False
        self.deadline = NEVER
        self.late = True
        self.is_steady = False
        return True
