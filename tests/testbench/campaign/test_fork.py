"""A run that starts from a snapshot of its golden run comes out as one that starts at power-up, bit for bit."""

import dataclasses
from enum import Enum
from functools import partial

import pytest
from numpy.random import Generator

from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS
from canopen_exo.bus.trace import trace_hash
from canopen_exo.plan import BusPlan
from fi_gateway.schema import build_injectors
from testbench.campaign.making.early import LOOK_NS
from testbench.campaign.making.execute import Workshop, make_run
from testbench.campaign.making.fork import SNAPSHOT_NS, snapshot_distance
from testbench.campaign.records import Outcome, RunRow, RunSpec
from testbench.rig import RigParams, build_rig
from testbench.run import CHUNK_NS, rig_params
from testbench.scenario import default_joints, parse_scenario
from tests.testbench.campaign.specs import spec

pytestmark = pytest.mark.run

SHORT = "motion.duration=2 s"
KNEE = "bus: to_controller, node: right_knee"
POSITION = f"{{{KNEE}, signal: position}}"
TORQUE = "{bus: to_drives, node: right_knee, signal: target_torque}"
TPDO1 = f"{{{KNEE}, pdo: TPDO1}}"
RPDO1 = "{bus: to_drives, node: right_knee, pdo: RPDO1}"
AT = "{type: at, time: 0.9 s}"
TIME = "{type: constant_time, duration: 60 ms}"


def one(target: str, fault: str, event: str = AT, effect: str = TIME, more: str = "") -> str:
    return f"{{target: {target}, fault: {{{fault}}}, event: {event}, effect: {effect}{more}}}"


