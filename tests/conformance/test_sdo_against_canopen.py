"""SDO and EDS against the `canopen` package: a CANopen master and slave that were not written here.

No thread and no socket: the bus hands every frame to the other side before `send` returns.
"""

import io
import struct
from importlib import resources
from typing import Protocol

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from canopen_exo.bus.node import MS
from canopen_exo.eds import load_eds
from canopen_exo.od import BITS, DOMAIN, SIGNED, VISIBLE_STRING, Entry, ObjectDictionary
from canopen_exo.plan import BusPlan, JointNode
from canopen_exo.sdo import SdoClient, SdoServer

NODE = 3
RATED = {0x607600: 72900}
FILE = bytes(range(256)) * 2


class Message(Protocol):
    arbitration_id: int
    data: bytearray


class ServerBus:
    """The bus as the `canopen` master sees it: our server answers at once."""

    channel_info = "in memory"

    def __init__(self, server: SdoServer) -> None:
        self.server = server
        self.network: canopen.Network | None = None

    def send(self, message: Message) -> None:
        assert message.arbitration_id == self.server.request_id
        answer = self.server.request(0, bytes(message.data))
        if answer is not None:
            assert self.network is not None
            self.network.notify(self.server.answer_id, bytearray(answer), 0.0)


class AnswerBus:
    """The bus as the `canopen` slave sees it: keeps its answers."""

    channel_info = "in memory"

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []

    def send(self, message: Message) -> None:
        self.sent.append((message.arbitration_id, bytes(message.data)))


def eds_text() -> str:
    return resources.files("dbc").joinpath("exo_joint.eds").read_text(encoding="ascii")


def canopen_od(node_id: int | None = NODE) -> canopen.ObjectDictionary:
    source = io.StringIO(eds_text())
    source.name = "exo_joint.eds"
    return canopen.import_od(source, node_id)


def every_type() -> ObjectDictionary:
    """One rw object of each integer type at 2000 + type code, and a domain at 2FFF."""
    entries = [Entry(0x2000 + code, 0, f"type {code:#x}", code, "rw") for code in BITS]
    return ObjectDictionary([*entries, Entry(0x2FFF, 0, "file", DOMAIN, "rw")]).copy_for_node(NODE)


def master_of(od: ObjectDictionary, description: canopen.ObjectDictionary) -> canopen.RemoteNode:
    bus = ServerBus(SdoServer(od, NODE))
    network = canopen.Network(bus)  # type: ignore[arg-type] # all it needs of a bus is send()
    bus.network = network
    return network.add_node(NODE, description)


def joint() -> tuple[ObjectDictionary, canopen.RemoteNode]:
    od = ObjectDictionary(load_eds()).copy_for_node(NODE, RATED)
    return od, master_of(od, canopen_od())


def described(od: ObjectDictionary) -> canopen.ObjectDictionary:
    description = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    for entry in od.entries.values():
        variable = ODVariable(entry.name, entry.index, 0)
        variable.data_type = entry.type_code
        description.add_object(variable)
    return description


def extremes(code: int) -> list[int]:
    bits = BITS[code]
    if code in SIGNED:
        return [-(1 << (bits - 1)), -1, 0, 1, (1 << (bits - 1)) - 1]
    return [0, 1, (1 << bits) - 1]


@pytest.mark.parametrize(("code", "raw"), [(code, raw) for code in BITS for raw in extremes(code)])
def test_master_writes_and_reads_every_integer_type(code: int, raw: int) -> None:
    """Expedited up to 32 bits, segmented above; the canopen package encodes and decodes the value."""
    od = every_type()
    variable = master_of(od, described(od)).sdo[0x2000 + code]
    variable.raw = raw
    assert od.value((0x2000 + code) << 8) == raw
    assert variable.raw == raw


@pytest.mark.parametrize("size", [1, 4, 5, 7, 8, 14, 15, 512])
@pytest.mark.parametrize("force_segment", [False, True])
def test_master_writes_and_reads_a_domain(size: int, force_segment: bool) -> None:
    """Segmented both ways, also for data that would fit an expedited transfer."""
    od = every_type()
    sdo = master_of(od, described(od)).sdo
    sdo.download(0x2FFF, 0, FILE[:size], force_segment=force_segment)
    assert od.read(0x2FFF, 0) == FILE[:size]
    assert sdo.upload(0x2FFF, 0) == FILE[:size]


