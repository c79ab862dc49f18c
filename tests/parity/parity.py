"""What a walk against the clock has in common with the same walk in lock-step, as tests for any bus.

A subclass names its bench; the fixture `walks` of its module makes the walks there.
"""

from collections import Counter

import pytest

from tests.parity.cycles import SENDERS, by_cycle, heartbeats, sender
from tests.parity.patience import BUSY
from tests.parity.truth import NEEDED_SHARE, comparable, difference, disturbed
from tests.parity.walks import VERDICTS, Bench, Walks, judged


class Parity:
    """To be subclassed as `Test...`."""

    bench: Bench

    @pytest.mark.parametrize("name", list(VERDICTS))
    def test_verdict_is_that_of_lock_step(self, walks: Walks, name: str) -> None:
        """Parity: the same verdicts for no fault, 0.05 rad bias, and a freeze of 1 s."""
        golden, faulted = walks("none"), walks(name)
        real = judged(golden.real.record, faulted.real.record)
        lock_step = judged(golden.lock_step, faulted.lock_step)
        assert real.passed == lock_step.passed == VERDICTS[name]
        assert {one.joint for one in real.failures} == {one.joint for one in lock_step.failures}
        assert len(faulted.real.record.activations) == len(faulted.lock_step.activations) == (name != "none")

    @pytest.mark.parametrize("bus", [0, 1], ids=["controller-bus", "drive-bus"])
    @pytest.mark.parametrize("name", ["none", "freeze"])
    def test_frames_of_each_cycle_are_those_of_lock_step(self, walks: Walks, name: str, bus: int) -> None:
        """Parity: per cycle that was not late, the same multiset of synchronous COB-IDs, the same order per sender."""
        pair = walks(name)
        found, wanted = by_cycle(pair.real.record, bus), by_cycle(pair.lock_step, bus)
        late = pair.real.timing.late
        compared = 0
        for cycle in range(1, self.bench.cycles - 1):  # whether the one before time 0 was late is not judged
            # a late frame is missing in its own cycle and one too many in the one after
            if late.keys() & {cycle - 1, cycle, cycle + 1}:
                continue
            assert Counter(found[cycle]) == Counter(wanted[cycle]), f"cycle {cycle}"
            for who in SENDERS:
                order = [can_id for can_id in found[cycle] if sender(can_id) == who]
                assert order == [can_id for can_id in wanted[cycle] if sender(can_id) == who], f"cycle {cycle}"
            compared += 1
        assert compared >= 0.9 * self.bench.cycles  # at most 1 % of the cycles are late, and each takes three out

    @pytest.mark.parametrize("second", [0, 1])
    def test_heartbeats_are_those_of_lock_step(self, walks: Walks, second: int) -> None:
        """Parity: heartbeats by count, +-1 a second."""
        pair = walks("none")
        found, wanted = heartbeats(pair.real.record, second), heartbeats(pair.lock_step, second)
        assert set(found) == set(wanted) == {0x701, 0x702, 0x703, 0x704, 0x705, 0x706, 0x77F}
        assert all(abs(found[can_id] - count) <= 1 for can_id, count in wanted.items())

    def test_truth_is_that_of_lock_step(self, walks: Walks) -> None:
        """The same plant, the same gait, on the same 1 kHz grid: wherever the same commands acted at the same time."""
        pair = walks("none")
        found, wanted = pair.real.record, pair.lock_step
        assert found.truth.t_s.tolist() == wanted.truth.t_s.tolist()
        where = comparable(found, self.bench.cycle_ns)
        told = difference(found, wanted, where)
        assert not told, told
        if where.mean() < NEEDED_SHARE:
            count = len(disturbed(found, self.bench.cycle_ns))
            pytest.skip(f"{BUSY}: {count} cycles were disturbed, {100 * where.mean():.0f} % of the truth compares")
