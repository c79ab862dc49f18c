"""The rule for runs that were late."""

import pytest

from tests.parity.patience import TRIES, Late, Patience, gave_up_late, is_lateness, told_late


class Machine:
    """Attempts that are late `late` times and take `takes_s` each."""

    def __init__(self, late: int, takes_s: float = 1.0) -> None:
        self.now = 0.0
        self.attempts = 0
        self._late = late
        self._takes_s = takes_s

    def clock(self) -> float:
        return self.now

    def attempt(self) -> str | Late:
        self.now += self._takes_s
        self.attempts += 1
        return Late(f"late {self.attempts}") if self.attempts <= self._late else "punctual"


@pytest.mark.parametrize("late", [0, 1, 2])
def test_late_run_is_repeated_twice_at_most(late: int) -> None:
    """The first that is not late counts."""
    machine = Machine(late)
    assert Patience(100.0, machine.clock).until_punctual(machine.attempt) == "punctual"
    assert machine.attempts == late + 1


def test_third_late_run_skips_and_says_why_each_time() -> None:
    """With what was late; nothing fails."""
    machine = Machine(3)
    with pytest.raises(pytest.skip.Exception, match="too busy for real time: late 1; again: late 2; again: late 3"):
        Patience(100.0, machine.clock).until_punctual(machine.attempt)
    assert machine.attempts == TRIES


def test_patience_ends_when_repeating_has_not_helped() -> None:
    """From then on one attempt a test: a busy machine makes the suite skip, not last."""
    patience, first, second = Patience(100.0), Machine(3), Machine(1)
    with pytest.raises(pytest.skip.Exception):
        patience.until_punctual(first.attempt)
    with pytest.raises(pytest.skip.Exception, match=r"late 1$"):
        patience.until_punctual(second.attempt)


def test_patience_ends_when_late_runs_have_taken_long() -> None:
    """Two of 60 s are more than 90 s."""
    machine = Machine(3, 60.0)
    with pytest.raises(pytest.skip.Exception, match=r"late 2$"):
        Patience(90.0, machine.clock).until_punctual(machine.attempt)
    assert machine.attempts == 2


def test_punctual_runs_use_no_patience_up() -> None:
    """However long they take."""
    machine = Machine(0, 60.0)
    patience = Patience(90.0, machine.clock)
    for _ in range(5):
        assert patience.until_punctual(machine.attempt) == "punctual"


@pytest.mark.parametrize(
    ("line", "is_late"),
    [
        ("timing: 0 of 90 cycles late, SYNC off by at most 0.4 ms (50 %: 0.0, 99 %: 0.2); 0 frames not heard", False),
        ("timing: 1 of 90 cycles late, SYNC off by at most 0.4 ms (50 %: 0.0, 99 %: 0.2); 0 frames not heard", True),
        ("timing: 1 of 100 cycles late, SYNC off by at most 0.4 ms (50 %: 0.0, 99 %: 0.2); 0 frames not heard", False),
        ("timing: 0 of 0 cycles late, SYNC off by at most 0.0 ms (50 %: 0.0, 99 %: 0.2); 0 frames not heard", False),
        ("E   left_hip (node 1): no boot-up message within 1 s of reset communication; check power", True),
        ("timing: 0 of 90 cycles late, SYNC off by at most 5.1 ms (50 %: 0.0, 99 %: 0.2); 0 frames not heard", True),
        ("timing: 0 of 90 cycles late, SYNC off by at most 5.0 ms (50 %: 0.0, 99 %: 0.2); 2 frames not heard", True),
        ("E   ProcessError: joints: not ready after 30 s: no boot-up", True),
        ("E   assert 0 < 0", False),
    ],
)
def test_failure_of_a_users_test_is_a_matter_of_lateness_only_when_it_says_so(line: str, is_late: bool) -> None:
    """A failure in a rig that kept time (10 ms cycle) is a failure."""
    assert told_late(f"before\n{line}\nafter\n", 10.0) == ([line] if is_late else [])


@pytest.mark.parametrize(
    ("said", "is_late"),
    [
        ("hlc ended with exit code 4\nthe rig was late: 3 of 50 cycles, SYNC off by at most 30.1 ms; this", True),
        ("joints: not ready after 30 s: no boot-up and no SDO answer on the drive bus", True),
        ("hlc: left_hip: no SDO answer within 0.5 s while writing 0x0 to 1400:01; check the device and the bus", True),
        ("hlc ended with exit code 4\nthe motion ended because left_hip dropped its torque: SYNC lost (8700)", False),
        ("gateway ended with exit code 1\nTraceback (most recent call last):", False),
        ("", False),
    ],
)
def test_rig_that_gave_up_was_late_only_when_it_says_so(said: str, is_late: bool) -> None:
    """Whatever else ends a rig is a defect."""
    assert gave_up_late(said) == is_late


BUSY = "golden run: 10 of 200 cycles late (5.0 %), allowed 1 %: cycle 8, joints sent 181"
FULL = "joints: 3 frames dropped at port 0, its transmit queue was full"


@pytest.mark.parametrize(
    ("reasons", "late"),
    [
        ([BUSY], True),
        ([BUSY, "golden run: a cycle late by 43.8 ms, allowed 20 ms: cycle 8, joints sent 181"], True),
        (["the motion was given up without a fault", BUSY], True),
        (["the motion never began: x; wake-ups served late: hlc 9, 50 % within 0.1 ms, the latest 5.0 ms"], True),
        (["the motion never began: x; wake-ups served late: hlc 9, 50 % within 0.1 ms, the latest 4.9 ms"], False),
        (["the motion never began: no status frame"], False),
        ([BUSY, FULL, "drive bus, frames from joints to gateway: lost: 181 (2), 182 (1)"], True),
        ([BUSY, FULL, "drive bus, frames from joints to gateway: lost: 181 (2), 182 (2)"], False),
        ([BUSY, FULL, "drive bus, frames from joints to gateway: doubled or out of order: 181 (4)"], False),
        ([BUSY, "gateway, frames to the drives that no fault was at: lost: 205 (1)"], False),
        ([FULL], False),
        ([BUSY, "joints: it left no part of the result"], False),
        (["gateway was killed by SIGKILL"], False),
        ([], False),
    ],
)
def test_only_lateness_is_forgiven(reasons: list[str], late: bool) -> None:
    """Each promise of the rig fails its tests on a busy machine too: nothing lost uncounted, every part there."""
    assert is_lateness(reasons, 10.0) == late
