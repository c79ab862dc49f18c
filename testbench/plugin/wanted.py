"""Frames that a test expects."""

import re
from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from testbench.errors import BenchError

_BYTE: Final = re.compile(r"[0-9a-fA-F]{2}|\.\.", re.ASCII)
_FORM: Final = "allowed are up to 8 bytes, or a text such as '27 06 .. ..' in which .. is any byte"


@final
class Wanted:
    """A frame to come. cob_id: 11 bits; data: payload, `..` in a text for any byte, None for any payload; bus: index.

    Raises BenchError for what cannot be a frame.
    """

    def __init__(self, cob_id: int, data: bytes | str | None, bus: int) -> None:
        if not 0 <= cob_id <= 0x7FF:
            raise BenchError(f"expect: COB-ID {cob_id:#x} given, allowed 0x0..0x7ff")
        self.cob_id: Final[int] = cob_id
        self.bus: Final[int] = bus
        self._bytes: Final[list[int] | None] = None if data is None else _pattern(data)

    @property
    def words(self) -> str:
        """For people: `frame 185 with data 27 06 ..`."""
        if self._bytes is None:
            return f"frame {self.cob_id:03X}"
        shown = " ".join(".." if byte < 0 else f"{byte:02X}" for byte in self._bytes)
        return f"frame {self.cob_id:03X} with data {shown or '(none)'}"

    def length_words(self, frame: Frame) -> str:
        """That a frame has another length than the data, which is easily overlooked; "" when not."""
        if self._bytes is None or frame.flags or len(frame.data) == len(self._bytes):
            return ""
        return f"length {len(frame.data)}, data has {len(self._bytes)}"

    def fits(self, row: Transmission) -> bool:
        """Whether this is one: a classical 11-bit data frame."""
        frame = row.frame
        if frame.can_id != self.cob_id or row.bus != self.bus or frame.flags:
            return False
        wanted = self._bytes
        if wanted is None:
            return True
        data = frame.data
        return len(data) == len(wanted) and all(want in (-1, got) for want, got in zip(wanted, data, strict=True))


@final
class Search:
    """Looks for the first wanted frame among the rows that come, those that end after `from_ns`, by `limit_ns`.

    A row may come long after its frame has ended: only the times say whether it counts. So the newest of `rows` are
    looked at too, back to the first that is too early.
    """

    def __init__(self, wanted: Wanted, rows: list[Transmission], from_ns: int, limit_ns: int) -> None:
        self.found: Transmission | None = None
        self._wanted: Final[Wanted] = wanted
        self._rows: Final[list[Transmission]] = rows
        self._from_ns: Final[int] = from_ns
        self._limit_ns: Final[int] = limit_ns
        at = len(rows)
        while at and rows[at - 1].end_ns > from_ns:
            at -= 1
        self._at: int = at

    def is_over(self) -> bool:
        """Look at the new rows; True once one is found."""
        rows = self._rows
        while self.found is None and self._at < len(rows):
            row = rows[self._at]
            self._at += 1
            if self._from_ns < row.end_ns <= self._limit_ns and self._wanted.fits(row):
                self.found = row
        return self.found is not None


def _pattern(data: bytes | str) -> list[int]:
    """One number a byte, -1 for any."""
    if isinstance(data, bytes):
        pattern = list(data)
    else:
        letters = "".join(data.split())
        if not re.fullmatch(rf"(?:{_BYTE.pattern})*", letters, re.ASCII):
            raise BenchError(f"expect: data {data!r} given, {_FORM}")
        pattern = [-1 if byte == ".." else int(byte, 16) for byte in _BYTE.findall(letters)]
    if len(pattern) > 8:
        raise BenchError(f"expect: data of {len(pattern)} bytes given, {_FORM}")
    return pattern
