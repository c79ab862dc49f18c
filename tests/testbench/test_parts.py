"""Parts of a real-time result: they come back as written, and nothing else passes for one."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_BRS, FLAG_ESI, FLAG_EXTENDED, FLAG_FD, FLAG_REMOTE, Frame
from canopen_exo.bus.lateness import Lateness
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import NEVER
from fi_gateway.activation import Activation
from testbench.parts import (
    ControlNote,
    GatewayPart,
    HlcPart,
    JointsPart,
    NotedEvent,
    PartError,
    Reach,
    Service,
    read_gateway,
    read_hlc,
    read_joints,
    write_gateway,
    write_hlc,
    write_joints,
)

ROWS = [
    Transmission(1_000, 0, Frame(0x80, b"\x01"), 0),
    Transmission(2_000, 1, Frame(0x185, bytes(range(8))), -1),
    Transmission(2_001, 1, Frame(0x1ABCDEF0, b"\xff", FLAG_EXTENDED), 1),
    Transmission(2_002, 0, Frame(0x123, b"", FLAG_REMOTE, 5), -1),
    Transmission(2_003, 0, Frame(0x123, bytes(8), 0, 15), -1),
    Transmission(2_004, 0, Frame(0x7FF, bytes(64), FLAG_FD | FLAG_BRS | FLAG_ESI), -1),
]


def service() -> Service:
    lateness = Lateness()
    for delay in (0, 17, 123_456):
        lateness.add(delay)
    return Service(5_000_000, 9_000_000, lateness, {"dropped at port 0, its transmit queue was full": 3})


def joints_part(rows: list[Transmission]) -> JointsPart:
    table = np.linspace(-1, 1, 12).reshape(2, 6)
    return JointsPart(service(), np.array([1_000_000, 2_000_000]), table, 2 * table, 3 * table, rows)


def shown(rows: list[Transmission]) -> list[tuple[int, int, Frame, int]]:
    return [(row.end_ns, row.bus, row.frame, row.sender) for row in rows]


def same_service(found: Service, wanted: Service) -> bool:
    facts = (found.start_ns, found.end_ns, found.losses, found.lateness.document())
    return facts == (wanted.start_ns, wanted.end_ns, wanted.losses, wanted.lateness.document())


def test_joints_part_comes_back_as_written(tmp_path: Path) -> None:
    """Design: each process writes its own part; truth to the last bit, frames of every kind."""
    path, wanted = tmp_path / "joints.npz", joints_part(ROWS)
    write_joints(path, wanted)
    found = read_joints(path)
    assert shown(found.rows) == shown(ROWS)
    assert found.times_ns.tolist() == wanted.times_ns.tolist()
    for name in ("q", "dq", "tau"):
        assert np.array_equal(getattr(found, name), getattr(wanted, name))
    assert same_service(found.service, wanted.service)


def test_part_of_joints_that_never_stepped_comes_back_empty(tmp_path: Path) -> None:
    """A process that is told to end at once leaves a part as well."""
    empty, path = np.zeros((0, 6)), tmp_path / "joints.npz"
    write_joints(path, JointsPart(service(), np.zeros(0, np.int64), empty, empty, empty, []))
    found = read_joints(path)
    assert found.times_ns.size == 0
    assert found.q.shape == (0, 6)
    assert found.rows == []


def test_hlc_part_comes_back_as_written(tmp_path: Path) -> None:
    """Commands, events, time 0, and the cycles without new samples."""
    table, path = np.arange(12.0).reshape(2, 6), tmp_path / "hlc.npz"
    events = [NotedEvent(7, "left_hip", "emcy", "error 8130 \u2013 lost"), NotedEvent(8, "", "start_failed", "why")]
    wanted = HlcPart(service(), NEVER, False, [0, 1, 2, 3, 4, 5], events, np.array([0, 1]), table, -table, table, ROWS)
    write_hlc(path, wanted)
    found = read_hlc(path)
    assert (found.time_zero, found.completed, found.held, found.events) == (NEVER, False, [0, 1, 2, 3, 4, 5], events)
    assert found.cycles.tolist() == [0, 1]
    assert np.array_equal(found.dq_d, -table)
    assert shown(found.rows) == shown(ROWS)


def test_gateway_part_comes_back_as_written(tmp_path: Path) -> None:
    """Activations with the first changed frames, live control, statistics."""
    path = tmp_path / "gateway.npz"
    activation = Activation("freeze", 2, "right_knee.position", "trigger:other", 10, 12, NEVER)
    activation.frames_seen, activation.frames_unfit, activation.frames_changed, activation.saturated = 9, 1, 7, 2
    activation.first_before = Frame(0x185, bytes(8))
    activation.stream = "12.3.0.0"
    controls = [ControlNote(11, "trigger", "freeze", "socket", ""), ControlNote(12, "arm", "x", "bus", "no such")]
    latency = [Lateness(), service().lateness]
    reaches = {"freeze": Reach(True, False, (0x185,)), "x": Reach(False, True, (0x201, 0x202), (0x6F0,))}
    write_gateway(path, GatewayPart(service(), 99, reaches, [5, 6], [0, 1], latency, [activation], controls, ROWS))
    found = read_gateway(path)
    (one,) = found.activations
    for name in ("injector", "index", "signal", "cause", "due_ns", "start_ns", "duration_ns", "end_ns", "frames_seen"):
        assert getattr(one, name) == getattr(activation, name)
    assert (one.frames_unfit, one.frames_changed, one.saturated) == (1, 7, 2)
    assert (one.first_before, one.first_after, one.stream) == (Frame(0x185, bytes(8)), None, "12.3.0.0")
    assert found.controls == controls
    assert (found.time_zero, found.injectors, found.frames, found.lost) == (99, reaches, [5, 6], [0, 1])
    assert [one.document() for one in found.latency] == [one.document() for one in latency]


@pytest.mark.parametrize("name", ["joints", "gateway", "hlc"])
def test_missing_part_is_named(tmp_path: Path, name: str) -> None:
    """A missing part makes the run invalid, saying which."""
    reader = {"joints": read_joints, "gateway": read_gateway, "hlc": read_hlc}[name]
    with pytest.raises(PartError, match=f"^{name}: it left no part"):
        reader(tmp_path / f"{name}.npz")


def test_part_of_another_process_is_refused(tmp_path: Path) -> None:
    """Parts are not mixed up."""
    write_joints(tmp_path / "part.npz", joints_part(ROWS))
    with pytest.raises(PartError, match="another process"):
        read_hlc(tmp_path / "part.npz")


def test_part_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    """Written whole or not at all."""
    with pytest.raises(PartError, match="cannot write"):
        write_joints(tmp_path / "nowhere" / "joints.npz", joints_part(ROWS))
    blocked = tmp_path / "joints.npz"
    blocked.mkdir()
    with pytest.raises(PartError, match="cannot write"):
        write_joints(blocked, joints_part(ROWS))
    assert [path.name for path in tmp_path.iterdir()] == ["joints.npz"]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("part") / "joints.npz"
    write_joints(path, joints_part(ROWS))
    return path


@given(cut=st.integers(0, 4000))
def test_truncated_part_is_refused(written: Path, cut: int) -> None:
    """What a killed process or a full disk leaves is no part."""
    whole = written.read_bytes()
    short = written.with_name("short.npz")
    short.write_bytes(whole[: cut % len(whole)])
    with pytest.raises(PartError):
        read_joints(short)


@given(place=st.integers(0, 1 << 16), value=st.integers(1, 255))
def test_part_with_a_changed_byte_is_refused_or_the_same(written: Path, place: int, value: int) -> None:
    """Every member has its CRC: a damaged part is never read as another one."""
    content = bytearray(written.read_bytes())
    content[place % len(content)] ^= value
    damaged = written.with_name("damaged.npz")
    damaged.write_bytes(bytes(content))
    try:
        found = read_joints(damaged)
    except PartError:
        return
    wanted = joints_part(ROWS)
    assert shown(found.rows) == shown(wanted.rows)
    assert np.array_equal(found.q, wanted.q)
    assert found.times_ns.tolist() == wanted.times_ns.tolist()


@given(data=st.binary(max_size=200))
def test_any_bytes_are_no_part(written: Path, data: bytes) -> None:
    """No crash on any bytes."""
    path = written.with_name("bytes.npz")
    path.write_bytes(data)
    with pytest.raises(PartError):
        read_gateway(path)
