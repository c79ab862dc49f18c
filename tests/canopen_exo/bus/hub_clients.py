"""Clients of a hub without sockets, and what has come to them."""

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.hub_core import (
    Client,
    Hub,
)
from canopen_exo.bus.hub_wire import (
    KIND_REFUSED,
    KIND_REJECTED,
    KIND_WELCOME,
    RECORD_SIZE,
    pack_hello,
    unpack_frame,
    unpack_record,
    unpack_text,
)

MBIT = 1_000_000


def join(hub: Hub, bus: str = "drive", options: int = 0) -> Client:
    """A client that has read its welcome."""
    client = Client("test")
    hub.received(client, pack_hello(bus, options), 0)
    assert client.outbox[0] == KIND_WELCOME
    client.outbox.clear()
    return client


def records(client: Client) -> list[bytes]:
    """Take everything out of the outbox, record by record."""
    data = bytes(client.outbox)
    client.outbox.clear()
    found = []
    at = 0
    while at < len(data):
        size = RECORD_SIZE[data[at]]
        found.append(data[at : at + size])
        at += size
    return found


def frames(client: Client) -> list[tuple[int, Frame]]:
    """Stamp and frame of all that came; nothing else must have come."""
    return [(unpack_record(record, 0)[4], unpack_frame(record, 0)) for record in records(client)]


def counts(client: Client, kind: int) -> list[tuple[int, int]]:
    """(flags, count) of the records of this kind."""
    return [(record[1], unpack_record(record, 0)[0]) for record in records(client) if record[0] == kind]


def texts(client: Client) -> list[tuple[int, str]]:
    """Kind and text of the rejected and refused records."""
    return [(item[0], unpack_text(item, 0)) for item in records(client) if item[0] in (KIND_REJECTED, KIND_REFUSED)]
