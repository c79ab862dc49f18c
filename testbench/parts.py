"""What each process of a real-time run leaves behind: one file each, written whole or not at all.

A part is a NumPy archive (`.npz`, every member with its CRC-32) of plain arrays and one JSON text; nothing in it is
executed when it is read. Times are nanoseconds on the clock that all processes of a rig share. The supervisor merges
the parts (testbench.merge); a part that is missing or damaged makes the run invalid.
"""

import json
import os
import struct
import zipfile
import zlib
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import BinaryIO, Final, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.lateness import Lateness, LatenessDocument
from canopen_exo.bus.medium import Transmission
from canopen_exo.errors import CanopenExoError
from fi_gateway.activation import Activation
from fi_gateway.injector import Injector
from testbench.errors import BenchError
from testbench.record import Array

Arrays: TypeAlias = dict[str, NDArray[np.generic]]

_FORMAT: Final = 1
_NOTES: Final = "notes"
_DAMAGES: Final = (
    *(ValueError, KeyError, TypeError, AttributeError, IndexError, EOFError, RuntimeError, OverflowError, MemoryError),
    *(struct.error, zipfile.BadZipFile, zlib.error, ValidationError, CanopenExoError),
)
"""What zipfile, numpy, json and our own checks raise for a file that is no part, or not a whole one."""

_ROWS: Final = ("end_ns", "bus", "sender", "can_id", "flags", "dlc", "size", "payload")


class PartError(BenchError):
    """A part is missing, damaged, or of another process; the message says which."""


@dataclass(frozen=True, slots=True)
class Service:
    """How a process was served by its loop. start_ns, end_ns: loop clock; lateness: of its wake-ups.

    losses: what was lost, in words -> frames; empty when nothing was.
    """

    start_ns: int
    end_ns: int
    lateness: Lateness
    losses: dict[str, int]


@dataclass(frozen=True, slots=True)
class JointsPart:
    """The drives and their plant. times_ns (n,); q, dq, tau (n, joints): rad, rad/s, N m; rows: its frames."""

    service: Service
    times_ns: NDArray[np.int64]
    q: Array
    dq: Array
    tau: Array
    rows: list[Transmission]


@dataclass(frozen=True, slots=True)
class NotedEvent:
    """Something the controller noticed. time_ns: loop clock; joint: "" for all."""

    time_ns: int
    joint: str
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class HlcPart:
    """The controller. cycles (m,): since time 0; q_d, dq_d, tau_command (m, joints): rad, rad/s, N m before the clamp.

    time_zero: loop clock, NEVER when the motion never began; held: per joint, cycles of the motion without new samples.
    """

    service: Service
    time_zero: int
    completed: bool
    held: list[int]
    events: list[NotedEvent]
    cycles: NDArray[np.int64]
    q_d: Array
    dq_d: Array
    tau_command: Array
    rows: list[Transmission]


@dataclass(frozen=True, slots=True)
class ControlNote:
    """A call of live control: what was asked for which injector ("" for all), by whom, and why not, "" when done."""

    time_ns: int
    what: str
    name: str
    source: str
    refused: str


@dataclass(frozen=True, slots=True)
class Reach:
    """Which frames an injector may have its hands on: those of its COB-IDs, by direction; and those it says itself.

    reports: COB-IDs of the latter.
    """

    to_controller: bool
    to_drives: bool
    cob_ids: tuple[int, ...]
    reports: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class GatewayPart:
    """The gateway. rows: both buses, in the order of handling; injectors: by name.

    frames, lost: received, and lost by a fault, by port; latency: receipt to sending, by port sent on.
    """

    service: Service
    time_zero: int
    injectors: dict[str, Reach]
    frames: list[int]
    lost: list[int]
    latency: list[Lateness]
    activations: list[Activation]
    controls: list[ControlNote]
    rows: list[Transmission]


def reach_of(injector: Injector) -> Reach:
    """Of one of the gateway's injectors."""
    target, reports = injector.target, tuple(report.frame.can_id for report in injector.reports)
    return Reach(target.to_controller, target.to_drives, target.cob_ids, reports)


# --- writing ---------------------------------------------------------------------------------------------------------


def write_joints(path: Path, part: JointsPart) -> None:
    """Write the part of the joints; raises PartError when it cannot be written."""
    arrays: Arrays = {"times_ns": part.times_ns, "q": part.q, "dq": part.dq, "tau": part.tau}
    _write(path, "joints", _JointsNotes(_service_note(part.service)), arrays, part.rows)


