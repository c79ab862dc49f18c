"""The original FIBlock, sample by sample: the printed ramps, all 72 combinations, and the odds of its draws."""

import math
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from numpy.random import PCG64, Generator
from scipy import stats

from fi_gateway.errors import FaultError
from fi_gateway.fiblock_compat import EffectType, EventType, FaultType, Levels, Samples, run

ROOT = Path(__file__).parents[2]

FAULTS: tuple[FaultType, ...] = get_args(FaultType)
EVENTS: tuple[EventType, ...] = get_args(EventType)
EFFECTS: tuple[EffectType, ...] = get_args(EffectType)

VALUE: dict[FaultType, float] = {
    "stuck_at": 0.0,
    "package_drop": -7.0,
    "bias": 0.5,
    "bit_flips": 3.0,
    "time_delay": 0.0,
    "noise": 20.0,
}
EVENT_VALUE: dict[EventType, float] = {"failure_probability": 0.05, "mttf": 1.5, "deterministic": 3.0}
EFFECT_VALUE: dict[EffectType, float] = {"once": 0.0, "constant_time": 4.0, "infinite": 0.0, "mttr": 0.3}

CHANCE = 1e-6
"""A statistic that is less likely than this, under the law stated, is taken for wrong. Seeds are fixed."""


def rng(seed: int = 1) -> Generator:
    return Generator(PCG64(seed))


def ramp(n: int) -> tuple[Samples, Samples]:
    """t = k and x = k."""
    return np.arange(n, dtype=np.float64), np.arange(n, dtype=np.float64)


def times(n: int, step_s: float) -> Samples:
    """Samples that far apart, from 0 on."""
    return np.arange(n, dtype=np.float64) * step_s


def levels(*high: int, n: int) -> Levels:
    """A trigger that is high at those samples."""
    found = np.zeros(n, np.bool_)
    found[list(high)] = True
    return found


def at_3(fault: FaultType, effect: EffectType, samples: float = 0.0, value: float = 0.0, n: int = 11) -> list[float]:
    """What a block puts out whose event is sample 3 of the ramp."""
    t, x = ramp(n)
    return [float(one) for one in run(fault, value, "deterministic", 3.0, effect, samples, t, x, None, rng())[0]]


# --- the ramp x = k, activation at sample 3, written by hand ----------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "effect", "samples", "value", "out"),
    [
        ("stuck_at", "once", 0, 0, [0, 1, 2, 3, 3, 5, 6, 7, 8, 9, 10]),
        ("stuck_at", "constant_time", 1, 0, [0, 1, 2, 3, 3, 5, 6, 7, 8, 9, 10]),
        ("stuck_at", "constant_time", 3, 0, [0, 1, 2, 3, 3, 3, 3, 7, 8, 9, 10]),
        ("stuck_at", "infinite", 0, 0, [0, 1, 2, 3, 3, 3, 3, 3, 3, 3, 3]),
        ("time_delay", "once", 0, 0, [0, 1, 2, 3, 3, 5, 6, 7, 8, 9, 10]),
        ("time_delay", "constant_time", 2, 0, [0, 1, 2, 3, 3, 3, 5, 6, 7, 8, 9]),
        ("time_delay", "constant_time", 3, 0, [0, 1, 2, 3, 3, 3, 3, 5, 6, 7, 8]),
        ("time_delay", "infinite", 0, 0, [0, 1, 2, 3, 3, 3, 3, 3, 3, 3, 3]),
        ("package_drop", "once", 0, -1, [0, 1, 2, -1, -1, 5, 6, 7, 8, 9, 10]),
        ("package_drop", "constant_time", 3, 0, [0, 1, 2, 0, 0, 0, 0, 7, 8, 9, 10]),
        ("bias", "constant_time", 2, 100, [0, 1, 2, 103, 104, 105, 6, 7, 8, 9, 10]),
        ("bias", "infinite", 0, -0.5, [0, 1, 2, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, 9.5]),
    ],
)
def test_ramp(fault: FaultType, effect: EffectType, samples: float, value: float, out: list[float]) -> None:
    """The first, third and seventh are as described; the others follow from the same count of samples."""
    assert at_3(fault, effect, samples, value) == out


