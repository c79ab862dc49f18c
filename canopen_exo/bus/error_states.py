"""The error states of the ports of a medium: what follows from their counters, and who is off the bus.

Source: ISO 11898-1, fault confinement (`confinement` has the rules); linux/can/error.h for how a change shows in the
trace. What bus-off does to queued frames is what Linux does: the interface goes down, so the queue is emptied, and what
is sent until the restart is lost (`Port.lost`).
"""

from typing import Final, final

from canopen_exo.bus.confinement import BUS_OFF_LIMIT, state_of
from canopen_exo.bus.error_frame import write_error_frame
from canopen_exo.bus.frame import FLAG_ERROR, Frame
from canopen_exo.bus.medium import CLOSED, Medium, Port, WireEvent
from canopen_exo.bus.node import NEVER, ErrorState, PortState
from canopen_exo.bus.recovery import RECESSIVE_BITS, Recovery, is_present


@final
class ErrorStates:
    """Of the ports of one medium. absent: ports that are bus-off or unplugged; recoveries: on their way back.

    By port number - holds: how often it is held off; joined_ns: when one that has been plugged in takes part.
    """

    def __init__(self, medium: Medium) -> None:
        self.medium: Final[Medium] = medium
        self.absent: int = 0
        self.recoveries: list[Recovery] = []
        self.holds: dict[int, int] = {}
        self.joined_ns: dict[int, int] = {}

    def count(self, now: int, port: Port, tec: int, rec: int, events: list[WireEvent]) -> None:
        """New counters of a port, and what follows from them."""
        cause = "transmit errors" if tec > port.tec else "receive errors" if rec > port.rec else "frames without error"
        port.tec, port.rec = tec, rec
        state = state_of(tec, rec)
        if state is not port.state and is_present(port):
            self._change(port, state, cause, events)
            if state is ErrorState.BUS_OFF:
                self._go_off(now, port)

    def switch_off(self, now: int, port: Port, events: list[WireEvent]) -> None:
        """Make a port that takes part bus-off, whatever its counters."""
        port.tec = BUS_OFF_LIMIT
        self._change(port, ErrorState.BUS_OFF, "switched off", events)
        self._go_off(now, port)

    def request(self, port: Port, at_ns: int) -> None:
        """Ask a port that is bus-off to restart at `at_ns`."""
        self.recoveries.append(Recovery(port, at_ns))

    def forbid(self, port: Port) -> None:
        """It is not to restart until it is asked anew."""
        self.recoveries = [one for one in self.recoveries if one.port is not port]

    def unplug(self, port: Port) -> None:
        """Its node is gone: what waits is lost, and it is not asked to restart any more."""
        if is_present(port):
            self._close(port)
        self.forbid(port)
        self.joined_ns.pop(port.number, None)
        port.state = ErrorState.DOWN

    def plug(self, now: int, port: Port) -> None:
        """A node is there. It takes part once it has seen 11 recessive bits: the end of a frame has them."""
        if port.state is ErrorState.DOWN:
            self._open(now, port)
            port.state = ErrorState.ERROR_ACTIVE
        end = self.medium.end
        port.ready_ns = now + RECESSIVE_BITS * self.medium.bit_ns if end == NEVER else end
        self.joined_ns[port.number] = port.ready_ns

    def late(self, now: int) -> int:
        """Mask of the ports that take no part in a frame that begins at `now`: they have just been plugged in."""
        if not self.joined_ns:
            return 0
        self.joined_ns = {number: at for number, at in self.joined_ns.items() if at > now}
        return sum([1 << number for number in self.joined_ns])

    def takes_part(self, port: Port, began: int) -> bool:
        """Whether it hears the frame that began then."""
        return is_present(port) and self.joined_ns.get(port.number, 0) <= began

    def hold(self, port: Port) -> None:
        """It is not to restart until `let_go` was called as often as this."""
        self.holds[port.number] = self.holds.get(port.number, 0) + 1
        self.forbid(port)

    def let_go(self, port: Port, restart_at: int) -> None:
        """Ask a port that nobody holds off any more to restart then."""
        self.holds[port.number] -= 1
        if self.holds[port.number] == 0 and port.state is ErrorState.BUS_OFF:
            self.request(port, restart_at)

    def hear(self, free_ns: int, now: int) -> None:
        """The bus was recessive from `free_ns` to `now`, when a frame begins."""
        for recovery in self.recoveries:
            recovery.count(free_ns, now, self.medium.bit_ns)

    def next_ns(self, free_ns: int) -> int:
        """When the first port is back unless another frame begins; NEVER for none."""
        at = NEVER
        for recovery in self.recoveries:
            at = min(at, recovery.done_ns(free_ns, self.medium.bit_ns))
        return at

    def finish(self, now: int, free_ns: int, events: list[WireEvent]) -> None:
        """Restart the ports that have seen enough recessive bits; the bus is idle."""
        left: list[Recovery] = []
        for recovery in self.recoveries:
            if recovery.done_ns(free_ns, self.medium.bit_ns) > now:
                left.append(recovery)
                continue
            self._open(now, recovery.port)
            self._change(recovery.port, ErrorState.ERROR_ACTIVE, "controller restarted", events)
        self.recoveries = left

    def _go_off(self, now: int, port: Port) -> None:
        """Nothing is sent or received until the restart; what waits is lost."""
        self._close(port)
        if port.restart_ns != NEVER:
            self.recoveries.append(Recovery(port, now + port.restart_ns))

    def _change(self, port: Port, state: ErrorState, cause: str, events: list[WireEvent]) -> None:
        restarted = port.state is ErrorState.BUS_OFF
        port.state = state
        notice = PortState(port.number, state, port.tec, port.rec, cause)
        can_id, data = write_error_frame(notice, restarted)
        events.append(WireEvent(Frame(can_id, data, FLAG_ERROR), port, [], notice))

    def _close(self, port: Port) -> None:
        waiting = self.medium.waiting
        kept = [entry for entry in waiting if entry[1] is not port]
        port.lost += len(waiting) - len(kept) + len(port.backlog)
        port.backlog.clear()
        waiting[:] = kept
        port.waiting = CLOSED
        self.absent += 1

    def _open(self, now: int, port: Port) -> None:
        port.tec = port.rec = 0
        port.ready_ns = now
        port.open()
        self.absent -= 1

    def __reduce__(self) -> tuple[type["ErrorStates"], tuple[Medium], dict[str, object]]:
        names = ("absent", "recoveries", "holds", "joined_ns")
        return ErrorStates, (self.medium,), {name: getattr(self, name) for name in names}
