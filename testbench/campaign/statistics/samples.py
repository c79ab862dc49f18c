"""Measured numbers of many runs, such as an RMSE: where they lie, how far they spread, and how sure that is.

The runs are independent draws of the same experiment, such as the runs of one point. NaN and infinity are refused.
Sources: NIST/SEMATECH e-Handbook of Statistical Methods, sections 1.3.5.1 (location), 1.3.5.2 (t interval of the mean)
and 1.3.5.6 (scale); H. A. David, H. N. Nagaraja, Order Statistics, 3rd edition, section 7.1 (interval of a quantile);
R. J. Hyndman, Y. Fan, Am. Stat. 50 (1996) 361, type 7 (quartiles); B. Efron, R. J. Tibshirani, An Introduction to the
Bootstrap, section 13.3 (percentile interval). More in docs/statistics.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from testbench.campaign.statistics.shares import Interval, NotEstimableError, check_confidence

__all__ = ["Summary", "as_sample", "bootstrap_interval", "mean_interval", "median_interval", "summary"]

LEAST_FOR_BOOTSTRAP: Final = 10
"""Below, resampling shows what happens to be in the sample rather than how the sample could have come out."""


@dataclass(frozen=True, slots=True)
class Summary:
    """A sample in numbers, in the unit of the sample.

    sd: standard deviation with n - 1 (ddof 1), None for a single value. q1, median, q3: quartiles, linear between order
    statistics (type 7). mad: median of the absolute deviations from the median, not scaled to a normal distribution.
    """

    n: int
    mean: float
    sd: float | None
    low: float
    q1: float
    median: float
    q3: float
    high: float
    mad: float


def as_sample(values: Sequence[float]) -> NDArray[np.float64]:
    """The values as an array (n,); raises NotEstimableError for none, ValueError for NaN or infinity."""
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1:
        raise ValueError(f"a sample is one row of numbers; got an array of shape {sample.shape}")
    if not sample.size:
        raise NotEstimableError("no value was measured: there is nothing to take a mean of")
    if not np.isfinite(sample).all():
        bad = int(np.flatnonzero(~np.isfinite(sample))[0])
        raise ValueError(
            f"value {bad} of the sample is {sample[bad]}; leave out what could not be measured, and say so"
        )
    return sample


def summary(values: Sequence[float]) -> Summary:
    """Location and spread of a sample; raises NotEstimableError for no value."""
    sample = as_sample(values)
    low, q1, median, q3, high = (float(one) for one in np.quantile(sample, (0, 0.25, 0.5, 0.75, 1)))
    sd = float(sample.std(ddof=1)) if sample.size > 1 else None
    return Summary(
        sample.size, float(sample.mean()), sd, low, q1, median, q3, high, float(np.median(abs(sample - median)))
    )


def mean_interval(values: Sequence[float], confidence: float = 0.95) -> Interval:
    """Student's t interval of the mean, n - 1 degrees of freedom: mean +- t sd / sqrt(n).

    Exact for normal values; too narrow on the side of a heavy tail. Raises NotEstimableError for fewer than two values,
    and for equal values, whose spread of 0 would claim a mean without doubt.
    """
    from scipy.special import stdtrit

    sample = _varied(values, 2, "the mean")
    quantile = float(stdtrit(sample.size - 1, (1 + check_confidence(confidence)) / 2))
    mean, reach = float(sample.mean()), quantile * float(sample.std(ddof=1)) / float(np.sqrt(sample.size))
    return Interval(mean - reach, mean + reach, confidence, "t")


def median_interval(values: Sequence[float], confidence: float = 0.95) -> Interval:
    """Interval of the median between two order statistics, j-th smallest and j-th largest; j is the largest that holds.

    The number of values below the median is binomial (n, 1/2) whatever the distribution, so that it covers at least
    `confidence`, for heavy tails and ties too. Raises NotEstimableError when even smallest to largest covers less: for
    95 % below 6 values.
    """
    from scipy.special import bdtr

    sample = np.sort(as_sample(values))
    n, tail = sample.size, (1 - check_confidence(confidence)) / 2
    rank = 0  # values cut off at each end; bdtr(k, n, p) = P(at most k of n)
    while rank < (n - 1) // 2 and bdtr(rank + 1, n, 0.5) <= tail:
        rank += 1
    if bdtr(rank, n, 0.5) > tail:
        least = 1
        while 0.5**least > tail:
            least += 1
        raise NotEstimableError(
            f"{n} values are too few for an interval of the median at {confidence:.4g} confidence; it takes {least}"
        )
    return Interval(float(sample[rank]), float(sample[n - 1 - rank]), confidence, "order statistics")


def bootstrap_interval(
    values: Sequence[float], generator: np.random.Generator, confidence: float = 0.95, resamples: int = 9999
) -> Interval:
    """Percentile bootstrap interval of the mean: quantiles of the means of samples drawn from the sample, n of n.

    For skewed values, where the t interval puts both ends at the same distance; too narrow for few values and for tails
    the sample has not seen. Raises NotEstimableError for fewer than 10 values or equal ones.
    """
    from scipy.stats import bootstrap

    sample = _varied(values, LEAST_FOR_BOOTSTRAP, "the mean by bootstrap")
    if resamples < 100:
        raise ValueError(f"{resamples} resamples given; allowed from 100 up, at least 1000 for ends that are steady")
    found = bootstrap(
        (sample,),
        np.mean,
        n_resamples=resamples,
        batch=max(1, 1_000_000 // sample.size),
        vectorized=True,
        confidence_level=check_confidence(confidence),
        method="percentile",
        rng=generator,
    ).confidence_interval
    return Interval(float(found.low), float(found.high), confidence, "bootstrap percentile")


def _varied(values: Sequence[float], least: int, what: str) -> NDArray[np.float64]:
    sample = as_sample(values)
    if sample.size < least:
        raise NotEstimableError(f"{sample.size} values are too few for an interval of {what}; it takes {least}")
    if sample.min() == sample.max():
        raise NotEstimableError(
            f"all {sample.size} values are {sample[0]:g}: their spread is not known, and 0 would be a claim"
        )
    return sample
