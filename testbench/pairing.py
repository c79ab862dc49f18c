"""Which frame received is which frame sent: the records of two places on a frame's way, put side by side, id by id.

A record of a place is the frames in the order in which they went by. Between two places the order of one id is kept.
From the last frame backwards each one received is the newest equal one sent before it (frames that repeat their bytes
are told apart by their times); what is left over was lost, doubled or out of order.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, TypeAlias

from canopen_exo import plan as ids
from canopen_exo.bus.medium import Transmission

Key: TypeAlias = tuple[int, int]
"""CAN id and flags."""

_MOST_IDS: Final = 4
"""How many CAN ids a message names."""


@dataclass(slots=True)
class Pairing:
    """pairs: (sent, received), in order; missing: sent and not received; extra: received and not sent."""

    pairs: list[tuple[Transmission, Transmission]] = field(default_factory=list)
    missing: list[Transmission] = field(default_factory=list)
    extra: list[Transmission] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Place:
    """A process on one bus. bus: its index in the rows; start_ns, end_ns: from when to when it listened.

    name: in messages.
    """

    name: str
    rows: list[Transmission]
    bus: int
    start_ns: int
    end_ns: int

    def by_id(self, *, own: bool) -> dict[Key, list[Transmission]]:
        """Rows that it sent itself (own) or received on its bus, in their order; without SDO requests.

        More than one node may send those.
        """
        found: dict[Key, list[Transmission]] = {}
        for row in self.rows:
            if row.bus == self.bus and (row.sender >= 0) == own and not is_request(row.frame.can_id):
                found.setdefault((row.frame.can_id, row.frame.flags), []).append(row)
        return found


def is_request(can_id: int) -> bool:
    """Whether an id is of an SDO request, or of live control."""
    return ids.SDO_REQUEST < can_id < ids.HEARTBEAT


def pair(sent: list[Transmission], received: list[Transmission], slack_ns: int) -> Pairing:
    """Put two records of one id side by side.

    slack_ns: by how much the time of receiving may lie before that of sending, because two clocks took them.
    """
    found = Pairing()
    left = len(sent)  # the newest that is still free is the one before
    for k in range(len(received) - 1, -1, -1):
        row = received[k]
        newest = left - 1
        while newest >= 0 and sent[newest].end_ns > row.end_ns + slack_ns:
            newest -= 1
        at = _place_of(row, sent, newest, left)
        is_before = k > 0 and at < newest and received[k - 1].frame == sent[newest].frame
        if at < 0 or is_before:  # without this one the two records agree again
            found.extra.append(row)
            continue
        found.missing += reversed(sent[at + 1 : left])
        found.pairs.append((sent[at], row))
        left = at
    found.missing += reversed(sent[:left])
    found.pairs.reverse()
    found.missing.reverse()
    found.extra.reverse()
    return found


def _place_of(row: Transmission, sent: list[Transmission], newest: int, left: int) -> int:
    """The newest equal frame up to `newest`; else the oldest behind it, a wrong stamp then; -1: there is none."""
    for at in range(newest, -1, -1):
        if sent[at].frame == row.frame:
            return at
    for at in range(newest + 1, left):
        if sent[at].frame == row.frame:
            return at
    return -1


def latest_before(causes: list[int], results: list[int]) -> dict[int, int]:
    """Result -> its cause, the newest before it that has no other; both are places in one record, rising."""
    found: dict[int, int] = {}
    left = len(causes)
    for result in reversed(results):
        while left and causes[left - 1] > result:
            left -= 1
        if not left:
            break
        left -= 1
        found[result] = causes[left]
    return found


def travel(
    sent: dict[Key, list[Transmission]], receiver: Place, until_ns: int, cycle_ns: int, slack_ns: int
) -> dict[Key, Pairing]:
    """Every id over one hop. missing: only of what had to arrive.

    That is what was sent while the receiver listened, up to until_ns; what is under way in its last cycle need not.
    """
    received = receiver.by_id(own=False)
    until_ns = min(until_ns, receiver.end_ns - cycle_ns)
    found: dict[Key, Pairing] = {}
    for key, departures in sent.items():
        found[key] = pair(departures, received.get(key, []), slack_ns)
        found[key].missing = [row for row in found[key].missing if receiver.start_ns <= row.end_ns < until_ns]
    return found


def differences(found: dict[Key, Pairing]) -> str:
    """What was lost, doubled or out of order, by id in words; "" for nothing."""
    lost = [f"{key[0]:03X} ({len(one.missing)})" for key, one in found.items() if one.missing]
    extra = [f"{key[0]:03X} ({len(one.extra)})" for key, one in found.items() if one.extra]
    texts = [
        f"{what}: {_listed(which)}" for what, which in (("lost", lost), ("doubled or out of order", extra)) if which
    ]
    return "; ".join(texts)


def count(found: Iterable[Pairing]) -> int:
    """Frames that were lost, doubled or out of order."""
    return sum(len(one.missing) + len(one.extra) for one in found)


def _listed(which: list[str]) -> str:
    more = f" and {len(which) - _MOST_IDS} more ids" if len(which) > _MOST_IDS else ""
    return ", ".join(which[:_MOST_IDS]) + more