FAULTS = {
    "stuck_at": one(POSITION, "type: stuck_at"),
    "stuck_at_value": one(POSITION, "type: stuck_at_value, value: 0 deg"),
    "package_drop": one(POSITION, "type: package_drop, value: 0 deg"),
    "time_delay": one(POSITION, "type: time_delay, lag: 20 ms"),
    "bias": one(POSITION, "type: bias, value: 5 deg"),
    "gain": one(POSITION, "type: gain, factor: 120 %"),
    "drift": one(POSITION, "type: drift, slope: 10 deg/s"),
    "relative_noise": one(POSITION, "type: noise, relative: 20 %"),
    "uniform_noise": one(POSITION, "type: noise, uniform: 2 deg"),
    "normal_noise": one(TORQUE, "type: noise, normal: 5 N m"),
    "bit_flip": one(POSITION, "type: bit_flip, count: 2", effect="{type: once}"),
    "fixed_bit_flip": one(POSITION, "type: bit_flip, positions: [3, 14]"),
    "bit_stuck": one(POSITION, "type: bit_stuck, positions: [10], level: 1"),
    "drop": one(TPDO1, "type: drop, probability: 20 %"),
    "burst_drop": one(RPDO1, "type: drop, p: 5 %, r: 25 %, loss_bad: 90 %"),
    "delay": one(TPDO1, "type: delay, time: 5 ms"),
    "drawn_delay": one(TPDO1, "type: delay, time: 1 ms, law: {type: exponential, mean: 2 ms}, reorder: true"),
    "resequence": one(TPDO1, "type: resequence, span: 4 ms"),
    "duplicate": one(RPDO1, "type: duplicate, copies: 2, gap: 0.5 ms"),
    "replay": one(TPDO1, "type: replay, frames: 20"),
    "insert": one("{bus: to_drives, kind: nmt}", "type: insert, cob_id: 0x000, payload: '02 05', every: 10 ms"),
    "masquerade": one(TPDO1, "type: masquerade, as: 0x182"),
    "corrupt_dlc": one(TPDO1, "type: corrupt_dlc, dlc: 4"),
    "dropped_sync": one("{bus: to_drives, kind: sync}", "type: drop"),
}
EVENTS = {
    "at_time_zero": one(POSITION, "type: bias, value: 2 deg", "{type: at, time: 0 s}"),
    "several_times": one(POSITION, "type: bias, value: 2 deg", "{type: at, times: [1.8 s, 1.2 s, 1.25 s]}"),
    "probability": one(POSITION, "type: stuck_at", "{type: failure_probability, p: 0.001, per: 1 ms}"),
    "per_frame": one(POSITION, "type: stuck_at", "{type: failure_probability, p: 1 %, per: frame}"),
    "rate": one(POSITION, "type: bias, value: 2 deg", "{type: rate, lambda: 1 1/s}"),
    "mttf": one(POSITION, "type: bias, value: 2 deg", "{type: mttf, mean: 1 s, sd: 0.3 s}"),
    "drawn": one(
        POSITION, "type: bias, value: 2 deg", "{type: distribution, law: {type: weibull, shape: 1.5, scale: 1 s}}"
    ),
    "drawn_periods": one(
        POSITION, "type: bias, value: 2 deg", "{type: distribution, law: {type: poisson, mean: 9, period: 100 ms}}"
    ),
    "every": one(POSITION, "type: bias, value: 2 deg", "{type: every, n: 321}", "{type: frames, n: 5}"),
    "gait_phase": one(POSITION, "type: bias, value: 2 deg", "{type: gait_phase, phase: 55 %}"),
    "when": one(POSITION, "type: bias, value: 2 deg", "{type: when, condition: right_knee.position < -40 deg}"),
    "when_level": one(
        POSITION, "type: bias, value: 2 deg", "{type: when, condition: left_hip.position > 20 deg, edge: level}",
        "{type: until, condition: left_hip.position < 15 deg}",
    ),
    "drawn_effect": one(POSITION, "type: bias, value: 2 deg", AT, "{type: mttr, mean: 0.1 s, sd: 0.05 s}"),
    "infinite": one(POSITION, "type: bias, value: 1 deg", AT, "{type: infinite}"),
    "limited": one(
        POSITION, "type: bias, value: 2 deg", "{type: rate, lambda: 5 1/s}", more=", max_activations: 2"
    ),
    "late_power_up": one(POSITION, "type: bias, value: 2 deg", "{type: at, time: 2.5 s}", more=", from: power_up"),
    "after_the_motion": one(POSITION, "type: bias, value: 2 deg", "{type: at, time: 3.67 s}", more=", from: power_up"),
    "not_enabled": one(POSITION, "type: stuck_at", more=", enabled: false"),
    "never": one(POSITION, "type: stuck_at", "{type: never}"),
    "too_late": one(POSITION, "type: stuck_at", "{type: at, time: 5 s}"),
}  # fmt: skip
SOURCE = one(POSITION, "type: stuck_at")
CHAINS = {
    "at_once": f"a: {SOURCE}, b: "
    + one(TORQUE, "type: stuck_at", "{type: never}", more=", trigger: {any: [a], on: activated}"),
    "delayed": f"a: {SOURCE}, b: "
    + one(TORQUE, "type: stuck_at", "{type: never}", more=", trigger: {any: [a], on: ended, delay: 250 ms}"),
    "drawn": f"a: {SOURCE}, b: "
    + one(TORQUE, "type: gain, factor: 2", "{type: never}",
          more=", trigger: {any: [a], on: manifested, delay: 3 ms, probability: 50 %}"),
    "level": f"a: {SOURCE}, b: "
    + one(TORQUE, "type: bias, value: 3 N m", "{type: never}", "{type: frames, n: 2}",
          ", trigger: {any: [a], on: activated, edge: level, delay: 7 ms}, rearm: true"),
    "by_frame": "a: " + one(POSITION, "type: bias, value: 1 deg", "{type: never}",
                            more=", trigger: {frame: {cob_id: 0x705, data: '05'}, delay: 1.2 s, probability: 30 %}"),
    "reported": "a: " + one(POSITION, "type: stuck_at", AT,
                            more=", report: {frame: {cob_id: 0x6F0, data: '01'}, on: activated}"),
    "delay_before_drop": "a: " + one(TPDO1, "type: delay, time: 30 ms") + ", b: "
    + one(TPDO1, "type: drop, probability: 50 %", "{type: at, time: 0.92 s}"),
}  # fmt: skip
ALL = {**{name: f"a: {text}" for name, text in {**FAULTS, **EVENTS}.items()}, **CHAINS}


@pytest.fixture(scope="module")
def workshop() -> Workshop:
    return Workshop()


