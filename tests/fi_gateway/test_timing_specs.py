"""What is said of events and effects: the number of activations against renewal theory, and every sentence."""

from math import exp
from typing import Any, Final

import pytest
from scipy import stats

from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import dump, json_schema, validate
from fi_gateway.errors import FaultError
from fi_gateway.marked_yaml import Document, parse
from fi_gateway.schema import InjectorSpec
from fi_gateway.target import resolve
from fi_gateway.timing_specs import Timing, frame_distance

NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))
SECOND: Final = 1_000_000_000
MOTION: Final = 7 * SECOND
TARGET: Final = "{bus: to_controller, node: right_knee, signal: position}"
SAMPLES: Final = (0x185,)


def injector(event: str, effect: str = "{type: constant_time, duration: 0.3 s}", target: str = TARGET) -> InjectorSpec:
    document = parse(f"target: {target}\nfault: {{type: stuck_at}}\nevent: {event}\neffect: {effect}\n", "s.yaml")
    spec = validate(InjectorSpec, document.data, (), document)
    document.raise_problems()
    assert spec is not None
    return spec


def timing(event: str, effect: str = "{type: constant_time, duration: 0.3 s}", **more: Any) -> Timing:
    spec = injector(event, effect)
    return Timing(spec.event, spec.effect, **more)