def test_lags_of_time_delays_add_up() -> None:
    """Two of 3 samples each, at 3 and at 10: a lag of 2, then of 4; the second holds the value that was put out."""
    t, x = ramp(18)
    y, flag = run("time_delay", 0, "deterministic", -1, "constant_time", 3, t, x, levels(3, 10, n=18), rng())
    assert y.tolist() == [0, 1, 2, 3, 3, 3, 3, 5, 6, 7, 8, 8, 8, 8, 10, 11, 12, 13]
    assert np.flatnonzero(flag).tolist() == [3, 4, 5, 6, 10, 11, 12, 13]


def test_fault_acts_from_the_first_sample_when_it_is_due_there() -> None:
    """There is no sample before it that could be held."""
    t, x = ramp(5)
    for fault in ("stuck_at", "time_delay"):
        y, _ = run(fault, 0, "deterministic", 0.0, "once", 0, t, x + 4, None, rng())
        assert y.tolist() == [4, 4, 6, 7, 8]


# --- trigger, event, expiry -------------------------------------------------------------------------------------------


def test_expiry_sample_is_clean_and_the_event_is_tested_from_the_next_one() -> None:
    """With p = 1 the event is there whenever it is tested: one clean sample between two faults of n + 1."""
    t, x = ramp(12)
    _, flag = run("bias", 1, "failure_probability", 1.0, "constant_time", 2, t, x, None, rng())
    assert flag.tolist() == [True, True, True, False] * 3


def test_trigger_is_a_level_and_fires_again_after_one_clean_sample() -> None:
    """The second block's time is shorter than the first one's: it stops, is clean once, and starts again."""
    t, x = ramp(12)
    _, first = run("stuck_at", 0, "deterministic", 3.0, "constant_time", 5, t, x, None, rng())
    y, second = run("package_drop", 0, "failure_probability", 0.0, "constant_time", 2, t, x, first, rng())
    assert np.flatnonzero(first).tolist() == [3, 4, 5, 6, 7, 8]
    assert np.flatnonzero(second).tolist() == [3, 4, 5, 7, 8, 9]
    assert y.tolist() == [0, 1, 2, 0, 0, 0, 6, 0, 0, 0, 10, 11]


def test_trigger_while_active_changes_nothing_and_trigger_or_event_starts() -> None:
    """OR: the trigger at 1 and the event at 6 each start a fault; the trigger at 2 meets an active one."""
    t, x = ramp(10)
    _, flag = run("bias", 1, "deterministic", 6.0, "constant_time", 2, t, x, levels(1, 2, n=10), rng())
    assert np.flatnonzero(flag).tolist() == [1, 2, 3, 6, 7, 8]


def test_event_inside_an_active_fault_is_not_tested() -> None:
    """A deterministic time within the fault, or at its clean sample, is gone."""
    t, x = ramp(10)
    for time_s in (2.0, 4.0):
        _, flag = run("bias", 1, "deterministic", time_s, "constant_time", 2, t, x, levels(1, n=10), rng())
        assert np.flatnonzero(flag).tolist() == [1, 2, 3]


def test_once_is_once_a_run() -> None:
    """Neither a trigger nor an event that always holds starts it again."""
    t, x = ramp(10)
    _, flag = run("bias", 1, "failure_probability", 1.0, "once", 0, t, x, levels(*range(10), n=10), rng())
    assert np.flatnonzero(flag).tolist() == [0, 1]


def test_deterministic_time_must_equal_a_sample_time() -> None:
    """0.3 s is no sample of k x 0.1 s: 3 x 0.1 is the double after 0.3."""
    t = times(10, 0.1)
    x = np.arange(10, dtype=np.float64)
    y, flag = run("bias", 1, "deterministic", 0.3, "infinite", 0, t, x, None, rng())
    assert not flag.any()
    assert np.array_equal(y, x)
    _, flag = run("bias", 1, "deterministic", 3 * 0.1, "infinite", 0, t, x, None, rng())
    assert np.flatnonzero(flag)[0] == 3


