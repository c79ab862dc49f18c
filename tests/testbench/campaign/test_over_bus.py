"""Campaigns against the clock, on the hub; on vcan in tests/vcan. What is refused is said before anything runs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from canopen_exo.bus.node import NEVER, SECOND
from fi_gateway.control_socket import Listing
from fi_gateway.errors import FaultError
from fi_gateway.schema import build_injectors
from testbench.campaign.making import over_bus
from testbench.campaign.making.early import LOOK_NS
from testbench.campaign.making.execute import Pair, Workshop, judged, make_run
from testbench.campaign.making.executor import FolderError
from testbench.campaign.making.over_bus import OverBus, Rigging, arm, check_scenario
from testbench.campaign.records import Outcome, RunRow, RunSpec
from testbench.errors import BenchError
from testbench.realtime_run import RealTimeRun
from testbench.run import judge_pair, rig_params, run_rig
from testbench.scenario import parse_scenario
from testbench.supervisor import Setup
from tests.parity.patience import BUSY, is_lateness
from tests.parity.six_runs import make_six_runs
from tests.parity.walks import Bench
from tests.testbench.campaign.specs import spec

HUB = Bench(None, 100)
LONGER = [f"injectors.{name}.effect.duration=1 s" for name in ("freeze_position", "zero_velocity")]


def scenario_with(injector: str) -> str:
    return f"{HUB.text()}injectors:\n  one:\n{injector}"


POWER_UP = """\
    target: {bus: to_controller, node: right_knee, signal: position}
    fault: {type: bias, value: 0.05 rad}
    event: {type: at, time: 0 s}
    effect: {type: infinite}
    from: power_up
"""
WIRE = """\
    target: {bus: to_controller, node: right_knee, pdo: TPDO1}
    fault: {type: no_ack}
    event: {type: at, time: 1 s}
    effect: {type: constant_time, duration: 0.1 s}
"""


def test_faults_from_power_up_are_refused_because_they_are_armed_later() -> None:
    scenario = parse_scenario(scenario_with(POWER_UP))
    with pytest.raises(BenchError, match=r"injectors\.one\.from: power_up is over when .* allowed is time_zero"):
        check_scenario(scenario, Rigging())


def test_wire_faults_are_refused_with_what_they_need() -> None:
    with pytest.raises(FaultError, match=r"injectors\.one\.fault: exo-hil campaign run --realtime cannot do no_ack"):
        check_scenario(parse_scenario(scenario_with(WIRE)), Rigging())


def test_transmit_queues_cannot_be_chosen_on_a_bus() -> None:
    with pytest.raises(BenchError, match=r"rig\.queues: fifo given, exo-hil campaign run --realtime cannot choose"):
        check_scenario(parse_scenario(HUB.text(), overrides=["rig.queues=fifo"]), Rigging())


@pytest.mark.run
@pytest.mark.parametrize("grace_s", [0.0, 0.2])
def test_run_that_walks_on_is_judged_as_if_it_had_ended_at_its_failure(grace_s: float) -> None:
    """stop_early over the bus: what the same run gives in lock-step, where it really ends there."""
    asked = spec("knee_freeze_at", "motion.duration=6s", *LONGER, grace_s=grace_s)
    scenario = parse_scenario(asked.scenario)
    injectors = build_injectors(scenario.injectors, scenario.plan, scenario.seed, 0)
    golden, whole = run_rig(rig_params(scenario), [])[0], run_rig(rig_params(scenario), injectors)[0]
    record = over_bus._ended(whole, asked, scenario, golden)
    assert record.duration_ns < whole.duration_ns == 6 * SECOND
    early = make_run(asked, Workshop())
    assert early.failure_s is not None
    assert early.ended_s is not None
    assert record.duration_ns == pytest.approx((early.failure_s + grace_s) * 1e9, abs=1e6)
    assert 0 <= early.ended_s * 1e9 - record.duration_ns <= LOOK_NS  # which looks for failures now and then
    cut = replace(record, duration_ns=round(early.ended_s * 1e9))
    row = judged(asked, scenario, Pair(golden, "", cut, ""), judge_pair(scenario, golden, cut))
    assert row.outcome is early.outcome is Outcome.FAILURE_SILENT
    assert row.metrics == pytest.approx(early.metrics)
    starts = [[(one.injector, one.start_s) for one in made.injections] for made in (row, early)]
    assert starts[0] == starts[1]
    assert over_bus._ended(whole, replace(asked, stop_on=None), scenario, golden) is whole


def test_campaign_without_our_gateway_is_refused() -> None:
    with pytest.raises(BenchError, match="--without gateway leaves nothing to inject with"):
        check_scenario(parse_scenario(HUB.text()), Rigging(without=frozenset({"gateway"})))


def rows_of(executor: OverBus, specs: Sequence[RunSpec]) -> list[RunRow]:
    rows: list[RunRow] = []
    for one in specs:
        executor.submit(one)
        assert executor.free() == 0
        rows += executor.collect(0.0)
    return rows


def test_run_that_proves_nothing_is_made_three_times_and_then_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Invalid runs are repeated twice, then recorded with their reason."""
    tried: list[Setup] = []

    def never(setup: Setup, **_: object) -> RealTimeRun:
        tried.append(setup)
        raise BenchError("golden run: the drives are away")

    monkeypatch.setattr(over_bus, "run_once", never)
    [row] = rows_of(OverBus(Rigging()), [spec("knee_freeze_at")])
    assert (row.outcome, row.reason, row.attempts) == (Outcome.INVALID, "golden run: the drives are away", 3)
    assert len(tried) == 3


