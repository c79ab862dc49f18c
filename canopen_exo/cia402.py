"""The CiA 402 drive state machine, from both sides: the drive's and the master's.

Source: CiA 402-2 / IEC 61800-7-201: figure "power drive system finite state automaton", table of state coding
(statusword bits 0-3, 5, 6) and table of command coding (controlword bits 0-3, 7).
"""

from enum import Enum
from typing import Final, final


class DriveState(Enum):
    """PDS FSA states; the value is the state's statusword pattern."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class DriveCommand(Enum):
    """Commands of the controlword, and the two events that come from inside."""

    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE_OPERATION = "enable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"
    FAULT_RESET = "fault reset"


VOLTAGE_ENABLED: Final = 1 << 4
WARNING: Final = 1 << 7
REMOTE: Final = 1 << 9
INTERNAL_LIMIT: Final = 1 << 11
FAULT_RESET_BIT: Final = 1 << 7

_S: Final = DriveState
_C: Final = DriveCommand

TRANSITIONS: Final[dict[tuple[DriveState, DriveCommand], DriveState]] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.READY_TO_SWITCH_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 3 and 4 in one command
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,  # 5, disable operation
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.FAULT, _C.FAULT_RESET): _S.SWITCH_ON_DISABLED,  # 15
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16
}
"""Transitions by command; 0, 1 are automatic at power-up, 13 and 14 are the drive's own fault reaction."""


def decode_controlword(controlword: int) -> DriveCommand | None:
    """The command in bits 0-3; None for the patterns the standard leaves open. Fault reset is an edge, not here."""
    if not controlword & 0x02:
        return _C.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return _C.QUICK_STOP
    if not controlword & 0x01:
        return _C.SHUTDOWN
    return _C.ENABLE_OPERATION if controlword & 0x08 else _C.SWITCH_ON


def decode_statusword(statusword: int) -> DriveState | None:
    """The state in a statusword; None for a pattern the standard does not define."""
    return _BY_PATTERN.get(statusword & 0x6F)


_NARROW: Final = (
    _S.NOT_READY_TO_SWITCH_ON,
    _S.SWITCH_ON_DISABLED,
    _S.FAULT_REACTION_ACTIVE,
    _S.FAULT,
)
"""States coded without bit 5 (mask 0x4F); the others have mask 0x6F."""

_BY_PATTERN: Final[dict[int, DriveState]] = {
    **{state.value: state for state in DriveState},
    **{state.value | 0x20: state for state in _NARROW},
}
"""States by bits 0-3, 5, 6 of the statusword."""


def enabling_controlword(state: DriveState | None) -> int:
    """The controlword that brings a drive one state nearer to Operation enabled; 0 where only waiting helps."""
    if state is _S.FAULT:
        return FAULT_RESET_BIT
    if state is _S.SWITCH_ON_DISABLED:
        return 0x06
    if state is _S.READY_TO_SWITCH_ON:
        return 0x07
    if state in (_S.SWITCHED_ON, _S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE):
        return 0x0F
    return 0x00


@final
class DriveStateMachine:
    """The drive's side. state: present state; `controlword` applies commands; faults are the drive's own doing."""

    def __init__(self) -> None:
        self.state: DriveState = _S.SWITCH_ON_DISABLED
        self.last: int = 0

    def controlword(self, controlword: int) -> bool:
        """Apply a controlword; True when the state changed. Bit 7 acts on its 0 -> 1 edge only."""
        rising = controlword & ~self.last & FAULT_RESET_BIT
        self.last = controlword
        command = _C.FAULT_RESET if rising and self.state is _S.FAULT else decode_controlword(controlword)
        return self.command(command) if command is not None else False

    def command(self, command: DriveCommand) -> bool:
        """Apply one command; commands without a transition in this state are ignored."""
        after = TRANSITIONS.get((self.state, command))
        if after is None or after is self.state:
            return False
        self.state = after
        return True

    def fault(self) -> None:
        """Transitions 13 and 14: the fault reaction (torque off at once) is over within one step."""
        self.state = _S.FAULT

    @property
    def statusword(self) -> int:
        """Bits 0-6 of the state, with voltage enabled where the power stage may be fed, and remote."""
        word = self.state.value | REMOTE
        if self.state not in (_S.NOT_READY_TO_SWITCH_ON, _S.FAULT):
            word |= VOLTAGE_ENABLED
        return word