# --- all combinations -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("effect", EFFECTS)
def test_every_combination_acts_where_its_flag_says_and_nowhere_else(
    fault: FaultType, event: EventType, effect: EffectType
) -> None:
    """72 combinations: shapes, input untouched, the same twice, the same windows for all faults; exact outside."""
    t = times(2000, 0.005)
    x = 1.0 + np.sin(t) ** 2
    before = x.copy()
    value = VALUE[fault]
    event_value = 3.005 if event == "deterministic" else EVENT_VALUE[event]
    trigger = levels(300, 1700, n=t.size)
    y, flag = run(fault, value, event, event_value, effect, EFFECT_VALUE[effect], t, x, trigger, rng(5))
    again, _ = run(fault, value, event, event_value, effect, EFFECT_VALUE[effect], t, x, trigger, rng(5))
    _, same = run("bias", 1, event, event_value, effect, EFFECT_VALUE[effect], t, x, trigger, rng(5))
    assert y.shape == flag.shape == t.shape
    assert (str(y.dtype), str(flag.dtype)) == ("float64", "bool")
    assert np.array_equal(x, before)
    assert np.array_equal(y, again)
    assert np.array_equal(flag, same)
    assert flag.any()
    assert not flag.all()
    if fault == "time_delay":
        first = int(np.flatnonzero(flag)[0])
        assert np.array_equal(y[: first + 1], x[: first + 1])
        assert set(y) <= set(x)
    else:
        assert np.array_equal(y[~flag], x[~flag])
        assert (y[flag] != x[flag]).any()


# --- values -----------------------------------------------------------------------------------------------------------


def test_bit_flips_reach_the_32_low_mantissa_bits_only() -> None:
    """Each of the 32 bits in turn, none above: a double never moves by more than 2^-20 of its binade."""
    t = np.arange(4000, dtype=np.float64)
    x = np.linspace(1.0, 1.9, t.size)
    y, flag = run("bit_flips", 1, "deterministic", 0.0, "infinite", 0, t, x, None, rng())
    assert flag.all()
    changed = y.view(np.uint64) ^ x.view(np.uint64)
    assert int(np.bitwise_or.reduce(changed)) == 2**32 - 1
    assert np.array_equal(np.bitwise_count(changed), np.ones(t.size))
    assert float(np.max(np.abs(y - x))) < 2.0**-20


def test_bit_flips_draw_with_replacement() -> None:
    """Two draws meet on one bit, and cancel, once in 32: the value then comes out right."""
    t = np.arange(20_000, dtype=np.float64)
    x = np.full(t.size, math.pi)
    y, _ = run("bit_flips", 2, "deterministic", 0.0, "infinite", 0, t, x, None, rng())
    unchanged = int(np.count_nonzero(y == x))
    assert stats.binomtest(unchanged, t.size, 1 / 32).pvalue > CHANCE


def test_noise_is_uniform_in_percent_of_the_value() -> None:
    """y = x (1 + U(-b, b)): 0 stays 0, the sign does not matter; within the bound, and uniform."""
    t = np.arange(5000, dtype=np.float64)
    x = np.linspace(-50.0, 50.0, t.size)
    x[2500] = 0.0
    y, _ = run("noise", 20, "deterministic", 0.0, "infinite", 0, t, x, None, rng())
    assert y[2500] == 0.0
    share = np.delete(y, 2500) / np.delete(x, 2500) - 1.0
    assert float(np.max(np.abs(share))) <= 0.2 * (1 + 1e-12)  # the rounding of one product and one quotient
    assert stats.kstest(share, stats.uniform(-0.2, 0.4).cdf).pvalue > CHANCE


# --- odds -------------------------------------------------------------------------------------------------------------


def starts(flag: Levels) -> int:
    return int(np.count_nonzero(np.diff(np.concatenate(([False], flag)).astype(np.int8)) == 1))


def test_failure_probability_is_per_sample_tested() -> None:
    """rand > 1 - p wherever the fault is inactive and not just expiring; so the rate hangs on the sample time."""
    p, n = 0.02, 3
    t, x = ramp(50_000)
    _, flag = run("bias", 1, "failure_probability", p, "constant_time", n, t, x, None, rng())
    begun = starts(flag)
    tested = t.size - begun * (n + 1)  # n more active samples and the clean one do not test
    assert stats.binomtest(begun, tested, p).pvalue > CHANCE
    assert not run("bias", 1, "failure_probability", 0.0, "infinite", 0, t, x, None, rng())[1].any()


def test_mttr_of_03_s_gives_38_percent_of_faults_without_length() -> None:
    """Phi(-0.3) = 38.2 % of the repair times are below 0, and such a fault acts on no sample."""
    n = 5000
    t, x = ramp(3)
    empty = 0
    generator = rng()
    for _ in range(n):
        _, flag = run("bias", 1, "deterministic", 0.0, "mttr", 0.3, t, x, None, generator)
        empty += not flag.any()
    share = float(stats.norm.cdf(-0.3))
    assert round(100 * share) == 38
    assert stats.binomtest(empty, n, share).pvalue > CHANCE


