"""Live control over the bus: a command frame in, a status frame out, so that a test script or a device starts a chain.

Off unless a rig asks for it. Both are classical 11-bit data frames of 8 bytes (docs/live_control.md has examples):

    command   0xC5  word    injector  sequence  0      0      CRC high  CRC low
    status    0x5C  result  injector  sequence  state  phase  CRC high  CRC low

The CRC is CRC-16/IBM-3740 (polynomial 0x1021, start 0xFFFF) over the six bytes before it: a frame that another program
happens to send with this COB-ID starts no fault. A command equal to the one before is answered and not done again: a
sender may repeat it, and CAN itself doubles a frame whose very last bit is disturbed (ISO 11898-1; EN 50159:
repetition). Whoever wants the same thing again counts the sequence number up.
Commands are read on one side, before any fault, and not forwarded; answers go out on that side.
Leaves out: authentication; whoever can send on the bus could inject faults without a gateway.
"""

import binascii
from dataclasses import dataclass
from typing import Final, final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER, Out
from canopen_exo.plan import HLC_STATUS, SYNC
from fi_gateway.activation import Activation
from fi_gateway.control import ARM, DISARM, DISARMED, HELD, NAMED, RESUME, START, STOP, TRIGGER, LiveControl, perform
from fi_gateway.errors import FaultError
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, CommandPort
from fi_gateway.phase import Phase

QUERY: Final = "query"
WORDS: Final = {1: ARM, 2: DISARM, 3: TRIGGER, 4: START, 5: STOP, 6: RESUME, 7: QUERY}
"""Byte 1 of a command; QUERY asks for a status only."""
NO_INJECTOR: Final = 0xFF
"""Byte 2 when it is about the gateway; injectors are counted from 0 as written in the file."""

DONE: Final = 0
IGNORED: Final = 1
REFUSED: Final = 2
UNKNOWN_INJECTOR: Final = 3
UNKNOWN_WORD: Final = 4
REPEATED: Final = 5
ACTIVATED: Final = 0x80
"""Byte 1 of a status. ACTIVATED comes unasked, sequence 0, when the window of an injector has opened."""

TIME_ZERO_KNOWN: Final = 1
STOPPED: Final = 2
INJECTING: Final = 4
"""Bits of byte 4 of a status: time 0 is known; injection is stopped; a window is open."""

PHASES: Final = {
    Phase.INERT.value: 0,
    Phase.ARMED.value: 1,
    Phase.WAITING.value: 2,
    Phase.ACTIVE.value: 3,
    Phase.SPENT.value: 4,
    DISARMED: 5,
    HELD: 6,
    "": 0xFF,
}
"""Byte 5 of a status: the injector's state as in the listing; 0xFF when it is about the gateway."""

DEFAULT_COMMAND_ID: Final = 0x6C0
DEFAULT_STATUS_ID: Final = 0x6C1
"""Neither in the predefined connection set nor restricted (CiA 301, 7.3.5)."""

_COMMAND: Final = 0xC5
_STATUS: Final = 0x5C
_CRC_START: Final = 0xFFFF


@dataclass(frozen=True, slots=True)
class Command:
    """A well-formed command. word: its number, which may not be in WORDS."""

    word: int
    injector: int
    sequence: int

    def frame(self, cob_id: int) -> Frame:
        """The frame that says so."""
        return Frame(cob_id, _sealed(bytes((_COMMAND, self.word, self.injector, self.sequence, 0, 0))))


@dataclass(frozen=True, slots=True)
class Status:
    """What a status frame says. result: DONE .. ACTIVATED; state: bits; phase: one of PHASES."""

    result: int
    injector: int
    sequence: int
    state: int
    phase: str

    def frame(self, cob_id: int) -> Frame:
        """The frame that says so."""
        content = (_STATUS, self.result, self.injector, self.sequence, self.state, PHASES[self.phase])
        return Frame(cob_id, _sealed(bytes(content)))


