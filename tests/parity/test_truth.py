"""Where truth against the clock is compared with lock-step, tried on lock-step runs that are disturbed on purpose."""

from dataclasses import replace

import pytest

from canopen_exo.bus.medium import Transmission
from testbench.record import RunRecord
from testbench.scenario import parse_scenario
from tests.parity.truth import BOUND_RAD, comparable, difference, disturbed
from tests.parity.walks import Bench, in_lock_step

pytestmark = pytest.mark.run

BENCH = Bench(None, 50)
CYCLE_NS = BENCH.cycle_ns
HELD = 3
"""Cycles in succession; 5 % of the samples, which a walk may hold, would be six."""


@pytest.fixture(scope="module")
def undisturbed() -> RunRecord:
    """A walk."""
    return in_lock_step(BENCH.scenario())


@pytest.fixture(scope="module")
def held() -> RunRecord:
    """The same with the samples of three cycles lost on their way to the controller, from 0.3 s on."""
    lines = ["injectors:"]
    for node_id in range(1, 7):
        lines += [
            f"  lost_{node_id}:",
            f"    target: {{bus: to_controller, cob_id: 0x{0x180 + node_id:X}}}",
            "    fault: {type: drop}",
            "    event: {type: at, time: 299 ms}",
            f"    effect: {{type: constant_time, duration: {20 * HELD} ms}}",
        ]
    return in_lock_step(parse_scenario(BENCH.text() + "\n".join(lines) + "\n"))


def late(record: RunRecord, bus: int, base: int, by_ns: int, cycle: int) -> RunRecord:
    """The record with the frames of that function in that cycle shown later."""
    start = record.time0_ns + cycle * CYCLE_NS
    rows = [
        Transmission(row.end_ns + by_ns, row.bus, row.frame, row.sender)
        if row.bus == bus and row.frame.can_id & 0x780 == base and start <= row.end_ns < start + CYCLE_NS
        else row
        for row in record.rows
    ]
    return replace(record, rows=sorted(rows, key=lambda row: row.end_ns))


def test_lock_step_is_nowhere_disturbed(undisturbed: RunRecord) -> None:
    """All of it is compared."""
    assert disturbed(undisturbed, CYCLE_NS) == []
    assert comparable(undisturbed, CYCLE_NS).all()
    assert difference(undisturbed, undisturbed, comparable(undisturbed, CYCLE_NS)) == ""


def test_held_samples_take_out_what_they_moved(undisturbed: RunRecord, held: RunRecord) -> None:
    """They move the plant beyond the bound though nothing is wrong; before them and half a second later all agrees."""
    assert abs(held.truth.q - undisturbed.truth.q).max() > BOUND_RAD
    assert disturbed(held, CYCLE_NS) == [(15 + number) * CYCLE_NS for number in range(HELD)]
    where = comparable(held, CYCLE_NS)
    assert where.mean() > 0.7
    assert difference(held, undisturbed, where) == ""


@pytest.mark.parametrize(
    ("bus", "base", "late_ms"),
    [
        pytest.param(1, 0x180, 6, id="drives that answer after a quarter of the cycle"),
        pytest.param(0, 0x200, 13, id="commands at the controller's deadline"),
        pytest.param(1, 0x200, 19, id="commands after the next SYNC"),
    ],
)
def test_cycle_that_acted_late_is_disturbed(undisturbed: RunRecord, bus: int, base: int, late_ms: int) -> None:
    """Also where no sample was held."""
    assert 40 * CYCLE_NS in disturbed(late(undisturbed, bus, base, late_ms * 1_000_000, 40), CYCLE_NS)


def test_plant_that_is_elsewhere_is_told(undisturbed: RunRecord) -> None:
    """A real difference fails, with joint, time and value."""
    q = undisturbed.truth.q.copy()
    q[1200, 4] += 0.05
    other = replace(undisturbed, truth=replace(undisturbed.truth, q=q))
    told = difference(other, undisturbed, comparable(other, CYCLE_NS))
    assert told.startswith("right_knee off by 0.0500 rad at 1.200 s: ")
