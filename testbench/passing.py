"""What our gateway made of the frames that came to it, by its own record: passed on, lost, or taken by a fault.

A fault may drop, change, delay and add frames while its window is open, and what it has put off leaves later. So within
a window, one cycle more on either side, frames of the node it is at are not looked for; after the first window a frame
more is no surprise. Everything else that came in leaves once, as it came, in its order.
"""

from bisect import bisect_right
from dataclasses import dataclass
from typing import Final

from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import NEVER
from canopen_exo.plan import BusPlan
from testbench.pairing import Key, Pairing, is_request, pair
from testbench.parts import GatewayPart

_ANY: Final = 0
"""Node id of a fault that is at no single joint."""


@dataclass(slots=True)
class _Windows:
    """When faults were active. spans: by node id (_ANY: at any), rising, apart; first_ns: when the first one began."""

    spans: dict[int, list[tuple[int, int]]]
    first_ns: int

    def has(self, row: Transmission) -> bool:
        """Whether a fault may have had its hands on that frame when it came in."""
        return self._covers(row.frame.can_id & 0x7F, row.end_ns) or self._covers(_ANY, row.end_ns)

    def _covers(self, node_id: int, time_ns: int) -> bool:
        spans = self.spans.get(node_id, [])
        at = bisect_right(spans, (time_ns, NEVER)) - 1
        return at >= 0 and time_ns < spans[at][1]


def pass_through(gateway: GatewayPart, plan: BusPlan, until_ns: int, slack_ns: int) -> dict[tuple[int, Key], Pairing]:
    """(bus it came in on, id) -> how it left on the other. missing: of those that came in before until_ns."""
    windows = _windows(gateway, plan)
    until_ns = min(until_ns, gateway.service.end_ns - plan.cycle_ns)
    came: dict[tuple[int, Key], list[Transmission]] = {}
    left: dict[tuple[int, Key], list[Transmission]] = {}
    at_once: dict[tuple[int, Key], list[tuple[Transmission, Transmission]]] = {}
    rows = [row for row in gateway.rows if not is_request(row.frame.can_id)]
    before: Transmission | None = None
    for row in rows:
        where = (row.bus if row.sender < 0 else 1 - row.bus, (row.frame.can_id, row.frame.flags))
        if row.sender < 0:
            came.setdefault(where, []).append(row)
        elif before is not None and _is_same(before, row) and windows.has(before):
            came[where].pop()
            at_once.setdefault(where, []).append((before, row))
        else:
            left.setdefault(where, []).append(row)
        before = row
    found: dict[tuple[int, Key], Pairing] = {}
    for where in came.keys() | left.keys():
        one = pair(came.get(where, []), left.get(where, []), slack_ns)
        one.pairs = [both for both in one.pairs if not windows.has(both[0])] + at_once.get(where, [])
        one.missing = [row for row in one.missing if row.end_ns < until_ns and not windows.has(row)]
        one.extra = [row for row in one.extra if row.end_ns < windows.first_ns]
        found[where] = one
    return found


def _is_same(arrival: Transmission, sending: Transmission) -> bool:
    """Whether a frame that came in is what is sent right afterwards."""
    one, other = arrival.frame, sending.frame
    return arrival.sender < 0 and arrival.bus != sending.bus and (one.can_id, one.flags) == (other.can_id, other.flags)


def _windows(gateway: GatewayPart, plan: BusPlan) -> _Windows:
    nodes = {joint.name: joint.node_id for joint in plan.joints}
    spans: dict[int, list[tuple[int, int]]] = {}
    for one in sorted(gateway.activations, key=lambda one: one.start_ns):
        node = spans.setdefault(nodes.get(one.signal.partition(".")[0], _ANY), [])
        start, end = one.start_ns - plan.cycle_ns, min(one.end_ns + plan.cycle_ns, NEVER)
        if node and start <= node[-1][1]:
            earlier = node.pop()
            start, end = earlier[0], max(earlier[1], end)
        node.append((start, end))
    return _Windows(spans, min((span[0] for node in spans.values() for span in node), default=NEVER))