def timeless(row: RunRow) -> RunRow:
    """The row but for what it took to make it."""
    return dataclasses.replace(row, started="", wall_s=0.0, cpu_s=0.0, forked_s=0.0)


def both(straight: RunSpec, workshop: Workshop) -> tuple[RunRow, RunRow]:
    forked = make_run(dataclasses.replace(straight, fork=True), workshop)
    return make_run(straight, workshop), forked


@pytest.mark.parametrize("name", ALL)
def test_a_row_is_the_same_with_and_without_fork(name: str, workshop: Workshop) -> None:
    """Trace hash, metrics, injections and the rest, for every fault, event and trigger."""
    straight, forked = both(spec("golden", SHORT, f"injectors={{{ALL[name]}}}"), workshop)
    assert timeless(straight) == timeless(forked)
    assert straight.forked_s == 0.0
    assert forked.forked_s >= 1.6, "the start at least was taken over"
    if straight.manifested:
        assert straight.trace_hash != straight.golden_hash


@pytest.mark.parametrize("stops", ["on", "off"])
@pytest.mark.parametrize("seed", [1, 3])
def test_so_is_the_papers_experiment_with_pins_and_without(stops: str, seed: int, workshop: Workshop) -> None:
    """knee_freeze: a frozen angle and a velocity of 0, chained."""
    straight, forked = both(spec("knee_freeze", SHORT, f"rig.stops={stops}", seed=seed), workshop)
    assert timeless(straight) == timeless(forked)


@pytest.mark.parametrize("name", ["probability", "every", "gait_phase", "when_level", "late_power_up", "by_frame"])
def test_the_gateway_of_a_branch_stands_where_that_of_a_straight_run_does(name: str, workshop: Workshop) -> None:
    """Random streams, held values, counters, time 0 and timers, at the instant of the snapshot."""
    scenario = parse_scenario(spec("golden", SHORT, f"injectors={{{ALL[name]}}}", seed=5).scenario)
    params = rig_params(scenario)
    trunk = workshop.golden(params, fork=True)
    make = partial(build_injectors, scenario.injectors, params.plan, scenario.seed, 0)
    snapshot = trunk.before(min(trunk.first_activation(make(), params.plan.cycle_ns), 2000 * MS))
    assert snapshot is not None
    branch, straight = trunk.branch(snapshot, make()), build_rig(params, make())
    straight.loop.run_until(snapshot.now)
    assert state(branch.gateway) == state(straight.gateway)
    assert trace_hash(branch.loop.trace) == trace_hash(straight.loop.trace)
    assert branch.rack.plant.q == straight.rack.plant.q
    assert len(branch.rack.truth) == len(straight.rack.truth)


def state(thing: object) -> object:
    """All that `__reduce__` says, all the way down, as plain values; of a bus its name."""
    if isinstance(thing, Medium):
        return thing.name
    if isinstance(thing, Generator):
        return thing.bit_generator.state
    if isinstance(thing, type):
        return thing.__name__
    if isinstance(thing, list | tuple):
        return [state(one) for one in thing]
    if isinstance(thing, dict):
        return {key: state(value) for key, value in thing.items()}
    if isinstance(thing, int | float | str | bytes | bytearray | Enum) or thing is None:
        return thing
    made = thing.__reduce_ex__(4)
    return [type(thing).__name__, *(state(part) for part in made[1:3])] if not isinstance(made, str) else made


def test_a_fault_that_acts_from_power_up_is_run_straight_and_says_so(workshop: Workshop) -> None:
    """No snapshot lies before its first activation."""
    early = one("{bus: to_controller, kind: heartbeat}", "type: drop", "{type: at, time: 0.1 s}",
                more=", from: power_up")  # fmt: skip
    straight, forked = both(spec("golden", SHORT, f"injectors={{a: {early}}}"), workshop)
    assert forked.manifested > 0
    assert forked.forked_s == 0.0
    assert timeless(straight) == timeless(forked)


def test_faults_of_the_wire_are_run_straight_and_say_so(workshop: Workshop) -> None:
    """They change the bus from power-up on."""
    babble = one("{wire: drive}", "type: babbling_idiot", AT, "{type: constant_time, duration: 30 ms}")
    straight, forked = both(spec("golden", SHORT, f"injectors={{a: {babble}}}"), workshop)
    assert forked.activated == 1
    assert forked.forked_s == 0.0
    assert timeless(straight) == timeless(forked)


