"""The whole rig: what is recorded of runs that end early, and how they are judged."""

import math

import pytest

from canopen_exo.bus.node import MS, SECOND
from hlc.limits import limits_of
from hlc.node import Phase
from testbench.record import RunRecord
from testbench.rig import CONTROLLER_BUS, DRIVE_BUS, RigParams, build_rig
from testbench.run import drive_through, record_of, run_rig
from testbench.verdict import judge
from tests.testbench.whole_rig import (
    DURATION,
    NAMES,
    PLAN,
    STRIDE,
    bus_of,
    cut_after_3_s,
    dropped,
    finished,
    new_rig,
    run_to,
)

pytestmark = pytest.mark.run


# ---- what is recorded and judged ----------------------------------------------------------------------------------

PINNED = RigParams(PLAN, True, STRIDE, DURATION)
LIMITS = {name: limits_of(name) for name in NAMES}
SOFT_PINS = math.radians(3.0)
"""How far limp legs sink into the pins: soft contacts yield."""


@pytest.fixture(scope="module")
def pinned_golden() -> RunRecord:
    """The fault-free run with pins. Not to be changed."""
    return run_rig(PINNED, [])[0]


def test_sync_lost_for_good_is_detected_and_leaves_the_legs_in_their_range(pinned_golden: RunRecord) -> None:
    """From 1 s on no SYNC reaches the drives: valid, ended early, no failure within the give of the pins."""
    faulted, _ = run_rig(PINNED, [dropped(0x080, SECOND, 60 * SECOND)])
    found = judge(NAMES, LIMITS, pinned_golden, faulted, tolerance_rad=SOFT_PINS)
    assert (found.outcome, found.passed, found.failures) == ("detected_safe", True, ())
    assert (faulted.valid, faulted.completed) == (True, False)
    (loss,) = faulted.activations
    assert loss.signal == "SYNC 0x080"
    assert loss.start_ns == faulted.time0_ns + SECOND
    assert loss.frames_seen == loss.frames_injected == loss.frames_lost == 5  # then the drives knew, and all ended
    told = [note for note in faulted.notes if "8700" in note.text]
    assert sorted(note.node for note in told) == sorted(NAMES)
    assert all(1.0 < note.time_s < 1.012 for note in told)
    last = faulted.commands.t_s[-1]
    assert 1.0 < last < 1.012  # the controller wanted nothing after that


def test_limp_legs_that_leave_their_range_are_a_failure_all_the_same(pinned_golden: RunRecord) -> None:
    """Detected is not safe by itself: without pins the legs swing past their range after the motion has ended."""
    faulted, _ = run_rig(RigParams(PLAN, False, STRIDE, DURATION), [dropped(0x080, SECOND, 60 * SECOND)])
    found = judge(NAMES, LIMITS, pinned_golden, faulted, tolerance_rad=SOFT_PINS)
    assert (found.outcome, found.passed, faulted.completed) == ("failure", False, False)
    assert all(one.time_s > 1.012 for one in found.failures)


@pytest.mark.parametrize("bus", [CONTROLLER_BUS, DRIVE_BUS], ids=["controller", "drive"])
def test_run_whose_cable_is_cut_is_valid_and_says_what_happened(pinned_golden: RunRecord, bus: int) -> None:
    """Full transmit queues are explained by the cut: the record can be judged, and names every drive that was lost."""
    rig = run_to(build_rig(PINNED, []), Phase.MOTION)
    rig.loop.run_until(rig.controller.time_zero + 3 * SECOND)
    bus_of(rig, bus).cut()
    drive_through(rig, lambda share: None)
    assert rig.loop.now > rig.controller.time_zero + DURATION
    faulted = record_of(rig)
    assert (faulted.valid, faulted.invalid_reasons, faulted.completed) == (True, [], False)
    assert faulted.buses[bus].queue_overflows > 0
    lost = [note for note in faulted.notes if note.kind == "heartbeat_lost"]
    assert sorted(note.node for note in lost) == sorted(NAMES)
    assert all(3.0 < note.time_s <= 3.3 for note in lost)
    assert [note.node for note in faulted.notes if note.kind == "still_enabled"] == list(NAMES)  # nobody could tell
    assert faulted.truth.t_s[-1] == 7.0  # the plant is watched to the end of the motion time
    assert 3.0 < faulted.commands.t_s[-1] < 3.3
    found = judge(NAMES, LIMITS, pinned_golden, faulted, tolerance_rad=SOFT_PINS)
    assert (found.outcome, found.passed) == ("detected_safe", True)
    strict = judge(NAMES, LIMITS, pinned_golden, faulted)
    assert strict.outcome == "failure"  # limp feet lean on their pins
    assert min(one.time_s for one in strict.failures) > 3.0


def test_same_loss_of_frames_without_a_cut_is_invalid() -> None:
    """A queue that overflows for no reason proves nothing; nor does a golden run that was given up."""
    rig, _ = cut_after_3_s(DRIVE_BUS)
    drive_through(rig, lambda share: None)
    rig.drive_bus.cuts = 0
    reasons = record_of(rig).invalid_reasons
    assert len(reasons) == 2
    assert "drive bus" in reasons[0]
    assert "lost in full transmit queues" in reasons[0]
    assert "given up without a fault" in reasons[1]


def test_injections_at_or_after_the_end_of_the_motion_are_not_recorded() -> None:
    """[0, duration): one ns before the end is the last start that counts, whatever an injector counts from."""
    duration = SECOND
    ends = [duration - 1, duration, duration + 1, duration + 100 * MS]
    parts = [dropped(0x185, at_ns, 10 * MS, to_drives=False, name=f"n{at_ns}") for at_ns in ends]
    late = dropped(0x186, 4 * SECOND, 10 * MS, to_drives=False, name="power up", from_power_up=True)
    rig = finished(new_rig([*parts, late], duration_ns=duration))
    rig.loop.run_until(5 * SECOND)
    rig.gateway.finish(rig.loop.now)
    record = record_of(rig)
    assert [one.injector for one in record.activations] == [f"n{duration - 1}"]
    assert record.activations[0].start_ns == record.time0_ns + duration - 1
    assert record.completed
    after = [one.injector for one in record.activations_after]
    assert after == [one.injector for one in rig.gateway.records[1:]]
    assert after[0] == f"n{duration}"
    assert after[-1] == "power up"
