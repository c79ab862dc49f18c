"""Recorded gait: joint angles over one stride, as a short Fourier series with its derivatives in closed form.

Source of the recording that comes along: Fukuchi, Fukuchi & Duarte (2018), PeerJ 6:e4640 (CC BY 4.0); details are in
the file's own header. Series: q(p) = sum over n of a_n cos(2 pi n p) + b_n sin(2 pi n p), fitted by least squares.
Phase p is in strides: 0 = right heel strike, 1 = the next one. The left leg does the same half a stride later.
Signs: hip flexion +, knee flexion -, ankle dorsiflexion +.
Leaves out: changes of speed, steps that differ, recordings of both legs.
"""

import math
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from hlc.errors import HlcError
from hlc.limits import split_joint

Array = NDArray[np.float64]

HARMONICS: Final = 7
"""Harmonics of the stride kept; the packaged recording holds exactly so many."""

COLUMNS: Final = ("percent", "hip_deg", "knee_deg", "ankle_deg")
"""Columns of a recording, in this order."""

CLOSURE_DEG: Final = 1.0
"""Largest difference between 0 % and 100 %: an open recording jumps once a stride, and the series rings after it."""

PACKAGED: Final = "gait_walking_fukuchi2018.csv"
"""The recording in hlc/data."""


@dataclass(frozen=True, slots=True)
class Recording:
    """One stride of the right leg. name: for messages; source: the file's comment lines.

    percent: (n,), 0..100, rising; angles_rad: (n, 3), rad, hip, knee, ankle. Both are read-only.
    """

    name: str
    source: str
    percent: Array
    angles_rad: Array


def packaged_recording() -> Recording:
    """The recording that comes with the package (walking at 1.26 m/s, mean of nine people)."""
    return parse_recording(files("hlc").joinpath("data", PACKAGED).read_text(encoding="utf-8"), f"hlc/data/{PACKAGED}")


