"""What our gateway made of the frames that came to it, by its own record: passed on, lost, or taken by a fault.

A fault may drop, change, delay and add frames of its target while its window is open, and what it has put off leaves
later. So within a window, one cycle more on either side, frames of the COB-IDs it is at are not looked for, in the
directions it is at; what came in behind frames that were put off has to wait for them, and is not late for that. After
the first window a frame more of those ids is no surprise, nor one of any id where a fault has added frames. Everything
else that came in leaves once, as it came, in its order.
"""

from bisect import bisect_right
from dataclasses import dataclass
from typing import Final

from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import NEVER
from canopen_exo.plan import BusPlan
from fi_gateway.activation import Activation
from testbench.pairing import Key, Pairing, is_request, pair
from testbench.parts import GatewayPart, Reach

Where = tuple[int, Key]
"""The bus that a frame came in on, its id and flags."""

_FROM_CONTROLLER: Final = 0
_FROM_DRIVES: Final = 1


@dataclass(slots=True)
class _Windows:
    """When faults were active. spans: by target, rising, apart; delays: those in which frames were put off.

    adds_from: from when on frames of other ids may have been added.
    """

    spans: dict[Where, list[tuple[int, int]]]
    delays: dict[Where, list[tuple[int, int]]]
    adds_from: int

    def has(self, where: Where, row: Transmission) -> bool:
        """Whether a fault may have had its hands on that frame when it came in."""
        spans = self.spans.get(where, [])
        at = bisect_right(spans, (row.end_ns, NEVER)) - 1
        return at >= 0 and row.end_ns < spans[at][1]

    def punctual(self, where: Where, one: Pairing) -> list[tuple[Transmission, Transmission]]:
        """The pairs that no fault had to do with: neither within a window, nor behind what one put off."""
        delays = self.delays.get(where, [])
        held_ns = [-NEVER] * len(delays)  # when the last frame that each put off left
        for row in one.extra:
            at = bisect_right(delays, (row.end_ns, NEVER)) - 1
            if at >= 0:
                held_ns[at] = row.end_ns
        found = []
        for before, row in one.pairs:
            at = bisect_right(delays, (before.end_ns, NEVER)) - 1
            if at >= 0 and before.end_ns < delays[at][1]:
                held_ns[at] = max(held_ns[at], row.end_ns)
            if not self.has(where, before) and (at < 0 or before.end_ns >= held_ns[at]):
                found.append((before, row))
        return found

    def explains(self, where: Where, row: Transmission) -> bool:
        """Whether a fault may have made that frame, which left and had not come in."""
        spans = self.spans.get(where)
        return row.end_ns >= min(self.adds_from, spans[0][0] if spans else NEVER)


def pass_through(gateway: GatewayPart, plan: BusPlan, until_ns: int, slack_ns: int) -> dict[Where, Pairing]:
    """(bus it came in on, id) -> how it left on the other. missing: of those that came in before until_ns."""
    windows = _windows(gateway, plan)
    until_ns = min(until_ns, gateway.service.end_ns - plan.cycle_ns)
    came: dict[Where, list[Transmission]] = {}
    left: dict[Where, list[Transmission]] = {}
    at_once: dict[Where, list[tuple[Transmission, Transmission]]] = {}
    rows = [row for row in gateway.rows if not is_request(row.frame.can_id)]
    before: Transmission | None = None
    for row in rows:
        where = (row.bus if row.sender < 0 else 1 - row.bus, (row.frame.can_id, row.frame.flags))
        if row.sender < 0:
            came.setdefault(where, []).append(row)
        elif before is not None and _is_same(before, row) and windows.has(where, before):
            came[where].pop()
            at_once.setdefault(where, []).append((before, row))
        else:
            left.setdefault(where, []).append(row)
        before = row
    found: dict[Where, Pairing] = {}
    for where in came.keys() | left.keys():
        one = pair(came.get(where, []), left.get(where, []), slack_ns)
        one.pairs = windows.punctual(where, one) + at_once.get(where, [])
        one.missing = [row for row in one.missing if row.end_ns < until_ns and not windows.has(where, row)]
        one.extra = [row for row in one.extra if not windows.explains(where, row)]
        found[where] = one
    return found


def _is_same(arrival: Transmission, sending: Transmission) -> bool:
    """Whether a frame that came in is what is sent right afterwards."""
    one, other = arrival.frame, sending.frame
    return arrival.sender < 0 and arrival.bus != sending.bus and (one.can_id, one.flags) == (other.can_id, other.flags)


def _windows(gateway: GatewayPart, plan: BusPlan) -> _Windows:
    spans: dict[Where, list[tuple[int, int]]] = {}
    delays: dict[Where, list[tuple[int, int]]] = {}
    adds_from = NEVER
    for one in sorted(gateway.activations, key=lambda one: one.start_ns):
        reach = gateway.injectors[one.injector]
        start, end = one.start_ns - plan.cycle_ns, min(one.end_ns + plan.cycle_ns, NEVER)
        if reach.reports or _adds(one):
            adds_from = min(adds_from, start)
        for where in _targets(reach):
            if one.frames_delayed:
                delays.setdefault(where, []).append((start, end))
            known = spans.setdefault(where, [])
            if known and start <= known[-1][1]:
                known[-1] = (known[-1][0], max(known[-1][1], end))
            else:
                known.append((start, end))
    return _Windows(spans, delays, adds_from)


def _targets(reach: Reach) -> list[Where]:
    """What an injector may have its hands on: base data frames only."""
    ways = ((_FROM_CONTROLLER, reach.to_drives), (_FROM_DRIVES, reach.to_controller))
    return [(bus, (cob_id, 0)) for bus, is_meant in ways if is_meant for cob_id in reach.cob_ids]


def _adds(one: Activation) -> bool:
    """Whether frames of other ids than its target's came of it."""
    before, after = one.first_before, one.first_after
    return one.frames_inserted > 0 or (before is not None and after is not None and before.can_id != after.can_id)
