"""The hub as an interface of python-can: `can.Bus(interface="hub", channel="127.0.0.1:29536/drive")`.

Found through the entry point `can.interface`; needs no import. Source: python-can 4.6, BusABC. A bus may be read in one
thread (a Notifier) and written in others. On a timed hub `send` waits while the 64 frames of the transmit queue are
taken, as a driver with a full buffer does. Frames the hub had to drop show as error frames (controller overflow,
linux/can/error.h) and in `overruns` and `overflows`.
Leaves out: filters in the hub (python-can filters here), bus state and error counters (a hub has none).
"""

import logging
import os
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import can
from can.typechecking import AutoDetectedConfig, CanFilters, Channel

from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE
from canopen_exo.bus.hub_client import HubError, HubLink
from canopen_exo.bus.hub_wire import (
    DEFAULT_HOST,
    DEFAULT_PORT,
    FD_LENGTH,
    FLAG_ERROR,
    FLAG_OWN,
    KIND_FD_FRAME,
    KIND_FRAME,
    KIND_OVERRUN,
    KIND_REFUSED,
    KIND_REJECTED,
    KIND_SENT,
    LOST_RECEIVING,
    OPTION_CONFIRM,
    OPTION_OWN,
    RECORD_SIZE,
    SHORT,
    SHORT_RECORD,
    frame_fault,
    pack_record,
    unpack_record,
    unpack_text,
)
from canopen_exo.bus.medium import QUEUE_LENGTH
from canopen_exo.errors import CanopenExoError

_OVERFLOW_CLASS: Final = 0x004
"""linux/can/error.h: CAN_ERR_CRTL; data[1] = 1: receive buffer overflow, 2: transmit buffer overflow."""

_LOG: Final = logging.getLogger("can.bus")
"""python-can's own logger of what is received."""

_KEPT: Final = 1 << 16
"""Messages kept for a program that sends only: `send` reads the confirmations, and with them what else has come."""


