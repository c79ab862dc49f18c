"""Any python-can bus as a channel of the real-time loop.

Source: python-can 4.6, `can.BusABC`. The one place, beside the hub's plug-in, that imports python-can.
A bus without a file descriptor is asked every millisecond. A send that fails is tried again for 100 ms, then the frame
is lost and counted, the interface counts as down; a CAN FD frame on a bus that cannot carry it is lost at once. A bus
that fails to read is closed and opened again with a back-off of 0.1 s to 2 s.
Leaves out: sending the raw DLC 9..15 of a frame, on which several interfaces fail (it goes as 8, which the receivers'
data do not show), and stamps of a device's own clock, which start anywhere: those frames get the time of reading.
"""

import configparser
import contextlib
import errno
import sys
import time
from collections.abc import Callable
from typing import Any, Final, final

import can
import can.util

from canopen_exo.bus.channel import Arrival, Channel, StampClock
from canopen_exo.bus.error_frame import read_error_frame
from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState, PortState
from canopen_exo.errors import CanopenExoError

_POLL_NS: Final = MS
_GIVE_UP_NS: Final = 100 * MS
_FIRST_BACK_OFF_NS: Final = 100 * MS
_LAST_BACK_OFF_NS: Final = 2 * SECOND
_BATCH: Final = 256
"""Frames read at a time; a flood must not keep the loop from its wake-ups."""

_WALL_CLOCK_NS: Final = 5 * SECOND
"""A stamp nearer to the wall clock than this is on it; a device's own clock would be days away."""

_FD_LENGTHS: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)

_REFUSALS: Final = (
    can.CanError,
    OSError,
    ValueError,
    TypeError,
    NotImplementedError,
    ImportError,
    LookupError,
    AttributeError,
    NameError,
)
"""What python-can's interfaces raise when they cannot be opened; the last three where a vendor's library is missing."""

_HEARS_ITSELF: Final = "udp_multicast"
"""The one interface of python-can that takes what it sent itself as received, with nothing to tell it by."""


def to_message(frame: Frame) -> can.Message:
    """The frame as python-can has it."""
    flags = frame.flags
    if flags & FLAG_REMOTE:
        return can.Message(
            arbitration_id=frame.can_id,
            is_extended_id=flags & FLAG_EXTENDED != 0,
            is_remote_frame=True,
            dlc=min(frame.dlc, 8),
        )
    return can.Message(
        arbitration_id=frame.can_id,
        is_extended_id=flags & FLAG_EXTENDED != 0,
        data=frame.data,
        is_fd=flags & FLAG_FD != 0,
        bitrate_switch=flags & FLAG_BRS != 0,
        error_state_indicator=flags & FLAG_ESI != 0,
    )


def from_message(message: can.Message) -> Frame | None:
    """The frame in a python-can message; None when there is none in it (too long, or an error frame)."""
    if message.is_error_frame:
        return None
    extended = message.is_extended_id
    flags = FLAG_EXTENDED if extended else 0
    can_id = message.arbitration_id & (0x1FFFFFFF if extended else 0x7FF)
    data = bytes(message.data or b"")
    if message.is_fd:
        if len(data) > 64:
            return None
        for length in _FD_LENGTHS:  # any other length was padded with zeros by whoever put it on a wire
            if length >= len(data):
                data = data.ljust(length, b"\0")
                break
        flags |= FLAG_FD
        flags |= (FLAG_BRS if message.bitrate_switch else 0) | (FLAG_ESI if message.error_state_indicator else 0)
        return Frame(can_id, data, flags)
    if message.is_remote_frame:
        return Frame(can_id, b"", flags | FLAG_REMOTE, min(max(message.dlc, 0), 8))
    if len(data) > 8:
        return None
    return Frame(can_id, data, flags, message.dlc if len(data) == 8 and 9 <= message.dlc <= 15 else -1)


