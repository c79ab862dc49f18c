"""Two records of one id side by side: what was lost, doubled or out of order, and which frame is which."""

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS
from testbench.pairing import pair

SLACK_NS = MS
PERIOD_NS = 10 * MS


def sent(text: str) -> list[Transmission]:
    """A frame for every letter, equal ones for equal letters, every 10 ms."""
    return [Transmission(at * PERIOD_NS, 0, Frame(0x581, letter.encode()), 0) for at, letter in enumerate(text)]


def received(text: str, off_ns: int = 0, times: list[int] | None = None) -> list[Transmission]:
    """The same as they arrive. times: in periods, which letter came when; None: one after the other."""
    places = list(range(len(text))) if times is None else times
    return [
        Transmission(at * PERIOD_NS + off_ns, 0, Frame(0x581, letter.encode()), -1)
        for at, letter in zip(places, text, strict=True)
    ]


def letters(rows: list[Transmission]) -> str:
    """Their contents."""
    return "".join(row.frame.data.decode() for row in rows)


@pytest.mark.parametrize("off_ns", [0, MS, -MS, -PERIOD_NS, -3 * PERIOD_NS, 3 * PERIOD_NS])
def test_order_pairs_frames_that_differ_whatever_their_times_say(off_ns: int) -> None:
    """Times decide between equal frames only: a wrong stamp is no loss."""
    found = pair(sent("abcdef"), received("abcdef", off_ns), SLACK_NS)
    assert (found.missing, found.extra) == ([], [])
    assert letters([row for row, _ in found.pairs]) == letters([row for _, row in found.pairs]) == "abcdef"


@pytest.mark.parametrize("wrong", range(6))
@pytest.mark.parametrize("early", [1, 4])
def test_one_stamp_that_is_wrong_makes_no_loss(wrong: int, early: int) -> None:
    """An adapter may stamp with a clock of its own."""
    times = [at - early if at == wrong else at for at in range(6)]
    found = pair(sent("abcdef"), received("abcdef", 0, times), SLACK_NS)
    assert (found.missing, found.extra) == ([], [])


@pytest.mark.parametrize("off_ns", [0, MS // 2, -MS // 2])
@pytest.mark.parametrize(
    ("came", "times", "missing", "extra"),
    [
        ("abdef", [0, 1, 3, 4, 5], "c", ""),
        ("bcdef", [1, 2, 3, 4, 5], "a", ""),
        ("abcde", [0, 1, 2, 3, 4], "f", ""),
        ("", [], "abcdef", ""),
        ("abccdef", [0, 1, 2, 2, 3, 4, 5], "", "c"),
        ("aabcdef", [0, 0, 1, 2, 3, 4, 5], "", "a"),
        ("abcdeff", [0, 1, 2, 3, 4, 5, 5], "", "f"),
        ("abcdecf", [0, 1, 2, 3, 4, 4, 5], "", "c"),
        ("abdcef", [0, 1, 3, 3, 4, 5], "c", "c"),
        ("abcdfe", [0, 1, 2, 3, 5, 5], "e", "e"),
        ("abxdef", [0, 1, 2, 3, 4, 5], "c", "x"),
        ("abcdefg", [0, 1, 2, 3, 4, 5, 6], "", "g"),
    ],
)
def test_lost_doubled_and_reordered_frames_are_found(
    came: str, times: list[int], missing: str, extra: str, off_ns: int
) -> None:
    """Each once, by name; for two that changed places either may be the one that is named."""
    found = pair(sent("abcdef"), received(came, off_ns, times), SLACK_NS)
    swapped = {"c": "d", "e": "f"}
    if missing == extra != "":
        assert letters(found.missing) == letters(found.extra)
        assert letters(found.missing) in (missing, swapped[missing])
    else:
        assert (letters(found.missing), letters(found.extra)) == (missing, extra)


@pytest.mark.parametrize("gone", range(6))
def test_which_of_equal_frames_is_missing_is_told_by_their_times(gone: int) -> None:
    """A joint that stands still says the same in every cycle."""
    times = [at for at in range(6) if at != gone]
    found = pair(sent("aaaaaa"), received("aaaaa", MS, times), SLACK_NS)
    assert [row.end_ns for row in found.missing] == [gone * PERIOD_NS]
    assert found.extra == []
