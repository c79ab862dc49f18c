"""Two interfaces, vcan0 and vcan1, up and empty at the start of every test."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from canopen_exo.bus.channel import Channel
from canopen_exo.bus.interfaces import open_channel, parse_bus
from tests.vcan import uml
from tests.vcan.inside.peers import Candump, python_can, wait_until
from tests.vcan.inside.programs import our_processes


@pytest.fixture
def opened() -> Iterator[Callable[[str], Channel]]:
    """`opened("socketcan:vcan0")`: a channel as a process of ours opens it; its clock starts now."""
    channels: list[Channel] = []

    def open_one(name: str) -> Channel:
        channel = open_channel(parse_bus(name))
        channel.epoch_ns = time.monotonic_ns()
        channels.append(channel)
        return channel

    yield open_one
    for channel in channels:
        channel.close()


@pytest.fixture
def channel(opened: Callable[[str], Channel]) -> Channel:
    """Ours on vcan0."""
    return opened("socketcan:vcan0")


@pytest.fixture
def peer() -> Iterator[can.BusABC]:
    """python-can on vcan0."""
    with python_can("vcan0") as bus:
        yield bus


@pytest.fixture
def far_peer() -> Iterator[can.BusABC]:
    """python-can on vcan1."""
    with python_can("vcan1") as bus:
        yield bus


@pytest.fixture
def candump() -> Iterator[Callable[[str], Candump]]:
    """`candump("vcan0")`: listens from then on."""
    running: list[Candump] = []

    def start(interface: str) -> Candump:
        running.append(Candump(interface))
        return running[-1]

    yield start
    for one in running:
        one.close()


@pytest.fixture
def spare() -> Iterator[str]:
    """An interface, up, that a test may remove."""
    name = "vcan7"
    uml.set_link(name, create_kind="vcan")
    yield name
    if Path(f"/sys/class/net/{name}").exists():
        uml.delete_link(name)


@pytest.fixture
def nothing_left() -> Iterator[None]:
    """No process of ours outlives its test."""
    yield
    wait_until(lambda: our_processes() == [], f"all processes have ended: {our_processes()}")


@pytest.fixture(autouse=True)
def links_up() -> Iterator[None]:
    """Whatever a test did to them."""
    yield
    for name in uml.INTERFACES:
        uml.set_link(name)
