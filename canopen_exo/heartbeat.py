"""Heartbeat: producer and consumer.

Source: CiA 301, 7.2.8.2.2 (error control: heartbeat protocol), objects 0x1016 and 0x1017.
Leaves out: node guarding.
"""

from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.nmt import NmtState
from canopen_exo.plan import HEARTBEAT


def heartbeat_frame(node_id: int, state: NmtState) -> Frame:
    """The heartbeat of a node; Initialising makes it the boot-up message."""
    return Frame(HEARTBEAT + node_id, bytes((state.value,)))


@final
class HeartbeatProducer:
    """Sends the state every period. due: time of the next heartbeat [ns], NEVER when off (period 0)."""

    def __init__(self, node_id: int) -> None:
        self.node_id: Final[int] = node_id
        self.period_ns: int = 0
        self.due: int = NEVER

    def start(self, now: int, period_ns: int) -> None:
        """Set the period; a new one starts counting now, 0 switches off."""
        self.period_ns = period_ns
        self.due = now + period_ns if period_ns else NEVER

    def beat(self, now: int, state: NmtState) -> Frame:
        """The heartbeat that is due, and the time of the next one."""
        self.due += self.period_ns
        if self.due <= now:  # woken late, as on a real clock: no burst to catch up
            self.due = now + self.period_ns
        return heartbeat_frame(self.node_id, state)


@final
class HeartbeatConsumer:
    """Watches one producer; monitoring starts with its first heartbeat (CiA 301, object 0x1016).

    node_id: 0 when the entry is unused. state: last one heard. lost: True from the time-out to the next heartbeat.
    """

    def __init__(self, node_id: int, timeout_ns: int) -> None:
        self.node_id: Final[int] = node_id
        self.timeout_ns: Final[int] = timeout_ns
        self.state: int = -1
        self.lost: bool = False
        self.deadline: int = NEVER

    def watch(self, now: int) -> None:
        """Start monitoring before the first heartbeat."""
        self.deadline = min(self.deadline, now + self.timeout_ns)

    def received(self, now: int, data: bytes) -> bool:
        """A heartbeat came; True when it ends a loss. Messages without a state byte are no heartbeats."""
        if len(data) != 1:
            return False
        self.state = data[0] & 0x7F
        self.deadline = now + self.timeout_ns
        back = self.lost
        self.lost = False
        return back

    def lose(self) -> None:
        """`deadline` is reached: the producer has been silent for the time-out."""
        self.deadline = NEVER
        self.lost = True