def configuration(context: str) -> dict[str, str]:
    """What python-can's environment variables, then its can.conf say: interface, channel, bitrate and more.

    context: see `open_python_can`; its values come before the general ones. Raises CanopenExoError.
    """
    sections = [context, ""] if context else [""]
    found: dict[str, str] = {}
    try:
        sources = [can.util.load_environment_config(section or None) for section in sections]
        sources += [can.util.load_file_config(None, section or "default") for section in sections]
        for source in sources:
            found = {**source, **found}  # the earlier one counts
    except (ValueError, TypeError, OSError, configparser.Error) as error:  # CAN_CONFIG no JSON, can.conf no INI file
        why = " ".join(str(error).split())
        raise CanopenExoError(f"bus: python-can's configuration cannot be read: {why}; correct it") from error
    return found


def open_python_can(interface: str, channel: str, bitrate: int | None, context: str = "") -> can.BusABC:
    """A bus by python-can's own names; what else it needs comes from its configuration (can.conf, CAN_CONFIG).

    context: section of can.conf, or suffix of the CAN_ variables. Raises CanopenExoError with one line.
    """
    name = f"{interface}:{channel}"
    if interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise CanopenExoError(f"bus {name}: there is no interface {interface!r}; python-can has {known}")
    if interface == _HEARS_ITSELF:
        raise CanopenExoError(
            f"bus {name}: {interface} hears itself, a gateway on it would pass on its own frames for ever; use `hub:`, "
            "also from other machines (exo-hil hub --listen)"
        )
    try:
        # a loop that hears itself answers itself: whatever python-can's configuration says, own frames stay away
        given: dict[str, Any] = {"receive_own_messages": False}
        if bitrate is not None:
            given["bitrate"] = bitrate
        return can.Bus(channel=channel, interface=interface, config_context=context or None, **given)
    except _REFUSALS as error:
        why = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise CanopenExoError(
            f"bus {name}: python-can cannot open it: {why}; install what its interface {interface!r} needs "
            "(python-can's documentation names it), or use `hub:`"
        ) from error


