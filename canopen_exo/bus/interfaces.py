"""The names of buses on the command line, and how each is opened: `INTERFACE:CHANNEL[@bitrate]`.

    socketcan:can0            a SocketCAN interface, straight on the socket
    hub:drive                 bus `drive` of the emulated hub on its default address
    hub:127.0.0.1:5000/drive  the same on another address
    pcan:PCAN_USBBUS1@500000  any other interface of python-can

Where no name is given python-can's own configuration counts: CAN_INTERFACE, CAN_CHANNEL and CAN_BITRATE, then can.conf.
Nothing is imported before a bus needs it.
"""

import logging
from typing import Final, final

from canopen_exo.bus.channel import Channel
from canopen_exo.errors import CanopenExoError

_LOG: Final = logging.getLogger(__name__)

_FORM: Final = "allowed is INTERFACE:CHANNEL[@bitrate], such as socketcan:can0, hub:drive or pcan:PCAN_USBBUS1@500000"

_OWN: Final = ("socketcan", "hub")
"""Opened here; everything else is python-can's."""


@final
class BusName:
    """A bus as named by the user. bitrate: bit/s, None when not given; context: section of can.conf it came from."""

    __slots__ = ("bitrate", "channel", "context", "interface")

    def __init__(self, interface: str, channel: str, bitrate: int | None = None, context: str = "") -> None:
        self.interface: Final[str] = interface
        self.channel: Final[str] = channel
        self.bitrate: Final[int | None] = bitrate
        self.context: Final[str] = context

    def __str__(self) -> str:
        """As on the command line."""
        return f"{self.interface}:{self.channel}" + ("" if self.bitrate is None else f"@{self.bitrate}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, BusName) and str(self) == str(other)

    def __hash__(self) -> int:
        return hash(str(self))


def parse_bus(text: str) -> BusName:
    """A name as the user wrote it; raises CanopenExoError when it has not the form. Opens and imports nothing."""
    interface, colon, rest = text.partition(":")
    channel, at, bits = rest.rpartition("@")
    if not at:
        channel, bits = rest, ""
    if not colon or not interface or not channel or any(letter.isspace() for letter in text):
        raise CanopenExoError(f"bus {text!r}: not the name of a bus; {_FORM}")
    bitrate = None
    if at:
        if not (bits.isascii() and bits.isdigit() and 1 <= int(bits) <= 1_000_000):
            raise CanopenExoError(f"bus {text!r}: bit rate {bits!r} given, allowed 1..1000000 bit/s (whole number)")
        bitrate = int(bits)
    return BusName(interface, channel, bitrate)


def same_bus(one: BusName, other: BusName) -> bool:
    """Whether both are one bus, however each is written; the bit rate makes no difference.

    A hub is known by its address, host names resolved, and the bus's name; a device file by where its links lead.
    Left out: one hub reached at two addresses of its machine, and two adapters plugged into one wire.
    """
    if one.interface != other.interface:
        return False
    return one.channel == other.channel or not _places(one).isdisjoint(_places(other))


def bus_identity(bus: BusName) -> str:
    """One text for all ways to write a bus, as far as `same_bus` sees it; raises as that does."""
    host, port, name = min(_places(bus))
    return f"{bus.interface}:{host}:{port}/{name}"


def _places(bus: BusName) -> set[tuple[str, int, str]]:
    """Where a channel leads: hosts, port and bus of a hub; raises CanopenExoError for a channel no hub can have."""
    if bus.interface != "hub":
        from os.path import realpath

        return {("", 0, realpath(bus.channel) if bus.channel.startswith("/") else bus.channel)}
    from canopen_exo.bus.hub_client import addresses
    from canopen_exo.bus.hub_wire import split_channel

    host, port, name = split_channel(bus.channel)
    return {(address, port, name) for address in addresses(host)}


def configured_bus(context: str = "") -> BusName | None:
    """The bus that python-can's configuration names; None when it names none.

    context: `drive` also looks at CAN_INTERFACE_drive ... and at the section [drive] of can.conf, and prefers them.
    """
    from canopen_exo.bus.adapter import configuration

    found = configuration(context)
    interface = found.get("interface") or found.get("bustype")
    if not interface:
        return None
    channel = found.get("channel")
    if not channel:
        raise CanopenExoError(
            f"bus: python-can's configuration has the interface {interface!r} and no channel; set CAN_CHANNEL, or name "
            f"the bus: {_FORM}"
        )
    bitrate = found.get("bitrate")
    named = parse_bus(f"{interface}:{channel}@{bitrate}" if bitrate else f"{interface}:{channel}")
    return BusName(named.interface, named.channel, named.bitrate, context)


def open_channel(bus: BusName) -> Channel:
    """Open a bus. Raises CanopenExoError: one line that says what is missing and what to run."""
    if bus.bitrate is not None and bus.interface in _OWN:
        where = "by `exo-hil hub --bitrate`" if bus.interface == "hub" else "with `ip link set ... type can bitrate`"
        if bus.interface == "socketcan" and bus.channel.startswith("vcan"):
            where = "nowhere: a virtual interface has none"
        _LOG.warning("bus %s: bit rate %d not used; it is set %s", bus, bus.bitrate, where)
    if bus.interface == "socketcan":
        return _open_socketcan(bus)
    if bus.interface == "hub":
        return _open_hub(bus)
    from canopen_exo.bus.adapter import PythonCanChannel, open_python_can

    return PythonCanChannel(str(bus), lambda: open_python_can(bus.interface, bus.channel, bus.bitrate, bus.context))


def _open_socketcan(bus: BusName) -> Channel:
    from canopen_exo.bus.socketcan import SocketCanChannel, interface_error, open_can_socket

    try:
        return SocketCanChannel(str(bus), lambda: open_can_socket(bus.channel))
    except OSError as error:
        raise interface_error(str(bus), bus.channel, error) from error


def _open_hub(bus: BusName) -> Channel:
    from canopen_exo.bus.hub_client import HubChannel

    channel = HubChannel(bus.channel)
    channel.open()
    return channel