@pytest.mark.long
def test_repair_times_are_normal_with_a_sigma_of_1_s() -> None:
    """Of the faults that act, the number of samples follows from N(MTTR, 1 s), at whatever sample time."""
    n, mean_s, step_s = 3000, 5.0, 0.01
    t = times(1200, step_s)
    generator = rng()
    lengths = []
    for _ in range(n):
        _, flag = run("bias", 1, "deterministic", 0.0, "mttr", mean_s, t, t, None, generator)
        lengths.append(np.count_nonzero(flag) * step_s)
    middle = np.array(lengths) - step_s / 2  # the length is the drawn time rounded up to whole samples
    assert abs(np.mean(middle) - mean_s) < 5 / math.sqrt(n)
    assert abs(np.std(middle) - 1.0) < 5 / math.sqrt(2 * n)


@pytest.mark.long
def test_failure_times_are_normal_count_from_the_last_expiry_and_are_not_truncated() -> None:
    """N(MTTF, 1 s) to the first activation and again from each expiry; one below 0 comes at once."""
    n, mean_s, step_s = 1500, 1.0, 0.01
    t = times(1500, step_s)
    generator = rng()
    first, second = [], []
    for _ in range(n):
        _, flag = run("bias", 1, "mttf", mean_s, "constant_time", 1, t, t, None, generator)
        at = np.flatnonzero(flag)
        first.append(at[0] * step_s)
        second.append((at[2] - at[1] - 1) * step_s)  # from the clean sample after the first fault
    for gaps, least in ((np.array(first), 0.0), (np.array(second), step_s)):
        at_once = int(np.count_nonzero(gaps < least + step_s / 2))
        assert stats.binomtest(at_once, n, float(stats.norm.cdf(least, mean_s, 1.0))).pvalue > CHANCE
        median = float(np.median(gaps))
        assert abs(median - mean_s) < 5 * math.sqrt(math.pi / (2 * n)) + step_s


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fault": "drift"}, "fault 'drift' given, allowed are stuck_at"),
        ({"event": "at"}, "event 'at' given"),
        ({"effect": "until"}, "effect 'until' given"),
        ({"value": math.nan}, "value nan"),
        ({"fault": "noise", "value": -1.0}, "bound -1.0 %"),
        ({"fault": "bit_flips", "value": 0.0}, "0.0 bits"),
        ({"fault": "bit_flips", "value": 1.5}, "1.5 bits"),
        ({"event": "failure_probability", "event_value": 1.5}, "p 1.5"),
        ({"event_value": math.inf}, "event_value inf"),
        ({"effect": "constant_time", "effect_value": 0.3}, "0.3 samples given, .* divide a time by the sample time"),
        ({"effect": "constant_time", "effect_value": 0.0}, "0.0 samples"),
        ({"effect": "mttr", "effect_value": math.nan}, "mean nan s"),
        ({"t": np.zeros(5)}, "rising"),
        ({"t": np.zeros((5, 1))}, "t must be"),
        ({"x": np.zeros(4)}, r"x of shape \(4,\)"),
        ({"x": np.zeros(5, np.float32)}, "float32"),
        ({"trigger": np.zeros(4, np.bool_)}, r"trigger of shape \(4,\)"),
        ({"trigger": np.zeros(5)}, "float64 given, allowed is .* bool"),
    ],
)
def test_what_has_no_meaning_is_refused(change: dict[str, object], words: str) -> None:
    """Programming errors raise, with what was given and what is allowed."""
    t, x = ramp(5)
    given: dict[str, object] = {
        "fault": "bias",
        "value": 1.0,
        "event": "deterministic",
        "event_value": 3.0,
        "effect": "infinite",
        "effect_value": 0.0,
        "t": t,
        "x": x,
        "trigger": None,
        "rng": rng(),
    }
    with pytest.raises(FaultError, match=words):
        run(**{**given, **change})  # type: ignore[arg-type]


def test_the_example_of_the_docs_prints_what_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    """docs/fiblock.md: the block of code runs, and prints the block of text after it."""
    text = (ROOT / "docs" / "fiblock.md").read_text(encoding="utf-8")
    (code, shown), *more = re.findall(r"```python\n(.*?)```\n+```text\n(.*?)```", text, re.DOTALL)
    assert not more
    exec(compile(code, "docs/fiblock.md", "exec"), {})
    assert capsys.readouterr().out == shown