def test_result_folder_that_cannot_be_written_is_no_try_that_proves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends the campaign at once, and no row is recorded."""
    tried: list[Setup] = []

    def full(setup: Setup, **_: object) -> RealTimeRun:
        tried.append(setup)
        raise FolderError("result folder there: cannot be written")

    monkeypatch.setattr(over_bus, "run_once", full)
    with pytest.raises(FolderError, match="cannot be written"):
        rows_of(OverBus(Rigging()), [spec("knee_freeze_at")])
    assert len(tried) == 1


@pytest.mark.parametrize("zero_ns", [NEVER, 5_000_000_000])
def test_injectors_that_are_armed_after_time_0_make_no_row(monkeypatch: pytest.MonkeyPatch, zero_ns: int) -> None:
    """A fault that was due before it was armed never comes: the run would look like one that did not activate."""
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(over_bus, "ask", lambda *words: asked.append(words))
    monkeypatch.setattr(over_bus, "ask_listing", lambda address: Listing(6_000_000_000, zero_ns, False, [], []))
    if zero_ns == NEVER:
        arm("there", ["a", "b"])
    else:
        with pytest.raises(BenchError, match="armed after time 0"):
            arm("there", ["a", "b"])
    assert asked == [("there", "arm", "a"), ("there", "arm", "b")]


def test_words_say_what_the_runs_were_made_on() -> None:
    assert Rigging().words() == "in real time on an own hub"
    there = Rigging(("socketcan:can0", "socketcan:can1"), frozenset({"joints"}))
    assert there.words() == "in real time on socketcan:can0 and socketcan:can1 without joints"


@pytest.mark.realtime
def test_injectors_are_armed_over_live_control_and_act_as_the_scenario_says() -> None:
    """The freeze of 0.3 s begins at 1 s and ends at 1.3 s, by trigger too; the golden run is made once."""
    slow = ("rig.rate=100 Hz", "motion.duration=2s", "injectors.freeze_position.event.time=1s")
    one = spec("knee_freeze_at", *slow)
    executor = OverBus(Rigging())
    rows = rows_of(executor, [one, replace(one, identity="again")])
    assert len({row.golden_hash for row in rows if row.golden_hash}) <= 1
    judged = [row for row in rows if row.outcome is not Outcome.INVALID]
    assert all(row in judged or is_lateness(row.reason.split("; "), 10.0) for row in rows), rows
    if not judged:
        pytest.skip(f"{BUSY}: {rows[0].reason}")
    for row in judged:
        starts = {injection.injector: injection.start_s for injection in row.injections}
        assert starts["freeze_position"] == 1.0
        assert 1.0 <= starts["zero_velocity"] < 1.02
        assert {injection.cause for injection in row.injections} == {"event", "trigger:freeze_position"}
        assert row.metrics["right_knee.rmse_position_rad"] > 0.01
        assert row.manifested > 0


@pytest.mark.realtime
def test_campaign_of_six_runs_on_the_hub(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`campaign run --realtime`: the same file, one run after another, resumed like any other."""
    make_six_runs(HUB, tmp_path, capsys)
