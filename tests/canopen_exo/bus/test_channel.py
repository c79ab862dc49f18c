"""Kernel stamps on the loop's clock."""

import pytest

from canopen_exo.bus import channel
from canopen_exo.bus.channel import StampClock
from canopen_exo.bus.node import MS, SECOND

EPOCH = 1000 * SECOND
WALL = 1_700_000_000 * SECOND


class FakeTime:
    """Both clocks of the machine, ns."""

    def __init__(self) -> None:
        self.monotonic = EPOCH + 5 * SECOND
        self.wall = WALL

    def monotonic_ns(self) -> int:
        return self.monotonic

    def time_ns(self) -> int:
        return self.wall

    def pass_by(self, span_ns: int) -> None:
        self.monotonic += span_ns
        self.wall += span_ns


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    fake = FakeTime()
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
    clocks.pass_by(10 * MS)
    clocks.wall += 3600 * SECOND
    stamps.begin(EPOCH)
    assert stamps.at(WALL + MS // 2) == first


def test_corrected_wall_clock_is_followed(clocks: FakeTime) -> None:
    """The clocks are compared every 10 ms."""
    stamps = StampClock()
    stamps.begin(EPOCH)
    clocks.pass_by(10 * MS)
    clocks.wall += 7 * SECOND
    stamps.begin(EPOCH)
    assert stamps.at(clocks.wall - MS) == 5 * SECOND + 9 * MS


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
