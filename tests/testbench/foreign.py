"""Foreign software for the rig, programs of their own made of python-can and canopen alone: master, drives, gateway.

    foreign.py master CHANNEL CONTROL    CHANNEL of the hub, CONTROL: path of the gateway's live control
    foreign.py drives CHANNEL
    foreign.py bridge CHANNEL CHANNEL    a gateway that loses every tenth 0x185

They run until they are killed, or end with a traceback. Nothing of ours is in them but the EDS.
"""

import math
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import can
import canopen

EDS: Final = Path(__file__).resolve().parents[2] / "dbc" / "exo_joint.eds"
CYCLE_S: Final = 0.01
COUNTS_PER_RAD: Final = 131072 / math.tau
NODE_IDS: Final = range(1, 7)
LONG_S: Final = 30.0
RATED_MNM: Final = {1: 72900, 2: 54900, 3: 128700, 4: 72900, 5: 54900, 6: 128700}
"""Hip, knee, ankle [mN m]: table 1 of ESREL 2020."""

SHUTDOWN, SWITCH_ON, ENABLE, DISABLE = 0x06, 0x07, 0x0F, 0x00
STATUSWORDS: Final = {SHUTDOWN: 0x0631, SWITCH_ON: 0x0633, ENABLE: 0x0637}
SWITCH_ON_DISABLED: Final = 0x0650


class NotInTimeError(Exception):
    """The rig did not answer in time."""


class CanopenMaster:
    """Resets, configures and enables six drives with the `canopen` package, then asks the right knee for a torque."""

    KNEE_PER_MILLE: Final = -150

    def __init__(self, channel: str) -> None:
        self._booted: Final[set[int]] = set()
        self._states: Final[dict[int, int]] = {}
        self._network: Final = canopen.Network()
        self._network.connect(interface="hub", channel=channel)

    def work(self, begun: Callable[[], None]) -> None:
        """From reset to torque. begun: called when the drives are enabled, which is this master's time 0."""
        network = self._network
        commands: list[canopen.network.PeriodicMessageTask] = []
        for node_id in NODE_IDS:
            network.subscribe(0x700 + node_id, lambda can_id, data, stamp: self._booted.add(can_id))
            network.subscribe(0x280 + node_id, self._status)
        network.nmt.send_command(0x82)  # reset communication
        self._wait("boot-up messages", lambda: len(self._booted) == len(NODE_IDS))
        for node_id in NODE_IDS:
            node = canopen.RemoteNode(node_id, str(EDS))
            network.add_node(node)
            node.sdo.RESPONSE_TIMEOUT = LONG_S
            node.sdo[0x1019].raw = 0  # the SYNC of canopen has no counter
            node.sdo[0x6060].raw = 10  # cyclic synchronous torque
            commands.append(network.send_periodic(0x200 + node_id, struct.pack("<Hh", SHUTDOWN, 0), CYCLE_S))
        network.nmt.send_command(0x01)
        network.sync.start(CYCLE_S)
        for word in (SHUTDOWN, ENABLE):
            for command in commands:
                command.update(struct.pack("<Hh", word, 0))
            wanted = STATUSWORDS[word] & 0x6F
            self._wait(f"controlword {word:#x}", lambda: all(self._states.get(n) == wanted for n in NODE_IDS))  # noqa: B023
        commands[4].update(struct.pack("<Hh", ENABLE, self.KNEE_PER_MILLE))
        begun()
        threading.Event().wait()

    def _status(self, can_id: int, data: bytearray, stamp: float) -> None:
        self._states[can_id - 0x280] = struct.unpack_from("<H", data)[0] & 0x6F

    def _wait(self, what: str, condition: Callable[[], bool]) -> None:
        limit = time.monotonic() + LONG_S
        while not condition():
            time.sleep(CYCLE_S)
            if time.monotonic() > limit:
                raise NotInTimeError(what)


def identity() -> dict[tuple[int, int, int], int]:
    """(node id, index, sub) -> what a master may ask a drive of this rig for: type, vendor, product, ratings."""
    dictionary = canopen.import_od(str(EDS))
    objects: dict[tuple[int, int, int], int] = {}
    for node_id in NODE_IDS:
        for index, sub in ((0x1000, 0), (0x1018, 1), (0x1018, 2)):
            found = dictionary.get_variable(index, sub)
            assert found is not None
            assert isinstance(found.default, int)
            objects[node_id, index, sub] = found.default
        objects[node_id, 0x6076, 0] = RATED_MNM[node_id]
        objects[node_id, 0x608F, 1] = 131072
    return objects