def write_hlc(path: Path, part: HlcPart) -> None:
    """Write the part of the controller; raises PartError when it cannot be written."""
    notes = _HlcNotes(_service_note(part.service), part.time_zero, part.completed, part.held, part.events)
    arrays: Arrays = {"cycles": part.cycles, "q_d": part.q_d, "dq_d": part.dq_d, "tau_command": part.tau_command}
    _write(path, "hlc", notes, arrays, part.rows)


def write_gateway(path: Path, part: GatewayPart) -> None:
    """Write the part of the gateway; raises PartError when it cannot be written."""
    notes = _GatewayNotes(
        _service_note(part.service),
        part.time_zero,
        part.injectors,
        part.frames,
        part.lost,
        [_lateness_note(one) for one in part.latency],
        [_activation_note(one) for one in part.activations],
        part.controls,
    )
    _write(path, "gateway", notes, {}, part.rows)


def _write(path: Path, what: str, notes: "_Notes", arrays: Arrays, rows: list[Transmission]) -> None:
    text = json.dumps({"format": _FORMAT, "part": what, **asdict(notes)}, allow_nan=False)
    members: Arrays = {**arrays, **_row_arrays(rows), _NOTES: np.frombuffer(text.encode(), np.uint8)}
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with unfinished.open("xb") as file:
            np.savez(file, allow_pickle=False, **members)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    except OSError as error:
        raise PartError(f"{what}: cannot write its part {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


# --- reading ---------------------------------------------------------------------------------------------------------


def read_joints(path: Path) -> JointsPart:
    """The part of the joints; raises PartError."""
    notes, arrays, rows = _read(path, "joints", _JointsNotes)
    times = _column(path, arrays, "times_ns")
    q, dq, tau = (_table(path, arrays, name, times.size) for name in ("q", "dq", "tau"))
    return JointsPart(_service(notes.service), times, q, dq, tau, rows)


def read_hlc(path: Path) -> HlcPart:
    """The part of the controller; raises PartError."""
    notes, arrays, rows = _read(path, "hlc", _HlcNotes)
    cycles = _column(path, arrays, "cycles")
    q_d, dq_d, tau = (_table(path, arrays, name, cycles.size) for name in ("q_d", "dq_d", "tau_command"))
    service = _service(notes.service)
    return HlcPart(service, notes.time_zero, notes.completed, notes.held, notes.events, cycles, q_d, dq_d, tau, rows)


def read_gateway(path: Path) -> GatewayPart:
    """The part of the gateway; raises PartError."""
    notes, _, rows = _read(path, "gateway", _GatewayNotes)
    return GatewayPart(
        _service(notes.service),
        notes.time_zero,
        notes.injectors,
        notes.frames,
        notes.lost,
        [_lateness(one) for one in notes.latency],
        [_activation(one) for one in notes.activations],
        notes.controls,
        rows,
    )


_LatenessNote: TypeAlias = dict[str, int | list[list[int]]]
"""A LatenessDocument; it is checked where it is turned back."""


@dataclass(frozen=True, slots=True)
class _ServiceNote:
    start_ns: int
    end_ns: int
    lateness: _LatenessNote
    losses: dict[str, int]


@dataclass(frozen=True, slots=True)
class _Notes:
    service: _ServiceNote


@dataclass(frozen=True, slots=True)
class _JointsNotes(_Notes):
    pass


@dataclass(frozen=True, slots=True)
class _HlcNotes(_Notes):
    time_zero: int
    completed: bool
    held: list[int]
    events: list[NotedEvent]


@dataclass(frozen=True, slots=True)
class _FrameNote:
    can_id: int
    data: str
    flags: int
    dlc: int


@dataclass(frozen=True, slots=True)
class _ActivationNote:
    """What an Activation is made again from: constructor arguments, and what it has counted since."""

    given: tuple[str, int, str, str, int, int, int]
    state: dict[str, int | str | _FrameNote | None]


@dataclass(frozen=True, slots=True)
class _GatewayNotes(_Notes):
    time_zero: int
    injectors: dict[str, Reach]
    frames: list[int]
    lost: list[int]
    latency: list[_LatenessNote]
    activations: list[_ActivationNote] = field(default_factory=list)
    controls: list[ControlNote] = field(default_factory=list)


_N = TypeVar("_N", bound=_Notes)


def _read(path: Path, what: str, model: type[_N]) -> tuple[_N, Arrays, list[Transmission]]:
    try:
        with path.open("rb") as file:
            _check_members(file)
            with np.load(file, allow_pickle=False) as archive:
                arrays: Arrays = {name: archive[name] for name in archive.files}
        notes = json.loads(arrays.pop(_NOTES).tobytes())
        if notes.pop("format") != _FORMAT:
            raise PartError(f"{what}: {path} was written by another version of this program; run all of one version")
        if notes.pop("part") != what:
            raise PartError(f"{what}: {path} is the part of another process")
        return TypeAdapter(model).validate_python(notes), arrays, _rows(arrays)
    except FileNotFoundError as error:
        raise PartError(f"{what}: it left no part of the result") from error
    except OSError as error:
        raise PartError(f"{what}: its part {path} cannot be read: {error.strerror or error}") from error
    except _DAMAGES as error:
        raise PartError(f"{what}: its part {path} is damaged: {error}") from error


def _check_members(file: BinaryIO) -> None:
    """Raise BadZipFile unless every member is whole, before anything is made of it."""
    with zipfile.ZipFile(file) as archive:
        wrong = archive.testzip()
    if wrong is not None:
        raise zipfile.BadZipFile(f"checksum of {wrong} does not fit")
    file.seek(0)


def _column(path: Path, arrays: Arrays, name: str) -> NDArray[np.int64]:
    found = arrays.get(name)
    if found is None or found.ndim != 1 or found.dtype != np.int64:
        raise PartError(f"{path}: no column {name!r} of whole nanoseconds or cycles in it")
    return np.asarray(found, dtype=np.int64)


def _table(path: Path, arrays: Arrays, name: str, rows: int) -> Array:
    found = arrays.get(name)
    if found is None or found.ndim != 2 or found.dtype != np.float64 or found.shape[0] != rows:
        raise PartError(f"{path}: no table {name!r} of {rows} rows in it")
    return np.asarray(found, dtype=np.float64)


# --- frames ----------------------------------------------------------------------------------------------------------


def _row_arrays(rows: list[Transmission]) -> Arrays:
    frames = [row.frame for row in rows]
    columns: tuple[NDArray[np.generic], ...] = (
        np.array([row.end_ns for row in rows], np.int64),
        np.array([row.bus for row in rows], np.uint8),
        np.array([row.sender for row in rows], np.int16),
        np.array([frame.can_id for frame in frames], np.uint32),
        np.array([frame.flags for frame in frames], np.uint8),
        np.array([frame.dlc for frame in frames], np.uint8),
        np.array([len(frame.data) for frame in frames], np.uint8),
        np.frombuffer(b"".join(frame.data for frame in frames), np.uint8),
    )
    return {f"row_{name}": column for name, column in zip(_ROWS, columns, strict=True)}


def _rows(arrays: Arrays) -> list[Transmission]:
    """The rows back; ValueError when the columns do not fit together."""
    columns = [arrays.pop(f"row_{name}") for name in _ROWS]
    payload = columns.pop().tobytes()
    rows: list[Transmission] = []
    at = 0
    for end_ns, bus, sender, can_id, flags, dlc, size in zip(*(column.tolist() for column in columns), strict=True):
        frame = Frame(can_id, payload[at : at + size], flags, -1 if dlc == size else dlc)
        rows.append(Transmission(end_ns, bus, frame, sender))
        at += size
    if at != len(payload):
        raise ValueError(f"{len(payload)} payload bytes for rows that hold {at}")
    return rows


def _frame_note(frame: Frame | None) -> _FrameNote | None:
    return None if frame is None else _FrameNote(frame.can_id, frame.data.hex(), frame.flags, frame.dlc)


def _frame(note: _FrameNote | None) -> Frame | None:
    if note is None:
        return None
    data = bytes.fromhex(note.data)
    return Frame(note.can_id, data, note.flags, -1 if note.dlc == len(data) else note.dlc)


def _activation_note(one: Activation) -> _ActivationNote:
    _, given, state = one.__reduce__()
    return _ActivationNote(given, {name: _counted(value) for name, value in state.items()})


def _counted(value: object) -> int | str | _FrameNote | None:
    if isinstance(value, int | str):
        return value
    assert value is None or isinstance(value, Frame)
    return _frame_note(value)


def _activation(note: _ActivationNote) -> Activation:
    """The Activation back; ValueError when the note is of another version."""
    one = Activation(*note.given)
    if set(one.__reduce__()[2]) != set(note.state):
        raise ValueError(f"an activation with {', '.join(note.state)}")
    for name, value in note.state.items():
        setattr(one, name, value if isinstance(value, int | str) else _frame(value))
    return one


def _service_note(service: Service) -> _ServiceNote:
    return _ServiceNote(service.start_ns, service.end_ns, _lateness_note(service.lateness), service.losses)


def _service(note: _ServiceNote) -> Service:
    return Service(note.start_ns, note.end_ns, _lateness(note.lateness), note.losses)


def _lateness_note(lateness: Lateness) -> _LatenessNote:
    return cast("_LatenessNote", lateness.document())


def _lateness(note: _LatenessNote) -> Lateness:
    return Lateness.from_document(cast("LatenessDocument", note))
