"""The client's end of a hub: the connection, and the channel of the real-time loop on top of it (no python-can).

Source: docs/hub.md. The hub's stamps are on its own CLOCK_MONOTONIC. When the hub's time in its welcome lies between
our sending of the hello and our receiving of the welcome, both read the same clock and the stamps are taken as they
are; otherwise (a hub on another machine) they are moved by the difference, good to half a round trip.
"""

import logging
import os
import select
import socket
import time
from typing import Final, final

from canopen_exo.bus.channel import Arrival, Channel
from canopen_exo.bus.error_frame import read_error_frame
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.hub_wire import (
    FLAG_ERROR,
    KIND_FD_FRAME,
    KIND_FRAME,
    KIND_OVERRUN,
    KIND_REFUSED,
    KIND_REJECTED,
    LONG,
    LOST_RECEIVING,
    RECORD_SIZE,
    SHORT,
    STAMP,
    STAMP_AT,
    TEXT,
    Welcome,
    frame_fault,
    pack_frame,
    pack_hello,
    split_channel,
    unpack_frame,
    unpack_record,
    unpack_text,
    unpack_welcome,
)
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState, PortState
from canopen_exo.errors import CanopenExoError

JOIN_NS: Final = 2 * SECOND
"""How long a connection and its welcome may take."""

_LOG: Final = logging.getLogger(__name__)

_READ_SIZE: Final = 1 << 16
_READS: Final = 4
"""At a time: some 11,000 classical frames; what is left stays readable."""
_FIRST_RETRY_NS: Final = 100 * MS
_LAST_RETRY_NS: Final = 2 * SECOND
_JOIN_POLL_NS: Final = 10 * MS


def addresses(host: str) -> set[str]:
    """The addresses of a host; the host itself when it is not known. 0.0.0.0 and :: lead to this machine."""
    try:
        found = {str(one[4][0]) for one in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)}
    except OSError:
        return {host}
    here = {"0.0.0.0": "127.0.0.1", "::": "::1"}
    return {here.get(one, one) for one in found}


class HubError(CanopenExoError):
    """The connection to the hub cannot be made, or is lost. The message says why."""