class HubBus(can.BusABC):
    """A bus of a hub. channel: NAME or HOST:PORT/NAME; receive_own_messages: give back what this bus sends.

    overruns: frames the hub dropped because we did not read; overflows: frames of ours it did not carry.
    Raises can.CanInitializationError when there is no hub.
    """

    def __init__(
        self,
        channel: Channel = "can0",
        receive_own_messages: bool = False,
        can_filters: CanFilters | None = None,
        **kwargs: object,
    ) -> None:
        options = OPTION_CONFIRM | (OPTION_OWN if receive_own_messages else 0)
        try:
            self._link = HubLink(str(channel), options)
            welcome = self._link.join()
        except CanopenExoError as error:
            if hasattr(self, "_link"):
                self._link.close()
            raise can.CanInitializationError(str(error)) from error
        self.channel_info = f"hub {self._link.where()}"
        self.channel = str(channel)
        self.overruns = 0
        self.overflows = 0
        self._is_timed = welcome.bitrate != 0
        self._can_protocol = can.CanProtocol.CAN_20 if self._is_timed else can.CanProtocol.CAN_FD
        self._realtime_offset = welcome.realtime_ns - welcome.monotonic_ns
        self._received: deque[can.Message] = deque()
        self._underway = 0  # frames given to a timed hub that it has not confirmed
        self._failure = ""
        self._turn = threading.Condition()  # who reads the socket; guards all of the above
        self._is_reading = False
        self._sending = threading.Lock()
        self._watch: _Watch | None = None
        super().__init__(channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame; waits while the transmit queue is full: for ever, or `timeout` seconds.

        Raises can.CanOperationError when the hub has gone, refuses the frame, or has not taken it in time.
        """
        record = _pack_plain(msg) or self._pack_any(msg)
        deadline = None if timeout is None else time.monotonic() + timeout
        if not self._sending.acquire(timeout=-1 if timeout is None else max(timeout, 0.0)):
            raise can.CanOperationError(f"{self.channel_info}: another thread has been sending for {timeout} s")
        try:
            self._hand_over(record, deadline)
        except HubError as error:
            raise can.CanOperationError(str(error)) from error
        finally:
            self._sending.release()

    def _pack_any(self, msg: can.Message) -> bytes:
        """A message of any kind as a record. Raises can.CanOperationError when the hub would not carry it."""
        try:
            record = _pack(msg)
        except (ValueError, TypeError) as error:
            raise can.CanOperationError(f"{self.channel_info}: {error}") from error
        fault = frame_fault(record, 0)
        if not fault and self._is_timed and (msg.is_fd or msg.is_error_frame):
            fault = "a timed hub emulates classical CAN and carries neither CAN FD nor error frames; use a fast hub"
        if fault:
            raise can.CanOperationError(f"{self.channel_info}: not sent: {fault}")
        return record

    def _hand_over(self, record: bytes, deadline: float | None) -> None:
        if self._is_timed and not self._attend(self._has_room, deadline):
            raise can.CanOperationError(f"{self.channel_info}: transmit queue still full after the timeout")
        self._check()
        while not self._link.send(record):
            self._wait_writable(deadline)
        if self._is_timed:
            with self._turn:
                self._underway += 1
        while self._link.is_partial() and not self._link.flush():
            self._wait_writable(deadline)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next message, None after `timeout` s without one. Raises can.CanOperationError.

        As python-can's own, which takes eight times as long to give what was read already.
        """
        if self._watch is None and not self._filters and not _LOG.isEnabledFor(self.RECV_LOGGING_LEVEL):
            try:
                return self._received.popleft()
            except IndexError:
                pass
        return super().recv(timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        received = self._received
        if not received:
            deadline = None if timeout is None else time.monotonic() + timeout
            self._attend(self._has_news, deadline)
        with self._turn:
            message = received.popleft() if received else None
            if self._watch is not None and not received and not self._failure:
                self._watch.lower()
        if message is None:
            self._check()
        return message, False

    def fileno(self) -> int:
        """Readable whenever `recv` has something to give, also what was read from the socket already."""
        if not hasattr(select, "epoll") or sys.platform != "linux":
            raise NotImplementedError("the hub interface has a file descriptor on Linux only")
        with self._turn:
            if self._watch is None:
                self._watch = _Watch(self._link.fileno())
                if self._received or self._failure:
                    self._watch.lift()
            return self._watch.fileno()

    def shutdown(self) -> None:
        """Stop periodic tasks and leave the bus; a second call does nothing."""
        if self._is_shutdown:
            return
        super().shutdown()
        with self._turn:
            self._failure = self._failure or f"{self.channel_info}: the bus is shut down"
            if self._watch is not None:
                self._watch.close()
                self._watch = None
            self._link.leave()
            self._turn.notify_all()

    @staticmethod
    def _detect_available_configs() -> Sequence[AutoDetectedConfig]:
        """One configuration when a hub answers on the default address."""
        link = HubLink("can0", 0)
        try:
            link.join()
        except CanopenExoError:
            return []
        finally:
            link.close()
        return [{"interface": "hub", "channel": f"{DEFAULT_HOST}:{DEFAULT_PORT}/can0"}]

    def _has_room(self) -> bool:
        return self._underway < QUEUE_LENGTH or bool(self._failure)

    def _has_news(self) -> bool:
        return bool(self._received) or bool(self._failure)

    def _check(self) -> None:
        if self._failure:
            raise can.CanOperationError(self._failure)

    def _attend(self, done: Callable[[], bool], deadline: float | None) -> bool:
        """Wait until `done()`; False at the deadline. Of several threads that wait, one reads the socket for all."""
        with self._turn:
            is_first = True
            while not done():
                left = None if deadline is None else max(deadline - time.monotonic(), 0.0)
                if not is_first and left == 0.0:
                    return False
                is_first = False
                if self._is_reading:
                    self._turn.wait(left)
                    continue
                self._is_reading = True
                number = self._link.fileno()
                self._turn.release()
                try:
                    ready = _is_readable(number, left)
                finally:
                    self._turn.acquire()
                    self._is_reading = False
                    self._turn.notify_all()
                if ready:
                    self._drain()
            return True

    def _wait_writable(self, deadline: float | None) -> None:
        left = None if deadline is None else deadline - time.monotonic()
        if left is not None and left <= 0:
            raise can.CanOperationError(f"{self.channel_info}: the hub has not read until the timeout")
        select.select([], [self._link], [], left)

    def _drain(self) -> None:
        """One read from the socket; `_turn` is held."""
        try:
            data = self._link.read()
            end = len(data)
            at = 0
            while end - at >= SHORT:
                kind = data[at]
                size = RECORD_SIZE[kind]
                if end - at < size:
                    break
                message = _unpack_plain(data, at, self._realtime_offset, self.channel) if kind == KIND_FRAME else None
                if message is not None and len(self._received) < _KEPT:
                    self._received.append(message)
                else:
                    self._take(data, at, kind)
                at += size
            self._link.rest = data[at:]
        except CanopenExoError as error:
            self._failure = self._failure or str(error)
        if self._watch is not None and (self._received or self._failure):
            self._watch.lift()

    def _take(self, data: bytes, at: int, kind: int) -> None:
        if kind in (KIND_FRAME, KIND_FD_FRAME):
            fault = frame_fault(data, at, from_hub=True)
            if fault:
                raise HubError(f"{self.channel_info}: a corrupt record came: {fault}")
            if len(self._received) >= _KEPT:
                self.overruns += 1
                return
            self._received.append(_unpack(data, at, self._realtime_offset, self.channel))
        elif kind == KIND_SENT:
            count, _, _, _, _ = unpack_record(data, at)
            self._underway -= count
        elif kind == KIND_OVERRUN:
            count, which, _, _, _ = unpack_record(data, at)
            if which == LOST_RECEIVING:
                self.overruns += count
            else:
                self.overflows += count
                self._underway -= count
            self._notice(which)
        elif kind == KIND_REJECTED:
            self.overflows += 1
            self._underway -= 1
            self._notice(2)
        elif kind == KIND_REFUSED:
            raise HubError(f"{self.channel_info}: refused: {unpack_text(data, at)}")
        elif RECORD_SIZE[kind] == 0:
            raise HubError(f"{self.channel_info}: a record of unknown kind {kind} came")

    def _notice(self, which: int) -> None:
        """An overrun as an error frame: data[1] = 1 receive buffer, 2 transmit buffer."""
        self._received.append(
            can.Message(
                timestamp=time.time(),
                arbitration_id=_OVERFLOW_CLASS,
                is_extended_id=False,
                is_error_frame=True,
                dlc=8,
                data=bytes((0, which, 0, 0, 0, 0, 0, 0)),
                channel=self.channel,
            )
        )


class _Watch:
    """A file descriptor that is readable when the socket is, or while it is lifted (messages wait in memory)."""

    def __init__(self, number: int) -> None:
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll = select.epoll()
        self._epoll.register(self._event, select.EPOLLIN)
        self._epoll.register(number, select.EPOLLIN)
        self._is_lifted = False

    def fileno(self) -> int:
        return self._epoll.fileno()

    def lift(self) -> None:
        if not self._is_lifted:
            os.eventfd_write(self._event, 1)
            self._is_lifted = True

    def lower(self) -> None:
        if self._is_lifted:
            os.eventfd_read(self._event)
            self._is_lifted = False

    def close(self) -> None:
        self._epoll.close()
        os.close(self._event)


def _is_readable(number: int, timeout: float | None) -> bool:
    """Wait for the socket; a socket that another thread has closed counts as readable."""
    try:
        return number < 0 or bool(select.select([number], [], [], timeout)[0])
    except (OSError, ValueError):
        return True


def _pack(msg: can.Message) -> bytes:
    """A message as a record. Raises ValueError when it cannot be one."""
    flags = 0
    if msg.is_extended_id:
        flags |= FLAG_EXTENDED
    data = bytes(msg.data)
    dlc = msg.dlc
    if msg.is_fd:
        flags |= FLAG_FD
        if msg.bitrate_switch:
            flags |= FLAG_BRS
        if msg.error_state_indicator:
            flags |= FLAG_ESI
        if dlc not in FD_LENGTH:
            raise ValueError(f"{dlc} data bytes given, a CAN FD frame has one of {FD_LENGTH}")
        dlc = FD_LENGTH.index(dlc)
    elif msg.is_remote_frame:
        flags |= FLAG_REMOTE
        data = b""
    elif msg.is_error_frame:
        flags |= FLAG_ERROR
    if not (0 <= msg.arbitration_id <= 0xFFFFFFFF and 0 <= dlc <= 15 and len(data) <= 64):
        raise ValueError(f"id {msg.arbitration_id:#x}, DLC {dlc} and {len(data)} data bytes do not make a CAN frame")
    return pack_record(msg.arbitration_id, flags, dlc, data)


def _pack_plain(msg: can.Message) -> bytes:
    """A base data frame, which nearly every message is, as a record; b"" for anything else."""
    can_id = msg.arbitration_id
    data = msg.data
    size = len(data)
    if (
        msg.is_extended_id
        or msg.is_fd
        or msg.is_remote_frame
        or msg.is_error_frame
        or size > 8
        or msg.dlc != size
        or not 0 <= can_id <= 0x7FF
    ):
        return b""
    return SHORT_RECORD.pack(KIND_FRAME, 0, size, size, can_id, 0, data)


def _unpack_plain(data: bytes, at: int, realtime_offset: int, channel: str) -> can.Message | None:
    """The message of the frame record at `at` when it is a base data frame and well made; else None."""
    _, flags, dlc, size, can_id, stamp, payload = SHORT_RECORD.unpack_from(data, at)
    if flags or dlc != size or size > 8 or can_id > 0x7FF:
        return None
    if size < 8:
        if any(payload[size:]):
            return None
        payload = payload[:size]
    return can.Message((stamp + realtime_offset) / 1e9, can_id, False, False, False, channel, size, payload)


def _unpack(data: bytes, at: int, realtime_offset: int, channel: str) -> can.Message:
    """The message of a frame record. timestamp: Unix time of the hub's stamp, seconds."""
    can_id, flags, dlc, payload, stamp = unpack_record(data, at)
    return can.Message(
        timestamp=(stamp + realtime_offset) / 1e9,
        arbitration_id=can_id,
        is_extended_id=flags & FLAG_EXTENDED != 0,
        is_remote_frame=flags & FLAG_REMOTE != 0,
        is_error_frame=flags & FLAG_ERROR != 0,
        is_fd=flags & FLAG_FD != 0,
        bitrate_switch=flags & FLAG_BRS != 0,
        error_state_indicator=flags & FLAG_ESI != 0,
        dlc=FD_LENGTH[dlc] if flags & FLAG_FD else dlc,
        data=payload,
        channel=channel,
        is_rx=flags & FLAG_OWN == 0,
    )
