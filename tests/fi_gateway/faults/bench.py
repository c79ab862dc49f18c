"""What the tests of faults share: signals with one SI unit per raw one, frames, and an outlet that remembers."""

import struct

from numpy.random import PCG64, Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.signal import Signal
from fi_gateway.faults import Fault
from fi_gateway.outlet import Outlet

POSITION = Signal("position", "right_knee", "right_knee_TPDO1", 0x185, 0, 32, True, 1.0, "rad", 0x6064, 0)
VELOCITY = Signal("velocity", "right_knee", "right_knee_TPDO1", 0x185, 32, 32, True, 1.0, "rad/s", 0x606C, 0)
WORD = Signal("statusword", "right_knee", "right_knee_TPDO2", 0x285, 0, 16, False, 1.0, "", 0x6041, 0)
ODD = Signal("odd", "right_knee", "odd", 0x185, 13, 11, True, 1.0, "", 0x2000, 1)

OUT = Outlet()
"""Raises when it is used: for faults that send nothing besides."""


class Taken(Outlet):
    """Keeps what it is given."""

    def __init__(self) -> None:
        self.late: list[tuple[int, Frame, bool]] = []
        self.inserted: list[Frame] = []

    def later(self, at_ns: int, frame: Frame, in_order: bool) -> None:
        self.late.append((at_ns, frame, in_order))

    def insert(self, frame: Frame) -> None:
        self.inserted.append(frame)


def rng(seed: int = 1) -> Generator:
    return Generator(PCG64(seed))


def joint(position: int, velocity: int) -> Frame:
    return Frame(0x185, struct.pack("<ii", position, velocity))


def values(frame: Frame | None) -> tuple[int, int]:
    assert frame is not None
    position, velocity = struct.unpack("<ii", frame.data)
    return position, velocity


def begun(fault: Fault, last: Frame | None = None, seed: int = 1, now: int = 0) -> Fault:
    assert fault.begin(now, {} if last is None else {last.can_id: last}, rng(seed))
    return fault


def word(frame: Frame | None) -> int:
    assert frame is not None
    return int.from_bytes(frame.data, "little")
