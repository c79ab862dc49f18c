"""Kernel stamps on the loop's clock."""

import pytest

from canopen_exo.bus import channel
from canopen_exo.bus.channel import StampClock
from canopen_exo.bus.node import MS, SECOND
from tests.stamps import FakeTime

EPOCH = 1000 * SECOND
WALL = FakeTime().wall


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    fake = FakeTime(EPOCH + 5 * SECOND)
    monkeypatch.setattr(channel, "time", fake)
    return fake


def test_stamp_keeps_its_distance_from_now(clocks: FakeTime) -> None:
    """A stamp of the wall clock 3 ms old is 3 ms old on the loop's clock."""
    stamps = StampClock()
    assert stamps.begin(EPOCH) == 5 * SECOND
    assert stamps.at(WALL - 3 * MS) == 5 * SECOND - 3 * MS


def test_stamp_is_never_later_than_now(clocks: FakeTime) -> None:
    """A wall clock set back between stamp and reading must not send frames into the future."""
    stamps = StampClock()
    stamps.begin(EPOCH)
    assert stamps.at(WALL + SECOND) == 5 * SECOND


def test_stamps_never_go_back(clocks: FakeTime) -> None:
    """A wall clock set forward makes waiting frames look old; they stay behind those that came before."""
    stamps = StampClock()
    stamps.begin(EPOCH)
    first = stamps.at(WALL)
    clocks.pass_by(MS)
    clocks.wall += 3600 * SECOND
    stamps.begin(EPOCH)
    assert stamps.at(WALL + MS // 2) == first


def test_corrected_wall_clock_is_followed(clocks: FakeTime) -> None:
    """The clocks are compared for every batch."""
    stamps = StampClock()
    stamps.begin(EPOCH)
    clocks.pass_by(10 * MS)
    clocks.wall += 7 * SECOND
    stamps.begin(EPOCH)
    assert stamps.at(clocks.wall - MS) == 5 * SECOND + 9 * MS


class SlowTime(FakeTime):
    """Reading a clock takes `cost_ns`; `interrupted`: the process is held up so often, 10 ms, between two clocks."""

    def __init__(self, cost_ns: int) -> None:
        super().__init__(EPOCH)
        self.cost_ns = cost_ns
        self.comparisons = 0
        self.interrupted = 0

    def monotonic_ns(self) -> int:
        self.pass_by(self.cost_ns)
        return super().monotonic_ns()

    def time_ns(self) -> int:
        self.comparisons += 1
        if self.interrupted:
            self.interrupted -= 1
            self.pass_by(10 * MS)
        return super().time_ns()


@pytest.mark.parametrize(("cost_ns", "first"), [(1_000, 1), (50_000, 5)])
def test_comparison_that_was_interrupted_does_not_spoil_the_difference_known(
    monkeypatch: pytest.MonkeyPatch, cost_ns: int, first: int
) -> None:
    """Five times at the beginning at most; later once, while nothing contradicts what was found."""
    clocks = SlowTime(cost_ns)
    monkeypatch.setattr(channel, "time", clocks)
    stamps = StampClock()
    counts = []
    for interrupted in (0, 0, 2, 0, 9):
        clocks.pass_by(20 * MS)
        clocks.comparisons, clocks.interrupted = 0, interrupted
        stamps.begin(EPOCH)
        counts.append(clocks.comparisons)
        clocks.interrupted = 0
        assert abs(stamps.at(clocks.wall) - (clocks.monotonic - EPOCH)) <= cost_ns
    assert counts == [first, 1, 1, 1, 1]


@pytest.mark.parametrize(("cost_ns", "comparisons"), [(100, 100), (20_000, 44), (500_000, 10)])
def test_comparisons_take_one_percent_of_the_time_where_clocks_are_dear(
    monkeypatch: pytest.MonkeyPatch, cost_ns: int, comparisons: int
) -> None:
    """Once a millisecond, more rarely where a clock is a system call that takes long, every 10 ms at least."""
    clocks = SlowTime(cost_ns)
    monkeypatch.setattr(channel, "time", clocks)
    stamps = StampClock()
    stamps.begin(EPOCH)
    end = clocks.monotonic + 100 * MS
    clocks.comparisons = 0
    while clocks.monotonic < end:
        clocks.pass_by(100_000)
        stamps.begin(EPOCH)
    assert clocks.comparisons == pytest.approx(comparisons, rel=0.15)


def test_difference_found_by_interrupted_comparisons_is_corrected(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of them interrupted at the beginning: the first one that is not contradicts."""
    clocks = SlowTime(50_000)
    monkeypatch.setattr(channel, "time", clocks)
    stamps = StampClock()
    clocks.interrupted = 5
    stamps.begin(EPOCH)
    assert stamps.at(clocks.wall) < clocks.monotonic - EPOCH - 4 * MS  # by half of the 10 ms
    for _ in range(2):
        clocks.pass_by(20 * MS)
        stamps.begin(EPOCH)
        assert abs(stamps.at(clocks.wall) - (clocks.monotonic - EPOCH)) <= 50_000


@pytest.mark.parametrize(
    ("first", "later"),
    [(WALL - 5 * MS, (MS, MS, 2 * MS)), (WALL - 5 * MS, (3 * MS, -MS, MS)), (WALL - 2 * MS, (MS, 9 * MS, -20 * MS))],
)
def test_many_stamps_are_what_they_are_one_by_one(clocks: FakeTime, first: int, later: tuple[int, ...]) -> None:
    """Also where they go back, lie in the future, or the second changes among them."""
    times = [first - SECOND // 2, first]
    for step in later:
        times.append(times[-1] + step)
    one, many = StampClock(), StampClock()
    one.begin(EPOCH)
    many.begin(EPOCH)
    parts = [divmod(time_ns, SECOND) for time_ns in times]
    assert many.many([part[0] for part in parts], [part[1] for part in parts]) == [one.at(time_ns) for time_ns in times]
    assert many.many([parts[0][0]], [parts[0][1]]) == [one.at(times[0])]
