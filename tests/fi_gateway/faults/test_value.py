"""Computed values: against closed forms, and the noise against scipy."""

from typing import Protocol

import pytest
from scipy import stats

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import SECOND
from canopen_exo.signal import Signal
from fi_gateway.errors import FaultError
from fi_gateway.faults import Bias, Drift, Fault, Gain, NoiseFault, NormalNoise, RelativeNoise, UniformNoise
from tests.fi_gateway.faults.bench import ODD, OUT, POSITION, WORD, begun, word


class Distribution(Protocol):
    """What of scipy is used here."""

    def cdf(self, value: float) -> float: ...


@pytest.mark.parametrize(
    ("signal", "value", "offset", "out", "saturated"),
    [
        (POSITION, 5, 7, 12, 0),
        (POSITION, 2**31 - 3, 2, 2**31 - 1, 0),
        (POSITION, 2**31 - 3, 3, 2**31 - 1, 1),
        (POSITION, -(2**31) + 3, -3, -(2**31), 0),
        (POSITION, -(2**31) + 3, -4, -(2**31), 1),
        (POSITION, 0, 2**40, 2**31 - 1, 1),
        (WORD, 65534, 1, 65535, 0),
        (WORD, 65535, 1, 65535, 1),
        (WORD, 1, -1, 0, 0),
        (WORD, 1, -2, 0, 1),
        (ODD, 1023, 1, 1023, 1),
        (ODD, -1024, -1, -1024, 1),
        (ODD, -1, 2, 1, 0),
    ],
)
def test_bias_adds_and_saturates_at_the_range(
    signal: Signal, value: int, offset: int, out: int, saturated: int
) -> None:
    """faults.md: value + bias; values that no longer fit saturate, nothing wraps."""
    fault = begun(Bias(signal, offset))
    frame = Frame(signal.cob_id, signal.write(b"\xa5" * 8, value))
    result = fault.apply(0, frame, OUT)
    assert result is not None
    assert signal.read(result.data) == out
    mask = ((1 << signal.length) - 1) << signal.start
    assert word(result) & ~mask == word(frame) & ~mask
    assert fault.saturated == saturated


def test_saturation_is_counted_per_activation() -> None:
    """faults.md: they say so; the count starts anew with each activation."""
    fault = begun(Bias(WORD, 1))
    for _ in range(3):
        fault.apply(0, Frame(0x285, b"\xff\xff"), OUT)
    assert fault.saturated == 3
    begun(fault)
    assert fault.saturated == 0


def through(fault: Fault, signal: Signal, value: int, now: int = 0) -> int:
    """The value that comes out; the other bits must not change."""
    frame = Frame(signal.cob_id, signal.write(b"\xa5" * 8, value))
    result = fault.apply(now, frame, OUT)
    assert result is not None
    mask = ((1 << signal.length) - 1) << signal.start
    assert word(result) & ~mask == word(frame) & ~mask
    return signal.read(result.data)


@pytest.mark.parametrize(
    ("signal", "factor", "value", "out", "saturated"),
    [
        (POSITION, 1.5, 4, 6, 0),
        (POSITION, 1.5, 3, 5, 0),
        (POSITION, 1.5, -3, -4, 0),
        (POSITION, -1.0, 1000, -1000, 0),
        (POSITION, 0.0, 1000, 0, 0),
        (POSITION, 1.0, -(2**31), -(2**31), 0),
        (POSITION, -1.0, -(2**31), 2**31 - 1, 1),
        (POSITION, 2.0, 2**30 - 1, 2**31 - 2, 0),
        (POSITION, 2.0, 2**30, 2**31 - 1, 1),
        (POSITION, 1e20, -1, -(2**31), 1),
        (WORD, 2.0, 32767, 65534, 0),
        (WORD, 2.0, 32768, 65535, 1),
        (WORD, -1.0, 1, 0, 1),
        (ODD, 1.1, 930, 1023, 0),
        (ODD, 1.1, 931, 1023, 1),
    ],
)
def test_gain_multiplies_rounds_and_saturates(
    signal: Signal, factor: float, value: int, out: int, saturated: int
) -> None:
    """faults.md: value x gain, to the nearest whole raw value (a half upwards); nothing wraps."""
    fault = begun(Gain(signal, factor))
    assert (through(fault, signal, value), fault.saturated) == (out, saturated)


