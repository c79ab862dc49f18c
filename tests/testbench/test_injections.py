"""injections.csv: what happened, to the nanosecond, for people and for a replay."""

import csv
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.node import NEVER
from fi_gateway.activation import Activation
from fi_gateway.replay import Window
from testbench.errors import BenchError
from testbench.injections import nanoseconds, read_injections, seconds, write_injections

ActivationMaker = Callable[..., Activation]

ZERO = 3_000_056_000
HEAD = "injector,start_s,end_s,skipped,stream\n"


@given(st.integers(-(10**19), 10**19))
def test_times_come_back_to_the_nanosecond(time_ns: int) -> None:
    """A float of seconds would not keep them."""
    assert nanoseconds(seconds(time_ns)) == time_ns


@pytest.mark.parametrize(
    ("time_ns", "text"),
    [(0, "0.000000000"), (1, "0.000000001"), (-1, "-0.000000001"), (-(10**9) * 3 // 2, "-1.500000000")],
)
def test_times_are_seconds_with_nine_digits(time_ns: int, text: str) -> None:
    """For people."""
    assert seconds(time_ns) == text


@pytest.mark.parametrize(("text", "time_ns"), [("3", 3 * 10**9), ("0.3", 300_000_000), ("-0.25", -250_000_000)])
def test_times_may_be_written_shorter(text: str, time_ns: int) -> None:
    """Somebody may have edited the file."""
    assert nanoseconds(text) == time_ns


@pytest.mark.parametrize("text", ["", "-", "1e3", "0.0000000001", "1.2.3", "--1", "+1", " 1", "٣", "1,5", "NaN", "0x1"])
def test_what_is_no_time_is_refused(text: str) -> None:
    """Also digits that are none in a file of numbers."""
    with pytest.raises(ValueError, match="given"):
        nanoseconds(text)


def test_a_row_says_when_why_and_what_became_of_the_frames(tmp_path: Path, activation_maker: ActivationMaker) -> None:
    """faults.md: sampled times, cause, first changed frame before and after, counts; one row per activation."""
    lost = activation_maker("lose", "right_knee.TPDO1", -0.5, 0.1, 3)
    none = activation_maker("idle")
    none.first_ns = NEVER
    lost.first_after, lost.saturated, lost.frames_unfit = None, 7, 1
    lost.frames_changed, lost.frames_lost, lost.frames_delayed, lost.frames_inserted = 1, 20, 300, 4_000
    path = tmp_path / "injections.csv"
    write_injections(path, [activation_maker(), lost, none], ZERO)
    with path.open(newline="") as file:
        first, second, third = list(csv.DictReader(file))
    assert first == {
        "injector": "freeze_position", "index": "0", "signal": "right_knee.position", "cause": "event",
        "due_s": "3.000000000", "start_s": "3.000000000", "duration_s": "0.300000000", "end_s": "3.300000000",
        "frames_seen": "150", "frames_unfit": "0", "frames_injected": "150", "frames_manifested": "148",
        "frames_changed": "148", "frames_lost": "0", "frames_delayed": "0", "frames_inserted": "0", "saturated": "0",
        "attempts_seen": "0", "attempts_disturbed": "0",
        "first_frame_s": "3.001000000", "first_before": "185#0102030405060708", "first_after": "185#0000000005060708",
        "skipped": "0", "stream": "",
    }
    assert (second["start_s"], second["end_s"]) == ("-0.500000000", "-0.400000000")
    assert (second["first_before"], second["first_after"]) == ("185#0102030405060708", "")
    assert (second["frames_manifested"], third["first_frame_s"]) == ("4321", "")
    assert (second["index"], second["saturated"], second["frames_unfit"]) == ("3", "7", "1")


def test_windows_come_back_by_injector(tmp_path: Path) -> None:
    """In the order in which they opened, with their streams; a window without end has none."""
    endless = Activation("b", 0, "x", "trigger:a", ZERO, ZERO + 1, NEVER)
    ones = [Activation("a", index, "x", "event", ZERO - 5, ZERO - 5 + 100 * index, 50) for index in (0, 1)]
    ones[1].end_ns = ZERO + 99
    ones[1].stream, ones[1].skipped = "1.2.0.0", 2
    path = tmp_path / "injections.csv"
    write_injections(path, [ones[0], endless, ones[1]], ZERO)
    assert read_injections(path) == {
        "a": (Window(-5, 45), Window(95, 99, "1.2.0.0", 2)),
        "b": (Window(1, NEVER),),
    }


def test_a_run_without_faults_has_a_file_without_rows(tmp_path: Path) -> None:
    """Nothing happened: that is said, too."""
    path = tmp_path / "injections.csv"
    write_injections(path, [], ZERO)
    assert path.read_text().startswith("injector,index,signal,cause,due_s,start_s,")
    assert read_injections(path) == {}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r":1: no column 'end_s'"),
        ("a,b\n", r":1: no column"),
        ("injector,start_s,end_s,stream\n", r":1: no column 'skipped'"),
        (f"{HEAD}x,1.0,2.0,0,\nx,soon,2.0,0,\n", r":3: time 'soon' given"),
        (f"{HEAD}x,1.0,2.0,-1,\n", r":2: number of frames '-1' given"),
        (f"{HEAD}x,1.0,2.0,,\n", r":2: number of frames '' given"),
        (f"{HEAD}x,1.0\n", r":2: a row with fewer"),
        (f"{HEAD}x,1.0,2.0,0,,\n", r":2: a row with fewer or more"),
        (f'{HEAD}"x\n', "cannot be read"),
        (f"{HEAD}\udcff,1,2,0,\n", "cannot be read"),
    ],
)
def test_a_damaged_file_is_refused_with_its_line(tmp_path: Path, text: str, words: str) -> None:
    """The message says where."""
    path = tmp_path / "injections.csv"
    path.write_text(text, errors="surrogateescape")
    with pytest.raises(BenchError, match=words):
        read_injections(path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    """The message says which."""
    with pytest.raises(BenchError, match=r"injections\.csv: cannot be read"):
        read_injections(tmp_path / "injections.csv")
