"""`injections.csv` of a result folder: one row per activation of an injector, for people and for a replay.

Times are seconds from time 0, to the nanosecond; an empty cell means that there is none. The file lies beside the
candump logs, because their format has no comments.
"""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from canopen_exo.bus.trace import candump_frame
from fi_gateway.activation import Activation
from fi_gateway.replay import Window
from testbench.errors import BenchError

INJECTIONS_FILE: Final = "injections.csv"

_COLUMNS: Final = (
    *("injector", "index", "signal", "cause", "due_s", "start_s", "duration_s", "end_s"),
    *("frames_seen", "frames_unfit", "frames_injected", "frames_manifested"),
    *("frames_changed", "frames_lost", "frames_delayed", "frames_inserted", "saturated"),
    *("attempts_seen", "attempts_disturbed"),
    *("first_frame_s", "first_before", "first_after", "skipped", "stream"),
)

_DIGITS: Final = 9


def write_injections(path: Path, activations: Sequence[Activation], time0_ns: int) -> None:
    """Write the file. time0_ns: time 0 on the clock of the activations."""
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(_COLUMNS)
        for one in activations:
            table.writerow(
                (
                    *(one.injector, one.index, one.signal, one.cause),
                    seconds(one.due_ns - time0_ns),
                    seconds(one.start_ns - time0_ns),
                    "" if one.duration_ns >= NEVER else seconds(one.duration_ns),
                    "" if one.end_ns >= NEVER else seconds(one.end_ns - time0_ns),
                    *(one.frames_seen, one.frames_unfit, one.frames_injected, one.manifested),
                    *(one.frames_changed, one.frames_lost, one.frames_delayed, one.frames_inserted, one.saturated),
                    *(one.attempts_seen, one.attempts_disturbed),
                    "" if one.first_ns >= NEVER else seconds(one.first_ns - time0_ns),
                    *(_frame(one.first_before), _frame(one.first_after), one.skipped, one.stream),
                )
            )


def read_injections(path: Path) -> dict[str, tuple[Window, ...]]:
    """The windows in the file by injector, in the order in which they opened; from time 0. Raises BenchError."""
    windows: dict[str, list[Window]] = {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            table = csv.DictReader(file, strict=True)
            missing = sorted({"injector", "start_s", "end_s", "skipped", "stream"} - set(table.fieldnames or ()))
            if missing:
                raise BenchError(f"{path}:1: no column {missing[0]!r}; give the folder of a result")
            for row in table:
                try:
                    if None in row or None in row.values():
                        raise ValueError("a row with fewer or more cells than columns given")
                    start_ns = nanoseconds(row["start_s"])
                    end_ns = nanoseconds(row["end_s"]) if row["end_s"] else NEVER
                    window = Window(start_ns, end_ns, row["stream"], _count(row["skipped"]))
                    windows.setdefault(row["injector"], []).append(window)
                except ValueError as error:
                    where = f"{path}:{table.line_num}"
                    raise BenchError(f"{where}: {error}; allowed are rows as exo-hil run writes them") from error
    except (OSError, UnicodeError, csv.Error) as error:
        raise BenchError(f"{path}: cannot be read: {error}; give the folder of a result") from error
    return {name: tuple(found) for name, found in windows.items()}


def seconds(time_ns: int) -> str:
    """A time in seconds with nine digits, without rounding."""
    whole, rest = divmod(abs(time_ns), 10**_DIGITS)
    return f"{'-' if time_ns < 0 else ''}{whole}.{rest:0{_DIGITS}d}"


def nanoseconds(text: str) -> int:
    """`seconds` back. Raises ValueError."""
    whole, _, rest = text.removeprefix("-").partition(".")
    if not (whole.isdecimal() and (rest or "0").isdecimal() and len(rest) <= _DIGITS and text.isascii()):
        raise ValueError(f"time {text!r} given")
    value = int(whole) * 10**_DIGITS + int(rest.ljust(_DIGITS, "0"))
    return -value if text.startswith("-") else value


def _count(text: str) -> int:
    if not (text.isdecimal() and text.isascii()):
        raise ValueError(f"number of frames {text!r} given")
    return int(text)


def _frame(frame: Frame | None) -> str:
    return "" if frame is None else candump_frame(frame)