def test_a_run_whose_faults_never_activate_costs_no_simulation(
    workshop: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its row is the golden run's."""
    silent = spec("golden", SHORT, f"injectors={{a: {EVENTS['too_late']}}}", fork=True)
    workshop.golden(rig_params(parse_scenario(silent.scenario)), fork=True)

    def refuse(*args: object) -> None:
        raise AssertionError("a rig was built")

    monkeypatch.setattr("testbench.campaign.making.execute.build_rig", refuse)
    monkeypatch.setattr("testbench.campaign.making.fork.build_rig", refuse)
    monkeypatch.setattr("testbench.campaign.making.fork.Trunk.branch", refuse)
    row = make_run(silent, workshop)
    assert row.outcome is Outcome.NOT_ACTIVATED
    assert row.trace_hash == row.golden_hash


def test_a_snapshot_serves_more_than_one_run(workshop: Workshop) -> None:
    """A branch leaves it as it was: the same run again, after another one, is the same."""
    first, other = (spec("knee_freeze_at", f"injectors.freeze_position.event.time={at}", SHORT, fork=True)
                    for at in ("1.1 s", "1.15 s"))  # fmt: skip
    rows = [make_run(one, workshop) for one in (first, other, first)]
    assert timeless(rows[0]) == timeless(rows[2])
    assert rows[0].trace_hash != rows[1].trace_hash


def test_snapshots_and_looks_lie_where_the_loop_pauses() -> None:
    """A branch must end in the same instant as a straight run."""
    assert SNAPSHOT_NS % CHUNK_NS == 0
    assert CHUNK_NS % LOOK_NS == 0
    assert LOOK_NS % MS == 0


@pytest.mark.parametrize(
    ("duration_s", "distance_ms"), [(1, 200), (7, 200), (11, 200), (12, 400), (60, 1000), (3600, 56_400)]
)
def test_the_number_of_snapshots_is_bounded_however_long_the_motion(duration_s: int, distance_ms: int) -> None:
    """They lie further apart then."""
    plan = BusPlan(default_joints())
    params = RigParams(plan, stops=False, stride_ns=1500 * MS, duration_ns=duration_s * 1000 * MS)
    assert snapshot_distance(params) == distance_ms * MS


@pytest.mark.parametrize("grace_s", [0.0, 0.05, 0.2])
def test_a_run_that_failed_ends_after_the_grace_time_forked_or_not(grace_s: float, workshop: Workshop) -> None:
    """ended_s: the first multiple of 10 ms that is the grace time or more after the first failure."""
    straight, forked = both(spec("knee_freeze", SHORT, grace_s=grace_s), workshop)
    whole = make_run(spec("knee_freeze", SHORT, fork=True), workshop)
    assert timeless(straight) == timeless(forked)
    assert straight.failure_s is not None
    assert straight.ended_s is not None
    assert 0 <= straight.ended_s - straight.failure_s - grace_s < 0.01
    assert (straight.outcome, straight.failure_s) == (whole.outcome, whole.failure_s)
    assert whole.ended_s == 2.0
    assert straight.beyond_s <= whole.beyond_s


def test_an_early_stop_changes_nothing_about_a_run_that_does_not_fail(workshop: Workshop) -> None:
    """Neither its frames nor its numbers."""
    inside = ("bit_flip", SHORT, "injectors.flip_position.event.time=1 s")
    whole, watched = (make_run(spec(*inside, fork=True, grace_s=grace), workshop) for grace in (None, 0.0))
    assert whole.failures == 0
    assert timeless(whole) == timeless(watched)


def test_metrics_of_a_shorter_motion_are_those_of_the_whole_run_up_to_then(workshop: Workshop) -> None:
    """Golden and faulted run alike, over [0, ended_s]."""
    early = make_run(spec("knee_freeze", SHORT, fork=True, grace_s=0.1), workshop)
    assert early.ended_s is not None
    shorter = make_run(spec("knee_freeze", f"motion.duration={round(early.ended_s * 1000)} ms"), workshop)
    assert early.metrics == shorter.metrics
    assert early.beyond_deg == shorter.beyond_deg
