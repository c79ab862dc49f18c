"""The gateway on buses with others on them: its own traffic is never forwarded again."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.hub import HubServer, listen
from canopen_exo.bus.hub_client import HubChannel
from canopen_exo.bus.node import SECOND
from canopen_exo.bus.realtime import RealTimeLoop
from fi_gateway.gateway import Gateway
from tests.fi_gateway.socket_bench import PATIENCE_NS

# ---- no reflection, on a bus with others on it --------------------------------------------------------------------


@contextmanager
def hub() -> Iterator[str]:
    """A fast hub in a thread; its address."""
    server = HubServer(listen("127.0.0.1", 0), 0)
    stop, stopper = socket.socketpair()

    def serve() -> None:
        while server.serve(stop):
            pass

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield server.address()
    finally:
        stopper.send(b"x")
        thread.join()
        server.close()
        stop.close()
        stopper.close()


def collect(channel: HubChannel, into: list[Frame]) -> None:
    into.extend(arrival.frame for arrival in channel.receive() if arrival.frame is not None)


def test_own_traffic_is_never_forwarded_again() -> None:
    """No reflection loop: on two buses with others on them, every frame appears once on each bus, then there is peace.

    Each side has a sender and a listener; the listener on the sender's own bus hears it once as well.
    """
    frames = [[Frame(0x200 + number, bytes((port, number))) for number in range(50)] for port in (0, 1)]
    with hub() as address:
        names = [f"{address}/{name}" for name in ("controller", "drive")]
        gateway = Gateway([], 2_000_000)
        near, senders, listeners = ([HubChannel(name) for name in names] for _ in range(3))
        for channel in (*near, *senders, *listeners):
            channel.open()
        loop = RealTimeLoop(gateway, list(near), [0, 1], time.monotonic_ns())
        heard: list[list[Frame]] = [[], []]
        echoed: list[list[Frame]] = [[], []]
        for port in (0, 1):
            for frame in frames[port]:
                assert senders[port].send(frame)

        def gather(done: Callable[[], bool], limit: int) -> None:
            def look(now: int) -> bool:
                for port in (0, 1):
                    collect(listeners[port], heard[port])
                    collect(senders[port], echoed[port])
                return now > limit or done()

            loop.run(look)

        gather(lambda: all(len(one) >= 100 for one in heard), loop.now() + PATIENCE_NS)
        gather(lambda: False, loop.now() + SECOND // 5)  # a loop would go on for ever
        for port in (0, 1):
            assert [frame for frame in heard[port] if frame.data[0] == port] == frames[port]
            assert [frame for frame in heard[port] if frame.data[0] != port] == frames[1 - port]
            assert echoed[port] == frames[1 - port]
        assert gateway.frames == [50, 50]
        for channel in (*near, *senders, *listeners):
            channel.close()