def read_recording(path: Path) -> Recording:
    """A user's recording from a CSV file; raises HlcError with every fault found, each with its line and column."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise HlcError(f"{path}:1:1: cannot be read as UTF-8 text: {error}; give a CSV file") from error
    return parse_recording(text, str(path))


def parse_recording(text: str, name: str) -> Recording:
    """A recording from CSV text: '#' comments, a line of column names, rows of numbers. `name` is used in messages."""
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]
    source = "\n".join(line[1:].strip() for _, line in lines if line.startswith("#"))
    content = [(number, line) for number, line in lines if line and not line.startswith("#")]
    faults: list[str] = []
    header = tuple(cell.strip() for cell in content[0][1].split(",")) if content else ()
    if header != COLUMNS:
        number = content[0][0] if content else 1
        raise HlcError(f"{name}:{number}:1: columns {','.join(header) or 'none'} given, allowed {','.join(COLUMNS)}")
    numbers: list[int] = []
    rows: list[list[float]] = []
    for number, line in content[1:]:
        row = _parse_row(line, f"{name}:{number}", faults)
        if row is not None:
            numbers.append(number)
            rows.append(row)
    if not faults:
        _check_rows(rows, numbers, name, faults)
    if faults:
        raise HlcError("\n".join(faults))
    table = np.array(rows, dtype=np.float64)
    percent, angles = table[:, 0].copy(), np.deg2rad(table[:, 1:])
    percent.flags.writeable = angles.flags.writeable = False
    return Recording(name, source, percent, angles)


def _parse_row(line: str, where: str, faults: list[str]) -> list[float] | None:
    """The numbers of one row, or None with the reasons added to `faults`."""
    cells = line.split(",")
    if len(cells) != len(COLUMNS):
        faults.append(f"{where}:1: row: {len(cells)} values given, allowed {len(COLUMNS)} ({','.join(COLUMNS)})")
        return None
    row: list[float] = []
    column = 1
    for key, cell in zip(COLUMNS, cells, strict=True):
        low, high = (0.0, 100.0) if key == "percent" else (-180.0, 180.0)
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not low <= value <= high:  # false for not-a-number too
            faults.append(f"{where}:{column}: {key}: {cell.strip()!r} given, allowed a number from {low:g} to {high:g}")
        row.append(value)
        column += len(cell) + 1
    return row


def _check_rows(rows: list[list[float]], numbers: list[int], name: str, faults: list[str]) -> None:
    """Whether the rows make one closed stride, sampled densely enough for the harmonics."""
    widest = 50.0 / HARMONICS  # sampling theorem: two samples in the shortest period, 100 % / HARMONICS
    if not rows or rows[0][0] != 0.0 or rows[-1][0] != 100.0:
        given = f"{rows[0][0]:g} to {rows[-1][0]:g}" if rows else "nothing"
        number = numbers[-1] if rows else 1
        faults.append(f"{name}:{number}:1: percent: {given} given, a recording goes from 0 to 100")
        return
    for i in range(1, len(rows)):
        gap = rows[i][0] - rows[i - 1][0]
        if not 0.0 < gap < widest:
            faults.append(
                f"{name}:{numbers[i]}:1: percent: {rows[i][0]:g} after {rows[i - 1][0]:g} given, "
                f"allowed are rising values less than {widest:.2f} apart ({HARMONICS} harmonics)"
            )
    for j in range(1, len(COLUMNS)):
        jump = rows[-1][j] - rows[0][j]
        if abs(jump) > CLOSURE_DEG:
            faults.append(
                f"{name}:{numbers[-1]}:1: {COLUMNS[j]}: differs by {jump:.3f} deg from the first row, "
                f"allowed {CLOSURE_DEG:g}: a stride ends where it starts; choose the cut or remove the drift"
            )


@final
class Gait:
    """Steady walking of named joints with a given stride time.

    stride_ns: stride time [ns]; joint_names: output order, <left|right>_<hip|knee|ankle>.
    residual_rad: largest distance between series and recording [rad] per joint, in output order.
    """

    def __init__(
        self, stride_ns: int, joint_names: tuple[str, ...], recording: Recording, harmonics: int = HARMONICS
    ) -> None:
        if stride_ns <= 0:
            raise HlcError(f"gait: stride time {stride_ns} ns given, allowed is any time above 0")
        if not 1 <= harmonics <= HARMONICS:
            raise HlcError(f"gait: {harmonics} harmonics given, allowed 1..{HARMONICS}")
        self.stride_ns: Final = stride_ns
        self.joint_names: Final = joint_names
        self.recording: Final = recording
        order = np.arange(harmonics + 1, dtype=np.float64)
        angle = 2 * np.pi * recording.percent[:-1, None] / 100.0 * order  # the last row is the first again
        basis = np.hstack((np.cos(angle), np.sin(angle[:, 1:])))
        coefficients = np.linalg.lstsq(basis, recording.angles_rad[:-1], rcond=None)[0]
        residual = np.abs(basis @ coefficients - recording.angles_rad[:-1]).max(axis=0)
        sine = np.vstack((np.zeros((1, coefficients.shape[1])), coefficients[harmonics + 1 :]))
        # q = Re sum c_n exp(i 2 pi n p): every derivative is a factor i 2 pi n / T
        series = coefficients[: harmonics + 1] - 1j * sine
        kinds = [COLUMNS.index(f"{split_joint(name)[1]}_deg") - 1 for name in joint_names]
        late = np.array([0.5 if split_joint(name)[0] == "left" else 0.0 for name in joint_names])
        self._order: Final = order
        self._series: Final = series[:, kinds] * np.exp(-2j * np.pi * order[:, None] * late)
        self.residual_rad: Final = tuple(float(residual[kind]) for kind in kinds)

    def mean(self) -> Array:
        """Mean angles over a stride, (n_joints,), rad."""
        return np.asarray(self._series[0].real, dtype=np.float64)

    def q(self, phase: Array) -> Array:
        """Angles at phases (n,) [strides]: (n, n_joints), rad."""
        return self._derivative(phase, 0)

    def dq(self, phase: Array) -> Array:
        """Angular velocities at phases (n,) [strides]: (n, n_joints), rad/s."""
        return self._derivative(phase, 1)

    def ddq(self, phase: Array) -> Array:
        """Angular accelerations at phases (n,) [strides]: (n, n_joints), rad/s^2."""
        return self._derivative(phase, 2)

    def _derivative(self, phase: Array, times: int) -> Array:
        turns = np.asarray(phase, dtype=np.float64)[:, None] * self._order
        factor = (2j * np.pi * self._order * 1e9 / self.stride_ns) ** times
        return np.asarray(((np.exp(2j * np.pi * turns) * factor) @ self._series).real, dtype=np.float64)