@final
class HubLink:
    """One TCP connection to a bus of a hub. channel: NAME or HOST:PORT/NAME; options: the OPTION_ of the hello.

    welcome: the hub's, None until it has answered. offset_ns: our CLOCK_MONOTONIC - the stamps. rest: an incomplete
    record that was read; the caller of `read` puts it there.
    """

    def __init__(self, channel: str, options: int) -> None:
        self._host, self._port, self._bus = split_channel(channel)
        self._options: Final[int] = options
        self._socket: socket.socket | None = None
        self._tail: bytes = b""  # of a record that was written in part
        self._asked_ns: int = 0
        self._deadline: int = 0
        self.welcome: Welcome | None = None
        self.offset_ns: int = 0
        self.rest: bytes = b""

    def where(self) -> str:
        """For messages: host, port and bus."""
        return f"{self._host}:{self._port}/{self._bus}"

    def fileno(self) -> int:
        """Of the socket; -1 when there is none."""
        return -1 if self._socket is None else self._socket.fileno()

    def begin(self) -> None:
        """Start to connect; `advance` does the rest. Raises HubError."""
        self.close()
        try:
            family, kind, proto, _, where = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM)[0]
            link = socket.socket(family, kind, proto)
        except OSError as error:
            raise HubError(f"hub {self.where()}: no such address: {error}") from error
        self._socket = link
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.connect_ex(where)  # what went wrong shows in `advance`
        self._deadline = time.monotonic_ns() + JOIN_NS

    def advance(self) -> bool:
        """One step of connecting, without waiting; True when joined. Raises HubError."""
        link = self._socket
        if self.welcome is not None:
            return True
        if link is None:
            raise HubError(f"hub {self.where()}: not connected")
        now = time.monotonic_ns()
        if now > self._deadline:
            raise HubError(f"hub {self.where()}: no answer within {JOIN_NS // SECOND} s; is it an exo-hil hub?")
        if not self._asked_ns:
            _, connected, failed = select.select([], [link], [link], 0)
            if not connected and not failed:
                return False
            code = link.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            if code:
                why = os.strerror(code)
                raise HubError(f"hub {self.where()}: {why}; start one with `exo-hil hub`, or name another address")
            self._asked_ns = now
            self.send(pack_hello(self._bus, self._options))
        data = self.read()
        if data[:1] == bytes((KIND_REFUSED,)) and len(data) >= TEXT:
            raise HubError(f"hub {self.where()}: refused: {unpack_text(data, 0)}")
        if len(data) < LONG:
            self.rest = data
            return False
        welcome = unpack_welcome(data)
        heard = time.monotonic_ns()
        if not self._asked_ns <= welcome.monotonic_ns <= heard:
            self.offset_ns = (self._asked_ns + heard) // 2 - welcome.monotonic_ns
        self.welcome = welcome
        self.rest = data[LONG:]
        return True

    def join(self) -> Welcome:
        """Connect and wait for the welcome. Raises HubError."""
        self.begin()
        while not self.advance():
            writing = [] if self._asked_ns else [self]
            select.select([self], writing, [], _JOIN_POLL_NS / SECOND)
        assert self.welcome is not None
        return self.welcome

    def read(self) -> bytes:
        """`rest` and one read from the socket; b"" when there is nothing. Raises HubError when the hub has gone."""
        rest = self.rest
        self.rest = b""
        link = self._socket
        if link is None:
            raise HubError(f"hub {self.where()}: not connected")
        try:
            data = link.recv(_READ_SIZE)
        except BlockingIOError:
            return rest
        except OSError as error:
            raise HubError(f"hub {self.where()}: {error.strerror}") from error
        if not data:
            if rest[:1] == bytes((KIND_REFUSED,)) and len(rest) >= TEXT:
                return rest
            raise HubError(f"hub {self.where()}: the hub has closed the connection")
        return rest + data if rest else data

    def send(self, record: bytes) -> bool:
        """Write a record; False when not a byte of it fits now. Raises HubError when the hub has gone."""
        link = self._socket
        if link is None:
            raise HubError(f"hub {self.where()}: not connected")
        if self._tail and not self.flush():
            return False
        try:
            sent = link.send(record)
        except BlockingIOError:
            return False
        except OSError as error:
            raise HubError(f"hub {self.where()}: {error.strerror}") from error
        if sent < len(record):
            self._tail = record[sent:]
        return True

    def is_partial(self) -> bool:
        """Whether a record was written in part."""
        return bool(self._tail)

    def flush(self) -> bool:
        """Write the end of a record that was written in part; True when nothing is left of it. Raises HubError."""
        link = self._socket
        if self._tail and link is not None:
            try:
                self._tail = self._tail[link.send(self._tail) :]
            except BlockingIOError:
                return False
            except OSError as error:
                raise HubError(f"hub {self.where()}: {error.strerror}") from error
        return not self._tail

    def leave(self) -> None:
        """Close so that all that was sent arrives: wait, at most 1 s, until the hub has read to the end."""
        link = self._socket
        if link is not None and self.welcome is not None:
            deadline = time.monotonic_ns() + SECOND
            try:
                while not self.flush() and time.monotonic_ns() < deadline:
                    select.select([], [link], [], 0.1)
                link.shutdown(socket.SHUT_WR)
                while time.monotonic_ns() < deadline:
                    if select.select([link], [], [], 0.1)[0] and not link.recv(_READ_SIZE):
                        break
            except (OSError, HubError):
                pass  # it has gone before us
        self.close()

    def close(self) -> None:
        """Let the socket go."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self.welcome = None
        self.offset_ns = 0
        self._asked_ns = 0
        self._tail = b""
        self.rest = b""


@final
class HubChannel(Channel):
    """A hub's bus as the real-time loop sees it: `hub:NAME` or `hub:HOST:PORT/NAME`. `open` connects.

    Its transmit queue is the hub's (timed: 64 frames, by arbitration); what that drops is counted in `lost`, and
    the first frame it rejects is told in the log. When the hub goes away it is looked for again, every
    0.1 s at first and every 2 s at last.
    """

    def __init__(self, channel: str) -> None:
        super().__init__(f"hub:{channel}")
        self.is_stamped = True
        self._link: Final = HubLink(channel, 0)
        self._state: PortState = PortState(0, ErrorState.DOWN, 0, 0, "not open")
        self._notices: list[Arrival] = []
        self._retry_ns: int = _FIRST_RETRY_NS
        self._is_rejected: bool = False
        self._is_closed: bool = False

    def open(self) -> None:
        """Connect; waits at most 2 s. Raises HubError (a CanopenExoError) when there is no hub."""
        try:
            self._link.join()
        except CanopenExoError:
            self._link.close()
            raise
        self._state = PortState(0, ErrorState.ERROR_ACTIVE, 0, 0, "connected")

    def fileno(self) -> int:
        """The socket, -1 while the hub is away."""
        return self._link.fileno()

    def receive(self) -> list[Arrival]:
        """What has come, oldest first; of a flood so much that a loop still comes to its wake-ups."""
        now = time.monotonic_ns() - self.epoch_ns
        found = self._notices
        self._notices = []
        self.poll_at = NEVER
        if self._is_closed:
            return found
        try:
            if self._link.welcome is None and not self._return(now, found):
                return found
            if not self._link.flush():
                self.poll_at = now + MS
            for _ in range(_READS):
                data = self._link.read()
                now = time.monotonic_ns() - self.epoch_ns  # not before reading: no stamp is later than now
                size = len(data)
                used = self._take(data, now, found)
                self._link.rest = data[used:] if used < size else b""
                if size < _READ_SIZE:  # the socket had no more than this
                    break
        except CanopenExoError as error:
            self._lose(now, str(error))
            found += self._notices
            self._notices = []
        return found

    def send(self, frame: Frame) -> bool:
        """Hand a frame over. False: the hub does not read for the moment."""
        if self._link.welcome is None:
            self.lost += 1
            return True
        try:
            if not self._link.send(pack_frame(frame)):
                return False
            if self._link.is_partial():
                self.poll_at = time.monotonic_ns() - self.epoch_ns + MS
            return True
        except CanopenExoError as error:
            self._lose(time.monotonic_ns() - self.epoch_ns, str(error))
            self.poll_at = 0  # the notice is handed out at once
            self.lost += 1
            return True

    def close(self) -> None:
        """Leave the bus for good."""
        self._is_closed = True
        self.poll_at = NEVER
        self._link.leave()

    def _take(self, data: bytes, now: int, found: list[Arrival]) -> int:
        """Append the frames and notices of the complete records in `data`; returns the bytes used."""
        end = len(data)
        offset = self._link.offset_ns - self.epoch_ns
        at = 0
        while end - at >= SHORT:
            kind = data[at]
            size = RECORD_SIZE[kind]
            if end - at < size:
                break
            if kind in (KIND_FRAME, KIND_FD_FRAME):
                fault = frame_fault(data, at, from_hub=True)
                if fault:
                    self.malformed += 1
                    raise HubError(f"hub {self._link.where()}: a corrupt record came: {fault}")
                (stamp,) = STAMP.unpack_from(data, at + STAMP_AT)
                stamp = min(stamp + offset, now)
                if data[at + 1] & FLAG_ERROR:
                    self.errors += 1
                    can_id, _, _, payload, _ = unpack_record(data, at)
                    self._state = read_error_frame(can_id, payload, self._state)
                    found.append(Arrival(stamp, None, self._state))
                else:
                    found.append(Arrival(stamp, unpack_frame(data, at), None))
            else:
                self._told(now, data, at, kind, found)
                if size == 0:
                    self.malformed += 1
                    raise HubError(f"hub {self._link.where()}: a record of unknown kind {kind} came")
            at += size
        return at

    def _told(self, now: int, data: bytes, at: int, kind: int, found: list[Arrival]) -> None:
        """A record that is no frame. What was lost is counted, and told as an overrun; the state of the bus stays."""
        if kind == KIND_OVERRUN:
            count, which, _, _, _ = unpack_record(data, at)
            before = self._state
            cause = f"the hub dropped {count} frames"
            found.append(Arrival(now, None, PortState(0, before.state, before.tec, before.rec, cause, overrun=True)))
            if which == LOST_RECEIVING:
                self.overruns += count
            else:
                self.lost += count
        elif kind == KIND_REJECTED:
            self.lost += 1
            if not self._is_rejected:
                self._is_rejected = True
                _LOG.warning("%s: the hub rejected a frame: %s", self.name, unpack_text(data, at))
        elif kind == KIND_REFUSED:
            raise HubError(f"hub {self._link.where()}: refused: {unpack_text(data, at)}")

    def _lose(self, now: int, why: str) -> None:
        """The hub is away: a notice, and when it is looked for again."""
        self._link.close()
        if self._state.state is not ErrorState.DOWN:
            self._state = PortState(0, ErrorState.DOWN, 0, 0, why)
            self._notices.append(Arrival(now, None, self._state))
            self._retry_ns = _FIRST_RETRY_NS
        else:
            self._retry_ns = min(2 * self._retry_ns, _LAST_RETRY_NS)
        self.poll_at = now + self._retry_ns

    def _return(self, now: int, found: list[Arrival]) -> bool:
        """Look for the hub again; True when joined."""
        if self._link.fileno() < 0:
            self._link.begin()
        if not self._link.advance():
            self.poll_at = now + _JOIN_POLL_NS
            return False
        self._state = PortState(0, ErrorState.ERROR_ACTIVE, 0, 0, "the hub is back")
        found.append(Arrival(now, None, self._state))
        return True
