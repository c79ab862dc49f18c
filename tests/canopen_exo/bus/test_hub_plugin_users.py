"""python-can, canopen and asyncio on a hub: what others build on its buses."""

import asyncio
import contextlib
import io
import socket
import threading
import time
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import can
import canopen
import pytest

from canopen_exo.bus.hub_client import HubChannel
from canopen_exo.bus.medium import QUEUE_LENGTH
from canopen_exo.bus.node import SECOND
from canopen_exo.bus.realtime import RealTimeLoop
from canopen_exo.device import Application, Device
from canopen_exo.eds import load_eds
from canopen_exo.od import ObjectDictionary
from tests.canopen_exo.bus.hub_buses import PATIENCE_S, StartHub, bus_on, got, message


def test_asyncio_notifier_gets_every_message(start_hub: StartHub) -> None:
    """python-can's Notifier in an event loop calls recv once for each time the descriptor is readable."""
    hub = start_hub()
    count = 200

    async def collect() -> list[int]:
        with bus_on(hub) as first, bus_on(hub) as second:
            reader = can.AsyncBufferedReader()
            notifier = can.Notifier(second, [reader], loop=asyncio.get_running_loop())
            for number in range(count):
                first.send(message(number))
            found = [(await asyncio.wait_for(reader.get_message(), PATIENCE_S)).arbitration_id for _ in range(count)]
            notifier.stop()
            return found

    assert asyncio.run(collect()) == list(range(count))


def test_logger_writes_what_passed(start_hub: StartHub, tmp_path: Path) -> None:
    """python-can's Logger and LogReader work on it."""
    hub = start_hub()
    path = tmp_path / "bus.log"
    sent = [message(0x181, b"12345678"), can.Message(arbitration_id=0x12345678, data=b"\1\2")]
    with bus_on(hub) as first, bus_on(hub) as second:
        arrived = threading.Semaphore(0)

        def count(_: can.Message) -> None:
            arrived.release()

        logger = can.Logger(path)
        with can.Notifier(second, [logger, count], timeout=0.05):
            for item in sent:
                first.send(item)
                assert arrived.acquire(timeout=PATIENCE_S)
        logger.stop()
    with can.LogReader(path) as reader:
        read = list(reader)
    assert all(a.equals(b, timestamp_delta=None, check_channel=False) for a, b in zip(read, sent, strict=True))


def test_periodic_task_sends_until_it_is_stopped(start_hub: StartHub) -> None:
    """python-can's threads for periodic messages."""
    hub = start_hub()
    with bus_on(hub) as first, bus_on(hub) as second:
        task = first.send_periodic(message(0x80), 0.001)
        assert [got(second).arbitration_id for _ in range(3)] == [0x80] * 3
        task.stop()


def test_sent_messages_arrive_though_the_sender_leaves_at_once(start_hub: StartHub) -> None:
    """A script that sends and ends loses nothing, also when it has not read what came."""
    hub = start_hub(1_000_000)
    with bus_on(hub) as second:
        with bus_on(hub) as first:
            second.send(message(7))
            for number in range(QUEUE_LENGTH):
                first.send(message(0x100 + number))
        assert [got(second).arbitration_id for _ in range(QUEUE_LENGTH)] == [0x100 + n for n in range(QUEUE_LENGTH)]


def test_shutdown_wakes_a_thread_that_waits(start_hub: StartHub) -> None:
    """Nothing hangs: the waiting recv ends with an error; a second shutdown does nothing."""
    with bus_on(start_hub()) as bus:
        ended: list[str] = []

        def wait() -> None:
            try:
                bus.recv(PATIENCE_S)
            except can.CanOperationError as error:
                ended.append(str(error))

        thread = threading.Thread(target=wait)
        thread.start()
        bus.shutdown()
        bus.shutdown()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
        assert len(ended) == 1


@contextlib.contextmanager
def device_on(address: str, node_id: int) -> Iterator[Device]:
    """A CANopen device in a real-time loop of its own on the hub."""
    device = Device(ObjectDictionary(load_eds()).copy_for_node(node_id, {0x607600: 72900}), node_id, Application())
    channel = HubChannel(f"{address}/drive")
    channel.open()
    stop, end = socket.socketpair()
    is_ended: list[int] = []
    loop = RealTimeLoop(device, [channel], [0], time.monotonic_ns())
    loop.add_reader(stop, is_ended.append)
    thread = threading.Thread(target=loop.run, args=(lambda _: bool(is_ended),))
    thread.start()
    try:
        yield device
    finally:
        end.send(b"\0")
        thread.join()
        channel.close()
        stop.close()
        end.close()


@pytest.mark.long
@pytest.mark.parametrize("bitrate", [0, 1_000_000])
def test_canopen_master_talks_to_a_device_over_the_hub(start_hub: StartHub, bitrate: int) -> None:
    """A CANopen master that was not written here: boot-up, SDO both ways, NMT, heartbeat."""
    hub = start_hub(bitrate)
    network = canopen.Network()
    network.connect(interface="hub", channel=f"{hub.address}/drive")
    try:
        source = io.StringIO(resources.files("dbc").joinpath("exo_joint.eds").read_text(encoding="ascii"))
        source.name = "exo_joint.eds"
        node = network.add_node(3, canopen.import_od(source, 3))
        node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        with device_on(hub.address, 3):
            node.nmt.wait_for_bootup(PATIENCE_S)
            assert node.sdo[0x6076].raw == 72900
            node.sdo[0x1017].raw = 50
            assert node.sdo[0x1017].raw == 50
            node.nmt.state = "OPERATIONAL"
            deadline = time.monotonic() + PATIENCE_S
            while node.nmt.wait_for_heartbeat(PATIENCE_S) != "OPERATIONAL":
                assert time.monotonic() < deadline
    finally:
        network.disconnect()


def test_clocks_of_one_machine_are_not_moved(start_hub: StartHub) -> None:
    """Stamps of a hub on this machine are taken as they are, to the nanosecond."""
    hub = start_hub()
    with bus_on(hub) as first, bus_on(hub) as second:
        before = time.monotonic_ns()
        first.send(message(1))
        received = got(second)
        after = time.monotonic_ns()
        offset = second._realtime_offset
        # 1 us: a float of today's seconds resolves 0.24 us
        assert before - 1_000 <= received.timestamp * SECOND - offset <= after + 1_000