def test_master_reads_every_readable_object_of_the_joint_controller() -> None:
    """Each value is its EDS default as the canopen package resolves it; empty error fields abort with 08000024."""
    od, node = joint()
    for entry in od.entries.values():
        if entry.index == 0x1003 and entry.sub:
            with pytest.raises(canopen.SdoAbortedError) as caught:
                node.sdo.upload(entry.index, entry.sub)
            assert caught.value.code == 0x08000024
            continue
        item = node.sdo[entry.index]
        value = item.raw if entry.plain else item[entry.sub].raw
        described_as = node.object_dictionary.get_variable(entry.index, entry.sub)
        assert described_as is not None
        expected = 72900 if entry.index == 0x6076 else described_as.default
        assert value == expected, f"{entry.index:04X}:{entry.sub:02X}"


def test_master_reads_the_name_in_segments() -> None:
    """Object 1008 is longer than four bytes."""
    _, node = joint()
    assert node.sdo["Manufacturer device name"].raw == "exo-hil joint controller"


@pytest.mark.parametrize(
    ("index", "sub", "data", "code"),
    [
        (0x6063, 0, b"\0\0", 0x06020000),
        (0x6040, 1, b"\0\0", 0x06090011),
        (0x1018, 5, b"\0\0\0\0", 0x06090011),
        (0x6041, 0, b"\0\0", 0x06010002),
        (0x1008, 0, b"another name", 0x06010002),
        (0x6040, 0, b"\0", 0x06070013),
        (0x6040, 0, b"\0\0\0", 0x06070012),
        (0x6040, 0, b"\0" * 8, 0x06070012),
        (0x1029, 1, b"\3", 0x06090031),
        (0x1005, 0, struct.pack("<I", 0x40000080), 0x06090031),  # it makes no SYNC
        (0x1014, 0, struct.pack("<I", 0x83), 0x06010002),
        (0x1800, 3, b"\1\0", 0x06090031),  # nothing to inhibit
        (0x6007, 0, struct.pack("<h", -1), 0x06090032),
        (0x1003, 0, b"\1", 0x06090030),
    ],
)
def test_master_sees_the_right_abort(index: int, sub: int, data: bytes, code: int) -> None:
    """CiA 301, table 22, as the canopen package decodes it."""
    _, node = joint()
    with pytest.raises(canopen.SdoAbortedError) as caught:
        node.sdo.download(index, sub, data)
    assert caught.value.code == code


@pytest.mark.parametrize("mode", ["rb", "wb"])
def test_block_transfer_is_refused(mode: str) -> None:
    """05040001, and the next plain transfer works."""
    od = every_type()
    sdo = master_of(od, described(od)).sdo
    with pytest.raises(canopen.SdoAbortedError) as caught:
        sdo.open(0x2FFF, 0, mode, size=20, block_transfer=True)
    assert caught.value.code == 0x05040001
    sdo.download(0x2FFF, 0, b"12345678")
    assert od.read(0x2FFF, 0) == b"12345678"


def slave_answers(client: SdoClient, first: bytes, description: canopen.ObjectDictionary) -> canopen.LocalNode:
    """Run our client against the canopen package's server."""
    bus = AnswerBus()
    network = canopen.Network(bus)  # type: ignore[arg-type] # all it needs of a bus is send()
    node = network.create_node(NODE, description)
    request: bytes | None = first
    while request is not None:
        bus.sent.clear()
        network.notify(client.request_id, bytearray(request), 0.0)
        ((cob_id, answer),) = bus.sent
        assert cob_id == client.answer_id
        request = client.answer(0, answer)
    return node


@pytest.mark.parametrize("size", [1, 4, 5, 7, 8, 14, 15, 512])
def test_client_writes_to_another_server(size: int) -> None:
    """Expedited and segmented download, taken by the canopen package's slave."""
    client = SdoClient(NODE)
    node = slave_answers(client, client.download(0, 0x2FFF, 0, FILE[:size]), described(every_type()))
    assert (client.done, client.abort) == (True, 0)
    assert bytes(node.data_store[0x2FFF][0]) == FILE[:size]


