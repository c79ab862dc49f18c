"""Network management: states, commands and the slave's state machine.

Source: CiA 301, 7.2.8 (NMT), 7.3.2 (NMT state machine, figure 46; services per state, table 38).
"""

from enum import Enum
from typing import Final, final

from canopen_exo.bus.frame import Frame


class NmtState(Enum):
    """NMT slave states; the value is the state byte of the heartbeat (0 is the boot-up message)."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class NmtCommand(Enum):
    """Command specifiers of the NMT message (CiA 301, 7.2.8.3.1)."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


AFTER: Final[dict[NmtCommand, NmtState]] = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
    NmtCommand.RESET_NODE: NmtState.INITIALISING,
    NmtCommand.RESET_COMMUNICATION: NmtState.INITIALISING,
}
"""The state each command leads to, from every state but Initialising, in which commands are not served."""

ALL_NODES: Final = 0


def nmt_frame(command: NmtCommand, node_id: int) -> Frame:
    """The NMT message; node id 0 addresses all nodes."""
    return Frame(0, bytes((command.value, node_id)))


def decode_nmt(data: bytes, node_id: int) -> NmtCommand | None:
    """The command in an NMT message for this node; None when malformed, unknown or for another node."""
    if len(data) != 2 or data[1] not in (ALL_NODES, node_id):
        return None
    try:
        return NmtCommand(data[0])
    except ValueError:
        return None


@final
class NmtSlave:
    """The slave's side. state: present NMT state; starts Initialising until `initialised`."""

    def __init__(self) -> None:
        self.state: NmtState = NmtState.INITIALISING

    def initialised(self) -> None:
        """Boot-up message sent: Initialising -> Pre-operational, always automatic."""
        self.state = NmtState.PRE_OPERATIONAL

    def command(self, command: NmtCommand) -> bool:
        """Apply a command; True when the state changed or a reset is asked for."""
        if self.state is NmtState.INITIALISING:
            return False
        before = self.state
        self.state = AFTER[command]
        return self.state is not before