def read_command(data: bytes) -> Command | None:
    """The command in a payload; None for anything else (length, first byte, reserved bytes, CRC)."""
    if len(data) != 8 or data[0] != _COMMAND or data[4] or data[5] or _sealed(data[:6]) != data:
        return None
    return Command(data[1], data[2], data[3])


def read_status(data: bytes) -> Status | None:
    """The status in a payload; None for anything else."""
    if len(data) != 8 or data[0] != _STATUS or _sealed(data[:6]) != data:
        return None
    for phase, number in PHASES.items():
        if number == data[5]:
            return Status(data[1], data[2], data[3], data[4], phase)
    return None


@final
class BusControl(CommandPort):
    """Reads commands for a gateway and answers them; `gateway.attach` puts it to work.

    port: the side it talks on; bad: frames with the command's COB-ID that are no command.
    """

    def __init__(
        self,
        control: LiveControl,
        port: int,
        command_id: int = DEFAULT_COMMAND_ID,
        status_id: int = DEFAULT_STATUS_ID,
    ) -> None:
        super().__init__(port, command_id)
        if port not in (CONTROLLER_PORT, DRIVE_PORT):
            raise FaultError(
                f"bus control: port {port} given, allowed {CONTROLLER_PORT} (controller side) and {DRIVE_PORT} "
                "(drive side)"
            )
        for what, cob_id in (("command", command_id), ("status", status_id)):
            if not 0 < cob_id <= 0x7FF or cob_id in (SYNC, HLC_STATUS):
                raise FaultError(
                    f"bus control: COB-ID {cob_id:#x} given for the {what}, allowed 0x1..0x7ff except {SYNC:#x} (SYNC) "
                    f"and {HLC_STATUS:#x} (the controller's status); {DEFAULT_COMMAND_ID:#x} and "
                    f"{DEFAULT_STATUS_ID:#x} are free by default"
                )
        if command_id == status_id:
            raise FaultError(f"bus control: COB-ID {command_id:#x} given for command and status; each needs its own")
        self.status_id: Final[int] = status_id
        self.bad: int = 0
        self._control: Final[LiveControl] = control
        self._last: bytes = b""

    def command(self, now: int, frame: Frame, out: Out) -> None:
        """Do what the frame says and answer; what is no command is counted."""
        command = read_command(frame.data)
        if command is None:
            self.bad += 1
            return
        result = REPEATED
        if frame.data != self._last:
            self._last = frame.data
            result = self._obey(now, command)
        out.send(self.port, self._status(result, command.injector, command.sequence))

    def report(self, opened: list[Activation], out: Out) -> None:
        """One status for each window that has opened."""
        names = [injector.name for injector in self._control.gateway.injectors]
        for one in opened:
            out.send(self.port, self._status(ACTIVATED, min(names.index(one.injector), NO_INJECTOR), 0))

    def _obey(self, now: int, command: Command) -> int:
        """The result of the command."""
        word = WORDS.get(command.word)
        if word is None:
            return UNKNOWN_WORD
        name = ""
        injectors = self._control.gateway.injectors
        if command.injector != NO_INJECTOR or word in NAMED:
            if command.injector >= min(len(injectors), NO_INJECTOR):
                return UNKNOWN_INJECTOR
            name = injectors[command.injector].name
        if word == QUERY:
            return DONE
        try:
            return DONE if perform(self._control, word, name, now, f"bus {self.cob_id:#x}") else IGNORED
        except FaultError:  # its row says why
            return REFUSED

    def _status(self, result: int, number: int, sequence: int) -> Frame:
        gateway = self._control.gateway
        state = STOPPED if self._control.stopped else 0
        if gateway.time_zero != NEVER:
            state |= TIME_ZERO_KNOWN
        for injector in gateway.injectors:
            if injector.phase is Phase.ACTIVE:
                state |= INJECTING
        rows = self._control.listing()
        phase = rows[number].state if number < min(len(rows), NO_INJECTOR) else ""
        return Status(result, number, sequence, state, phase).frame(self.status_id)


def _sealed(content: bytes) -> bytes:
    """The content with its CRC behind it."""
    return content + binascii.crc_hqx(content, _CRC_START).to_bytes(2, "big")
