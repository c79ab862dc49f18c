"""Buses of python-can on a hub, and messages."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Protocol

import can

from canopen_exo.bus.hub import HubServer
from canopen_exo.bus.hub_plugin import HubBus

PATIENCE_S = 20.0
"""How long a test waits for what must come; on a busy machine it only has to come at all."""


class Running(Protocol):
    """What the fixture gives."""

    server: HubServer
    address: str

    def stop(self) -> None: ...


StartHub = Callable[..., Running]


@contextlib.contextmanager
def bus_on(hub: Running, name: str = "drive", own: bool = False) -> Iterator[HubBus]:
    """A bus as a user of python-can opens it: by interface name."""
    with can.Bus(interface="hub", channel=f"{hub.address}/{name}", receive_own_messages=own) as bus:
        assert isinstance(bus, HubBus)
        yield bus


def got(bus: HubBus) -> can.Message:
    """The next message, which must come."""
    message = bus.recv(PATIENCE_S)
    assert message is not None
    return message


def message(can_id: int, data: bytes = b"") -> can.Message:
    """A base data frame."""
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