@final
class PythonCanChannel(Channel):
    """One python-can bus. open_bus: opens it; called at once, and again when it was lost.

    CanopenExoError from the first opening passes to the caller, later failures become notices.
    """

    def __init__(self, name: str, open_bus: Callable[[], can.BusABC]) -> None:
        super().__init__(name)
        self._open_bus: Final = open_bus
        self._stamps: Final = StampClock()
        self._notices: list[PortState] = []
        self._state: PortState | None = None
        self._is_down: bool = False
        self._is_closed: bool = False
        self._fd: int = -1
        self._failing_since: int = NEVER
        self._back_off_ns: int = _FIRST_BACK_OFF_NS
        self._bus: can.BusABC | None = None
        self._adopt(open_bus())

    def fileno(self) -> int:
        """The bus's descriptor; -1 when it has none or is away."""
        return self._fd

    def receive(self) -> list[Arrival]:
        """What the bus holds, at most 256 messages at once; opens again what was away."""
        arrivals: list[Arrival] = []
        now = time.monotonic_ns() - self.epoch_ns
        if self._bus is None and not self._is_closed:
            self._reopen(now)
        bus = self._bus
        if bus is not None:
            self.poll_at = NEVER if self._fd >= 0 else now + _POLL_NS
            messages: list[can.Message] = []
            failure: Exception | None = None
            try:
                while len(messages) < _BATCH:
                    message = bus.recv(timeout=0)
                    if message is None:
                        break
                    messages.append(message)
                else:
                    self.poll_at = now  # the bus may hold more in itself, where select does not see it
            except (can.CanError, OSError) as error:
                failure = error
            now = self._stamps.begin(self.epoch_ns)  # not before reading: no stamp is later than now
            wall = time.time_ns()
            for message in messages:
                self._take(message, wall, arrivals)
            if failure is not None:
                self._lose(f"cannot read: {failure}", now)
        if self._notices:
            for state in self._notices:
                arrivals.append(Arrival(now, None, state))
            self._notices = []
        return arrivals

    def send(self, frame: Frame) -> bool:
        """Hand a frame to python-can, without waiting."""
        bus = self._bus
        if bus is None:
            self.lost += 1
            return True
        try:
            bus.send(to_message(frame), timeout=0)
        except (ValueError, NotImplementedError):  # a frame this interface cannot send, such as CAN FD
            self.lost += 1
            return True
        except (can.CanError, OSError) as error:
            return self._refused(bus, frame, error)
        if self._failing_since != NEVER or self._is_down:
            self._failing_since = NEVER
            self._note(ErrorState.ERROR_ACTIVE, "sending again", time.monotonic_ns() - self.epoch_ns)
        return True

    def close(self) -> None:
        """Shut the bus down for good."""
        self._is_closed = True
        self.poll_at = NEVER
        self._drop()

    def _refused(self, bus: can.BusABC, frame: Frame, error: Exception) -> bool:
        """A send failed: most interfaces do not say whether their queue is full or the bus is gone; time tells.

        CAN FD is another matter: a bus that is not open for it, or says EINVAL, will not take the frame later either.
        """
        if frame.flags & FLAG_FD:
            code = error.errno if isinstance(error, OSError) else getattr(error, "error_code", None)
            if code == errno.EINVAL or bus.protocol is can.CanProtocol.CAN_20:
                self.lost += 1
                return True
        now = time.monotonic_ns() - self.epoch_ns
        if self._failing_since == NEVER:
            self._failing_since = now
        if now - self._failing_since < _GIVE_UP_NS:
            self.send_at = now + _POLL_NS
            return False
        self.lost += 1
        self._note(ErrorState.DOWN, f"cannot send: {error}", now)
        return True

    def _take(self, message: can.Message, wall: int, arrivals: list[Arrival]) -> None:
        stamped = int(message.timestamp * 1e9)
        stamp = self._stamps.at(stamped if abs(stamped - wall) < _WALL_CLOCK_NS else wall)
        if message.is_error_frame:
            self.errors += 1
            data = bytes(message.data or b"")
            # 8 bytes: SocketCAN's classes and bytes, which the hub and several interfaces use; others have their own
            can_id = message.arbitration_id if len(data) == 8 else 0
            self._state = read_error_frame(can_id, data if len(data) == 8 else b"", self._state)
            arrivals.append(Arrival(stamp, None, self._state))
            return
        frame = from_message(message)
        if frame is None:
            self.malformed += 1
        else:
            arrivals.append(Arrival(stamp, frame, None))

    def _note(self, state: ErrorState, cause: str, now: int) -> None:
        """Tell the node with the next `receive`, which is asked for at once."""
        is_down = state is ErrorState.DOWN
        if self._is_down == is_down:
            return
        self._is_down = is_down
        self._state = PortState(0, state, 0, 0, " ".join(cause.split()))
        self._notices.append(self._state)
        self.poll_at = now

    def _adopt(self, bus: can.BusABC) -> None:
        self._bus = bus
        fd = -1
        if sys.platform != "win32":  # there it may be a handle, for which select cannot wait
            with contextlib.suppress(NotImplementedError, OSError, can.CanError):
                fd = bus.fileno()
        self._fd = fd if isinstance(fd, int) and fd >= 0 else -1
        self.poll_at = 0

    def _lose(self, cause: str, now: int) -> None:
        """The bus is of no use any more."""
        self._drop()
        self._note(ErrorState.DOWN, cause, now)
        self._back_off_ns = _FIRST_BACK_OFF_NS
        self.poll_at = now

    def _reopen(self, now: int) -> None:
        """Try once; the next attempt comes after a longer time."""
        try:
            self._adopt(self._open_bus())
        except CanopenExoError:
            self.poll_at = now + self._back_off_ns
            self._back_off_ns = min(2 * self._back_off_ns, _LAST_BACK_OFF_NS)
            return
        self._failing_since = NEVER
        self._note(ErrorState.ERROR_ACTIVE, "open again", now)

    def _drop(self) -> None:
        if self._bus is not None:
            with contextlib.suppress(can.CanError, OSError):
                self._bus.shutdown()
        self._bus = None
        self._fd = -1