def expected_of_trials(p: float, period_s: float, length_s: float) -> float:
    """Geometric gaps with a dead time of whole periods: sum over k of P(k successes in the trials left for them)."""
    trials, dead = round(7 / period_s) - 1, round(length_s / period_s)
    return float(sum(stats.binom.sf(k, trials - k * dead, p) for k in range(trials // dead + 1)))


def expected_of_rate(rate: float, length_s: float) -> float:
    """Exponential gaps with a dead time: sum over k of P(gamma(k) <= time left for k gaps)."""
    return float(sum(stats.gamma.cdf(7 - k * length_s, k + 1, scale=1 / rate) for k in range(int(7 / length_s) + 1)))


@pytest.mark.parametrize(
    ("event", "effect", "activations"),
    [
        ("{type: failure_probability, p: 0.0005, per: 1 ms}", "{type: constant_time, duration: 0.3 s}",
         expected_of_trials(0.0005, 1e-3, 0.3)),
        ("{type: failure_probability, p: 0.01, per: sync}", "{type: constant_time, duration: 1 s}",
         expected_of_trials(0.01, 2e-3, 1)),
        ("{type: rate, lambda: 0.5/s}", "{type: constant_time, duration: 0.3 s}", expected_of_rate(0.5, 0.3)),
        ("{type: rate, lambda: 40/s}", "{type: constant_time, duration: 1 s}", expected_of_rate(40, 1)),
        ("{type: distribution, law: {type: exponential, mean: 2 s}}", "{type: constant_time, duration: 0.3 s}",
         expected_of_rate(0.5, 0.3)),
        ("{type: distribution, law: {type: exponential, mean: 1 s}}",
         "{type: distribution, law: {type: exponential, mean: 1 s}}", 3.5 + (1 - exp(-14)) / 4),
        ("{type: mttf, mean: 2 s, sd: 1 ms}", "{type: constant_time, duration: 0.3 s}", 3),
        ("{type: distribution, law: {type: binomial, n: 1, p: 1, period: 1 s}}",
         "{type: distribution, law: {type: binomial, n: 1, p: 1, period: 1 s}}", 3),  # at 1, 3 and 5 s
        ("{type: every, n: 100}", "{type: constant_time, duration: 0.3 s}", 18),  # at 0.2, 0.6 .. 7 s, the 3500th frame
        ("{type: every, n: 100}", "{type: frames, n: 100}", 35),
        ("{type: failure_probability, p: 1, per: frame}", "{type: constant_time, duration: 3 ms}", 1750),
    ],
)  # fmt: skip
def test_the_number_of_activations_is_that_of_renewal_theory(event: str, effect: str, activations: float) -> None:
    """Dead time and end of motion included: closed forms, within 4 % (4 standard errors of 10000 activations).

    An alternating process of two exponentials with mean 1 s starts t/2 + (1 - exp(-2 t)) / 4 times in t seconds.
    """
    found = timing(event, effect).forecast(PLAN, SAMPLES, MOTION)
    assert found is not None
    assert found.activations == pytest.approx(activations, rel=0.04)


@pytest.mark.parametrize(
    ("event", "share"),
    [
        ("{type: failure_probability, p: 0.0001, per: 1 ms}", 1 - 0.9999**6999),
        ("{type: failure_probability, p: 0.0001, per: frame}", 1 - 0.9999**3500),
        ("{type: rate, lambda: 2 1/min}", 1 - exp(-7 / 30)),
        ("{type: distribution, law: {type: weibull, shape: 2, scale: 10 s}}", 1 - exp(-0.49)),
    ],
)
@pytest.mark.parametrize("effect", ["{type: once}", "{type: infinite}"])
def test_what_comes_once_a_run_comes_in_a_share_of_the_runs(event: str, share: float, effect: str) -> None:
    """Four standard errors of a share of 10000 motions or more."""
    found = timing(event, effect).forecast(PLAN, SAMPLES, MOTION)
    assert found is not None
    assert found.activations == found.share == pytest.approx(share, abs=4 * 0.5 / 100)


def test_rearm_and_max_activations_override_the_effect() -> None:
    """Spent after the first, or after so many; or armed again."""
    event, constant = "{type: every, n: 100}", "{type: constant_time, duration: 1 ms}"
    for more, count in (({}, 35), ({"rearm": False}, 1), ({"max_activations": 3}, 3), ({"max_activations": 99}, 35)):
        found = timing(event, constant, **more).forecast(PLAN, SAMPLES, MOTION)
        assert found is not None
        assert found.activations == count
    found = timing(event, "{type: once}", rearm=True).forecast(PLAN, SAMPLES, MOTION)
    assert found is not None
    assert found.activations == 35


@pytest.mark.parametrize(
    ("phase", "effect", "activations"),
    [
        ("0", "{type: frames, n: 1}", 5),  # at 0, 1.5, 3, 4.5 and 6 s
        ("66 %", "{type: frames, n: 1}", 5),  # at 0.99 .. 6.99 s
        ("67 %", "{type: frames, n: 1}", 4),  # at 1.004, then up to 5.504 s
        ("66 %", "{type: constant_time, duration: 1.5 s}", 5),
        ("66 %", "{type: constant_time, duration: 1.51 s}", 3),
        ("99.99 %", "{type: frames, n: 1}", 5),  # the nearest control cycle is the first of the next stride
        ("30 %", "{type: once}", 1),
    ],
)
def test_a_phase_of_the_gait_comes_once_a_stride(phase: str, effect: str, activations: int) -> None:
    """From time 0 on, which is phase 0, with a stride of 1.5 s; not known without one."""
    event = f"{{type: gait_phase, phase: {phase}}}"
    found = timing(event, effect, stride_ns=3 * SECOND // 2).forecast(PLAN, SAMPLES, MOTION)
    assert found is not None
    assert found.activations == activations
    assert timing(event, effect).forecast(PLAN, SAMPLES, MOTION) is None


def test_a_very_high_rate_is_reckoned_on() -> None:
    """Not played to its end: as it began."""
    found = timing("{type: rate, lambda: 1e6 1/s}", "{type: constant_time, duration: 1 us}").forecast(
        PLAN, SAMPLES, MOTION
    )
    assert found is not None
    assert found.activations == pytest.approx(3.5e6, rel=0.05)


@pytest.mark.parametrize(
    ("cob_ids", "distance_ns"),
    [((0x185,), 2_000_000), ((0x285,), 20_000_000), ((0x80,), 2_000_000), ((0x2FF,), 20_000_000),
     ((0x705,), 100_000_000), ((0x181, 0x182), 1_000_000), ((0x585,), 0), ((0x123,), 0), ((0x123, 0x185), 2_000_000)],
)  # fmt: skip
def test_frames_come_as_often_as_the_plan_says(cob_ids: tuple[int, ...], distance_ns: int) -> None:
    """500 Hz: TPDO1 every cycle, TPDO2 and status every tenth, heartbeats every 100 ms; SDO only on demand."""
    assert frame_distance(PLAN, cob_ids) == distance_ns


PER_FRAME: Final = "{type: failure_probability, p: 1 %, per: frame}"


@pytest.mark.parametrize(
    ("event", "effect", "words"),
    [
        ("{type: at, time: 3 s}", "{type: once}", "in one frame, once a run | at 3 s"),
        ("{type: failure_probability, p: 0, per: 1 ms}", "{type: once}",
         "in one frame, once a run | with probability 0 per 1 ms (0/s): never"),
        (PER_FRAME, "{type: frames, n: 1}", "in 1 frame | with probability 0.01 per frame, about 35 activations of x "
         "expected in 7 s, dead time included"),
        ("{type: rate, lambda: 6/h}", "{type: frames, n: 5}", "in 5 frames | at a rate of 0.00166667/s, activated "
         "in 1 % of the runs of 7 s"),
        ("{type: mttf, mean: 1 h, sd: 60 s}", "{type: mttr, mean: 0.3 s, sd: 1 s}",
         "until repaired (mean 0.3 s, sd 1 s) | after a time to failure (mean 3600 s, sd 60 s), activated in fewer "
         "than 1 % of the runs of 7 s"),
        ("{type: distribution, law: {type: gamma, shape: 2, scale: 9 ms}}",
         "{type: distribution, law: {type: normal, mean: 3 s, sd: 0 s}}",
         "for a drawn time: normal, above 0 (mean 3 s, sd 0 s) | after a drawn time: gamma (shape 2, scale 9 ms), "
         "about 3.0 activations of x expected in 7 s, dead time included"),
        ("{type: distribution, law: {type: poisson, mean: 2.5, period: 1 ms}}",
         "{type: distribution, law: {type: binomial, n: 3, p: 1, period: 4 s}}",
         "for a drawn time: binomial (n 3, p 1, periods of 4 s) | after a drawn time: poisson (mean 2.5 periods of 1 "
         "ms), activated in 100 % of the runs of 7 s"),
        ("{type: distribution, law: {type: curve, points: [[0 s, 0], [2 s, 3]]}}", "{type: once}",
         "in one frame, once a run | after a drawn time: curve (2 points, 0 s to 2 s), activated in 100 % of the "
         "runs of 7 s"),
        ("{type: distribution, law: {type: two_weibull, share: 0.2, first: {shape: 0.5, scale: 1 ms}, "
         "second: {shape: 3, scale: 2 ms}}}", "{type: once}",
         "in one frame, once a run | after a drawn time: two_weibull (20 %: shape 0.5, scale 1 ms; else: shape 3, "
         "scale 2 ms), activated in 100 % of the runs of 7 s"),
        ("{type: every, n: 100}", "{type: until, condition: right_knee.position > 1 deg}",
         "until right_knee.position > 1 deg | with every 100. frame, activated in 100 % of the runs of 7 s"),
        ("{type: gait_phase, phase: 30 %}", "{type: infinite}", "until the end of the run | at 30 % of every stride"),
        ("{type: when, condition:   right_knee.position  <  -60 deg }", "{type: infinite}",
         "until the end of the run | whenever right_knee.position < -60 deg"),
        ("{type: when, condition: right_knee.position < -60 deg, edge: level}", "{type: infinite}",
         "until the end of the run | while right_knee.position < -60 deg"),
        ("{type: never}", "{type: infinite}", "until the end of the run | "),
    ],
)  # fmt: skip
def test_every_event_and_effect_can_be_read_aloud(event: str, effect: str, words: str) -> None:
    """How long, when, how often."""
    spec = injector(event, effect)
    place = resolve(spec.target, PLAN)
    assert f"{spec.effect.words()} | {spec.timing().words('x', place, PLAN, MOTION)}" == words


@pytest.mark.parametrize(
    "event",
    [
        "{type: at, times: [1 s, 2 s]}",
        PER_FRAME,
        "{type: rate, lambda: 0.1/min}",
        "{type: mttf, mean: 2 s, sd: 0.5 s}",
        "{type: distribution, law: {type: weibull, shape: 0.5, scale: 1 ms}}",
        "{type: distribution, law: {type: binomial, n: 5, p: 20 %, period: 1 ms}}",
        "{type: distribution, law: {type: two_weibull, share: 0.2, first: {shape: 1, scale: 1 s}, second: {shape: 2, "
        "scale: 2 s}}}",
        "{type: distribution, law: {type: curve, points: [[0 s, 0], [2 ms, 3.5]]}}",
        "{type: every, n: 3}",
        "{type: gait_phase, phase: 30 %}",
        "{type: when, condition: right_knee.position < -60 deg or (left_knee.velocity > 1 rpm), edge: level}",
    ],
)
@pytest.mark.parametrize(
    "effect",
    [
        "{type: frames, n: 3}",
        "{type: mttr, mean: 1 ms, sd: 0 s}",
        "{type: until, condition: left_hip.statusword & 0x6F != 0x27}",
        "{type: distribution, law: {type: poisson, mean: 3, period: 2 ms}}",
    ],
)
def test_what_is_written_into_the_result_folder_reads_back(event: str, effect: str) -> None:
    """scenario.yaml as run: dump and validate are inverse."""
    spec = injector(event, effect)
    assert validate(InjectorSpec, dump(InjectorSpec, spec), (), Document("again")) == spec


def test_editors_are_told_of_every_event_and_effect() -> None:
    """JSON Schema can be made of it."""
    text = str(json_schema(InjectorSpec))
    words = ("gait_phase", "two_weibull", "mttr", "until", "binomial", "lambda", "curve", "mttf", "every")
    assert all(f"'{word}'" in text for word in words)


def test_a_condition_that_does_not_fit_the_rig_stops_the_building() -> None:
    """What was never checked is refused."""
    spec = injector("{type: when, condition: neck.position < 1 deg}")
    with pytest.raises(FaultError, match="unknown joint or message 'neck'"):
        spec.timing().warnings(resolve(spec.target, PLAN), PLAN, MOTION)
