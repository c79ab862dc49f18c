"""A hub for tests, on loopback and a free port: `start_hub()` gives its address; all hubs end with the test."""

import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from canopen_exo.bus.hub import HubServer, listen
from canopen_exo.bus.hub_core import MakeBus


class RunningHub:
    """A hub in a thread of its own. address: HOST:PORT."""

    def __init__(self, bitrate: int, port: int, make_timed: MakeBus | None) -> None:
        self.server = HubServer(listen("127.0.0.1", port), bitrate, make_timed)
        self.address = self.server.address()
        self._stop, self._wake = socket.socketpair()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while self.server.serve(self._stop):
            pass
        self.server.close()

    def stop(self) -> None:
        """End it; a second call does nothing."""
        if self._thread.is_alive():
            self._wake.send(b"\0")
            self._thread.join()
        self._stop.close()
        self._wake.close()


StartHub = Callable[..., RunningHub]


@pytest.fixture
def start_hub() -> Iterator[StartHub]:
    """`start_hub(bitrate=0, port=0)`: a fast hub, or a timed one with a bit rate; make_timed: see `Hub`."""
    running: list[RunningHub] = []

    def start(bitrate: int = 0, port: int = 0, make_timed: MakeBus | None = None) -> RunningHub:
        running.append(RunningHub(bitrate, port, make_timed))
        return running[-1]

    yield start
    for hub in running:
        hub.stop()