@pytest.mark.parametrize(
    ("index", "data"),
    [(0x1008, b"exo-hil joint controller"), (0x1000, b"\x92\x01\x02\x00"), (0x1017, b"\x64\x00"), (0x1001, b"\0")],
)
def test_client_reads_from_another_server(index: int, data: bytes) -> None:
    """Expedited and segmented upload from the canopen package's slave."""
    client = SdoClient(NODE)
    slave_answers(client, client.upload(0, index, 0), canopen_od())
    assert (client.done, client.abort, client.result) == (True, 0, data)


def test_client_sees_another_servers_abort() -> None:
    """06020000 from the canopen package's slave."""
    client = SdoClient(NODE)
    slave_answers(client, client.upload(0, 0x6063, 0), canopen_od())
    assert (client.done, client.abort) == (True, 0x06020000)


def test_both_readings_of_the_eds_agree() -> None:
    """Our entries against the canopen package's variables: type, access, limits and mapping flags."""
    entries = {entry.key: entry for entry in load_eds()}
    count = 0
    for item in canopen_od().values():
        for variable in [item] if isinstance(item, ODVariable) else item.subindices.values():
            entry = entries[variable.index << 8 | variable.subindex]
            count += 1
            assert (entry.name, entry.type_code) == (variable.name, variable.data_type)
            assert entry.access == variable.access_type
            assert (entry.readable, entry.writable) == (variable.readable, variable.writable)
            assert (entry.rpdo_mappable or entry.tpdo_mappable) == variable.pdo_mappable
            if entry.type_code != VISIBLE_STRING:
                assert entry.bits == len(variable)
                assert variable.min in (None, entry.low)
                assert variable.max in (None, entry.high)
    assert count == len(entries)


def default(od: canopen.ObjectDictionary, index: int, sub: int = 0) -> int:
    variable = od.get_variable(index, sub)
    assert variable is not None
    assert isinstance(variable.default, int), f"{index:04X}:{sub:02X}"
    return variable.default


@pytest.mark.parametrize("node_id", [1, 6, 126])
def test_eds_defaults_are_those_of_the_bus_plan(node_id: int) -> None:
    """COB-ID, transmission type, SYNC start and mapping of every PDO, as the canopen package decodes them."""
    od = canopen_od(node_id)
    plan = BusPlan((JointNode("right_knee", node_id, 54900, 131072),))
    planned = {pdo.name: pdo for pdo in plan.pdos}
    for kind, communication, mapping in (("RPDO", 0x1400, 0x1600), ("TPDO", 0x1800, 0x1A00)):
        for number in range(4):
            pdo = planned.get(f"{kind}{number + 1}")
            cob_id, count = default(od, communication + number, 1), default(od, mapping + number)
            assert bool(cob_id & 0x80000000) == (pdo is None)
            assert bool(cob_id & 0x40000000) == (kind == "TPDO")  # remote frames are not answered
            mapped = [default(od, mapping + number, sub) for sub in range(1, 9)]
            if pdo is None:
                assert (count, mapped) == (0, [0] * 8)
                continue
            assert cob_id & 0x7FF == pdo.base + node_id
            assert default(od, communication + number, 2) == pdo.every
            wanted = [item.index << 16 | item.sub << 8 | item.length for item in pdo.content]
            assert (count, mapped[:count]) == (len(wanted), wanted)
            assert not any(mapped[count:])
    assert default(od, 0x1801, 6) == node_id  # the TPDO2 are staggered
    assert default(od, 0x1019) == plan.sync_counter
    assert default(od, 0x1017) * MS == plan.heartbeat_ns
    assert default(od, 0x608F, 1) == plan.joints[0].encoder_counts


def test_planned_objects_have_the_planned_size_and_direction() -> None:
    """Every object of the bus plan exists, is mappable in its direction and as long and signed as planned."""
    entries = {entry.key: entry for entry in load_eds()}
    for pdo in BusPlan((JointNode("right_knee", 4, 54900, 131072),)).pdos:
        for item in pdo.content:
            entry = entries[item.index << 8 | item.sub]
            assert (entry.bits, entry.signed) == (item.length, item.signed), item.name
            assert entry.rpdo_mappable if pdo.name.startswith("R") else entry.tpdo_mappable, item.name