@pytest.mark.parametrize(
    ("slope", "after_ns", "out"),
    [
        (1000.0, 0, 5),
        (1000.0, 499_999, 5),
        (1000.0, 500_000, 6),
        (1000.0, SECOND, 1005),
        (-1000.0, SECOND, -995),
        (0.25, 2 * SECOND, 6),
        (0.25, 2 * SECOND - 1, 5),
        (1e20, SECOND, 2**31 - 1),
    ],
)
def test_drift_adds_slope_times_the_time_since_activation(slope: float, after_ns: int, out: int) -> None:
    """faults.md: value + slope x time since activation, to the nearest whole raw value."""
    start_ns = 3 * SECOND
    fault = begun(Drift(POSITION, slope), now=start_ns)
    assert through(fault, POSITION, 5, start_ns + after_ns) == out


def test_drift_begins_anew_with_each_activation() -> None:
    """The time counts from the start of the window."""
    fault = begun(Drift(POSITION, 1000.0), now=0)
    assert through(fault, POSITION, 0, SECOND) == 1000
    fault.end()
    begun(fault, now=2 * SECOND)
    assert through(fault, POSITION, 0, 2 * SECOND) == 0


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e21])
@pytest.mark.parametrize("make", [Gain, Drift, RelativeNoise, UniformNoise, NormalNoise])
def test_what_is_no_useful_number_is_refused(make: type[Gain | Drift | NoiseFault], value: float) -> None:
    """Bad parameters are refused where they are made."""
    with pytest.raises(FaultError, match=r"given, allowed"):
        make(POSITION, value)


def errors(fault: Fault, value: int, number: int) -> list[int]:
    """What the noise adds to a value, frame by frame."""
    return [through(fault, POSITION, value) - value for _ in range(number)]


NOISES: list[tuple[str, type[NoiseFault], float, int, Distribution, Distribution]] = [
    ("relative", RelativeNoise, 0.2, -5_000_000, stats.uniform(-1e6, 2e6), stats.uniform(-1.1e6, 2.2e6)),
    ("uniform", UniformNoise, 1e6, 123, stats.uniform(-1e6, 2e6), stats.norm(0, 1e6 / 3**0.5)),
    ("normal", NormalNoise, 1e6, 123, stats.norm(0, 1e6), stats.norm(0, 1.1e6)),
]
"""Name, class, amount, value, the law of the error (raw units, so wide that rounding does not show), a wrong one."""


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "amount", "value", "law", "wrong"), [row[1:] for row in NOISES], ids=[row[0] for row in NOISES]
)
def test_noise_follows_its_law_and_no_other(
    make: type[NoiseFault], amount: float, value: int, law: Distribution, wrong: Distribution
) -> None:
    """faults.md: value x (1 + U(-b, b)), absolute uniform, normal. KS at 1 % over seeds 0..19, at most 2 rejections.

    A true law is rejected more than twice in 20 with probability 0.001. The wrong ones (the same spread with another
    form, or a spread 10 % off) must be rejected.
    """
    samples = [errors(begun(make(POSITION, amount), seed=seed), value, 3000) for seed in range(20)]
    rejected = [sum(stats.kstest(sample, one.cdf).pvalue < 0.01 for sample in samples) for one in (law, wrong)]
    assert rejected[0] <= 2
    assert rejected[1] > 10


def test_relative_noise_leaves_zero_alone() -> None:
    """0 x (1 + U) = 0."""
    assert set(errors(begun(RelativeNoise(POSITION, 5.0)), 0, 100)) == {0}


def test_noise_is_bounded_and_saturates() -> None:
    """U(-b, b) never exceeds b; at the end of the range half of the frames are cut, and counted."""
    fault = begun(UniformNoise(POSITION, 10.0))
    assert max(map(abs, errors(fault, 1000, 2000))) == 10
    fault = begun(UniformNoise(POSITION, 1000.0))
    cut = sum(error == 0 for error in errors(fault, 2**31 - 1, 1000))
    assert fault.saturated > 400
    assert cut >= fault.saturated


def test_noise_is_drawn_from_the_stream_of_the_injector() -> None:
    """The same seed gives the same noise, another one another."""
    one, same, other = (errors(begun(NormalNoise(POSITION, 1e5), seed=seed), 0, 20) for seed in (1, 1, 2))
    assert one == same
    assert one != other