class Drives:
    """Six drives of python-can alone. They obey NMT, SDO and controlword, and swing as they like: see `angle_rad`."""

    SWING_S: Final = 0.5

    def __init__(self, channel: str) -> None:
        self._bus: Final = can.Bus(interface="hub", channel=channel)
        self._objects: Final[dict[tuple[int, int, int], int]] = identity()
        self._syncs: int = 0
        self._operational: bool = False
        self._words: Final[dict[int, int]] = dict.fromkeys(NODE_IDS, SWITCH_ON_DISABLED)
        self._torques: Final[dict[int, int]] = dict.fromkeys(NODE_IDS, 0)

    @staticmethod
    def angle_rad(node_id: int, t_s: float) -> float:
        """Knees between -40 and -20 deg, all others between -10 and 10 deg."""
        mean = -30.0 if node_id in (2, 5) else 0.0
        return math.radians(mean + 10.0 * math.sin(math.tau * t_s / Drives.SWING_S))

    def work(self) -> None:
        """Serve what comes; heartbeats every 100 ms."""
        beat = time.monotonic()
        while True:
            message = self._bus.recv(0.02)
            if message is not None:
                self._serve(message.arbitration_id, bytes(message.data))
            if time.monotonic() >= beat:
                beat += 0.1
                self._heartbeats(5 if self._operational else 127)

    def _serve(self, can_id: int, data: bytes) -> None:
        node_id = can_id & 0x7F
        if can_id == 0 and data[0] in (0x81, 0x82):
            self._operational = False
            self._syncs = 0
            self._heartbeats(0)
        elif can_id == 0:
            self._operational = data[0] == 0x01
        elif can_id == 0x80 and self._operational:
            self._answer_sync()
        elif can_id == 0x200 + node_id and node_id in self._words:
            word, self._torques[node_id] = struct.unpack_from("<Hh", data)
            self._words[node_id] = STATUSWORDS.get(word & 0x0F, SWITCH_ON_DISABLED)
        elif can_id == 0x600 + node_id and node_id in self._words:
            self._answer_sdo(node_id, data)

    def _heartbeats(self, state: int) -> None:
        for node_id in NODE_IDS:
            self._send(0x700 + node_id, bytes((state,)))

    def _answer_sync(self) -> None:
        t_s, step = self._syncs * CYCLE_S, 1e-4
        self._syncs += 1
        for node_id in NODE_IDS:
            angle = self.angle_rad(node_id, t_s)
            speed = (self.angle_rad(node_id, t_s + step) - angle) / step
            self._send(0x180 + node_id, struct.pack("<ii", *(round(x * COUNTS_PER_RAD) for x in (angle, speed))))
            if self._syncs % 10 == node_id:
                self._send(0x280 + node_id, struct.pack("<HhH", self._words[node_id], self._torques[node_id], 0))

    def _answer_sdo(self, node_id: int, data: bytes) -> None:
        """CiA 301: expedited upload and download; whatever is written is accepted."""
        index, sub = struct.unpack_from("<HB", data, 1)
        if data[0] & 0xE0 == 0x40:
            value = self._objects.get((node_id, index, sub))
            answer = bytes((0x43,)) if value is not None else bytes((0x80,))
            content = value if value is not None else 0x06020000
            self._send(0x580 + node_id, answer + data[1:4] + struct.pack("<I", content))
        elif data[0] & 0xE0 == 0x20:
            self._send(0x580 + node_id, bytes((0x60,)) + data[1:4] + bytes(4))

    def _send(self, can_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def bridge(one: str, other: str) -> None:
    """Pass on what comes in on either bus, but for every tenth answer of the right knee."""
    buses = [can.Bus(interface="hub", channel=channel) for channel in (one, other)]
    answers = 0
    while True:
        readable, _, _ = select.select(buses, [], [])
        for bus in readable:
            message = bus.recv(0)
            while message is not None:
                answers += message.arbitration_id == 0x185
                if message.arbitration_id != 0x185 or answers % 10:
                    buses[bus is buses[0]].send(message)
                message = bus.recv(0)


def start(control: str) -> None:
    """What `exo-hil fault start` does: one line of JSON to the gateway's live control, and its answer."""
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(control)
        link.sendall(b'{"do": "start"}\n')
        answer = link.recv(4096)
    if b'"ok":true' not in answer:
        raise NotInTimeError(answer.decode())


if __name__ == "__main__":
    if sys.argv[1] == "master":
        CanopenMaster(sys.argv[2]).work(lambda: start(sys.argv[3]))
    elif sys.argv[1] == "bridge":
        bridge(sys.argv[2], sys.argv[3])
    else:
        Drives(sys.argv[2]).work()
