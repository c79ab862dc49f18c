"""Fault confinement: the two error counters of a CAN controller and the states they make.

Source: ISO 11898-1, fault confinement (Bosch CAN 2.0B, chapter 8). The rules are a table; `count` applies one of them.
A standard leaves open by how much a REC above 127 falls with a successful reception (to 119..127): it is 120 here.
"""

from typing import Final, final

from canopen_exo.bus.node import ErrorState

RX_ERROR: Final = 0
RX_FIRST_DOMINANT: Final = 1
TX_ERROR: Final = 2
TX_FLAG_BIT: Final = 3
RX_FLAG_BIT: Final = 4
TX_DOMINANT_RUN: Final = 5
RX_DOMINANT_RUN: Final = 6
TX_SUCCESS: Final = 7
RX_SUCCESS: Final = 8

WARNING_LIMIT: Final = 96
PASSIVE_LIMIT: Final = 128
BUS_OFF_LIMIT: Final = 256

_AFTER_PASSIVE: Final = 120
_REC_TOP: Final = 255
"""REC needs no more than to be above 127; registers and error frames have 8 bits."""


@final
class Rule:
    """A row of the table: what is added to TEC and REC. condition: in the words of the standard."""

    __slots__ = ("condition", "rec", "tec")

    def __init__(self, tec: int, rec: int, condition: str) -> None:
        self.tec: Final[int] = tec
        self.rec: Final[int] = rec
        self.condition: Final[str] = condition


RULES: Final[list[Rule]] = [
    Rule(0, 1, "a receiver detects an error, but not a bit error while it sends an active error or overload flag"),
    Rule(0, 8, "a receiver sees dominant as the first bit after its error flag"),
    Rule(8, 0, "a transmitter sends an error flag (`controller` knows the two exceptions)"),
    Rule(8, 0, "a transmitter has a bit error while it sends an active error or overload flag"),
    Rule(0, 8, "a receiver has a bit error while it sends an active error or overload flag"),
    Rule(8, 0, "a transmitter sees the 8th dominant bit after a flag, and each further 8"),
    Rule(0, 8, "a receiver sees the 8th dominant bit after a flag, and each further 8"),
    Rule(-1, 0, "successful transmission"),
    Rule(0, -1, "successful reception"),
]
"""By the constants above. The 14th consecutive dominant bit from the first of an active flag of 6 bits is the 8th
after its end."""


def count(rule: int, tec: int, rec: int) -> tuple[int, int]:
    """TEC and REC after a rule was applied."""
    row = RULES[rule]
    tec += row.tec
    if rule == RX_SUCCESS and rec >= PASSIVE_LIMIT:
        rec = _AFTER_PASSIVE
    else:
        rec += row.rec
    return (tec if tec > 0 else 0), (0 if rec < 0 else rec if rec < _REC_TOP else _REC_TOP)


def is_passive(tec: int, rec: int) -> bool:
    """Whether a controller with these counters sends passive error flags."""
    return tec >= PASSIVE_LIMIT or rec >= PASSIVE_LIMIT


def state_of(tec: int, rec: int) -> ErrorState:
    """The state that the counters make; bus-off is left by a restart only."""
    if tec >= BUS_OFF_LIMIT:
        return ErrorState.BUS_OFF
    if is_passive(tec, rec):
        return ErrorState.ERROR_PASSIVE
    if tec >= WARNING_LIMIT or rec >= WARNING_LIMIT:
        return ErrorState.WARNING
    return ErrorState.ERROR_ACTIVE
