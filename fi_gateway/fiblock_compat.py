"""The original FIBlock, sample by sample, quirks included: for comparison with results published with it.

Source: the behaviour of the block of Fabarisov, Mamaev, Morozov, Janschek, ESREL 2020, as described; written from that
description alone. A library function for arrays and not a scenario flag: frames have no samples. The engine's own
faults (`fi_gateway.faults`) mean something else on purpose; docs/fiblock.md sets the two beside each other.

Per sample: trigger, event test (only while inactive), expiry test, apply. The sample in which a fault expires is clean,
and the event is tested again from the next one on. The trigger is a level, OR-ed with the event.

The description leaves these open; here:
- A constant time of n samples acts on n + 1, the activation sample and n more (the only count with which the printed
  ramps of stuck-at and time delay agree), and `once` is a constant time of one sample, once a run.
- A drawn repair time D expires at the first sample later than D after the activation sample, so D < 0 acts on none.
- The time to failure is drawn at the first sample, and again at every expiry, also of a fault that the trigger started,
  and counts from there; the event happens at the first sample that is not earlier.
- A failure probability is drawn at every sample that tests the event, also when the trigger is high; no other is.
- Bits to flip, and noise, are drawn anew for every sample. What the fault draws comes after all that the windows draw,
  so that one seed gives the same windows with every fault (the order of draws of the original cannot be had anyway).
- A time delay whose fault acted on one sample alone, by a short repair time, leaves no lag.
Left out: drift, and events and effects by further distributions.
"""

from typing import Final, Literal, TypeAlias, get_args

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from fi_gateway.errors import FaultError

Samples: TypeAlias = NDArray[np.float64]
Levels: TypeAlias = NDArray[np.bool_]

FaultType: TypeAlias = Literal["stuck_at", "package_drop", "bias", "bit_flips", "time_delay", "noise"]
EventType: TypeAlias = Literal["failure_probability", "mttf", "deterministic"]
EffectType: TypeAlias = Literal["once", "constant_time", "infinite", "mttr"]

SIGMA_S: Final = 1.0
"""Standard deviation of times to failure and to repair [s]; the normal distribution is not truncated."""

LOW_BITS: Final = 32
"""Of a double's 52 mantissa bits only the lowest 32 are ever flipped."""


def run(
    fault: FaultType,
    value: float,
    event: EventType,
    event_value: float,
    effect: EffectType,
    effect_value: float,
    t: Samples,
    x: Samples,
    trigger: Levels | None,
    rng: Generator,
) -> tuple[Samples, Levels]:
    """One FIBlock over a signal; returns its output and its trigger output, (n,) each.

    t: (n,) s, rising; x: (n,) input; trigger: (n,) trigger input, None for never high; flag: where the fault acts.
    Outside the flag y equals x, but for the lag that a time delay leaves behind.

    value, by fault: stuck_at, time_delay: not used; package_drop: the value put out; bias: added, in the unit of x;
    bit_flips: how many bits are drawn, >= 1, with replacement; noise: bound b [%], >= 0, y = x (1 + U(-b, b)).
    event_value: failure_probability: p per sample, 0..1; mttf: mean [s]; deterministic: a time [s], equal to a sample's
    to the last bit or else nothing happens. effect_value: constant_time: samples, whole, >= 1; mttr: mean [s]; once,
    infinite: not used. Raises FaultError for what is not allowed.
    """
    _check("fault", fault, get_args(FaultType))
    _check("event", event, get_args(EventType))
    _check("effect", effect, get_args(EffectType))
    _check_values(fault, value, event, event_value, effect, effect_value)
    high = _check_arrays(t, x, trigger)
    flag = _windows(event, event_value, effect, effect_value, t, high, rng)
    return _output(fault, value, x, flag, rng), flag


def _windows(
    event: EventType,
    event_value: float,
    effect: EffectType,
    effect_value: float,
    t: Samples,
    trigger: Levels,
    rng: Generator,
) -> Levels:
    """Where the fault acts, (n,)."""
    flag = np.zeros(t.size, np.bool_)
    failure_s = t[0] + rng.normal(event_value, SIGMA_S) if event == "mttf" else 0.0
    length = 1.0 if effect == "once" else effect_value  # samples; of mttr: s, drawn below
    is_active = False
    is_spent = False
    begin = 0
    for k in range(t.size):
        if not is_active and not is_spent:
            if event == "failure_probability":
                happens = rng.random() > 1.0 - event_value
            elif event == "mttf":
                happens = t[k] >= failure_s
            else:
                happens = t[k] == event_value
            if happens or trigger[k]:
                is_active, begin = True, k
                if effect == "mttr":
                    length = rng.normal(effect_value, SIGMA_S)
        if is_active and effect != "infinite":
            passed = t[k] - t[begin] if effect == "mttr" else k - begin
            if passed > length:
                is_active, is_spent = False, effect == "once"
                if event == "mttf":
                    failure_s = t[k] + rng.normal(event_value, SIGMA_S)
        flag[k] = is_active
    return flag


def _output(fault: FaultType, value: float, x: Samples, flag: Levels, rng: Generator) -> Samples:
    """What the block puts out, (n,)."""
    y = x.copy()
    hit = int(np.count_nonzero(flag))
    if fault == "stuck_at":
        y = x[_held(flag)]
    elif fault == "package_drop":
        y[flag] = value
    elif fault == "bias":
        y[flag] += value
    elif fault == "noise":
        y[flag] *= 1.0 + rng.uniform(-value / 100.0, value / 100.0, hit)
    elif fault == "bit_flips":
        bits = rng.integers(LOW_BITS, size=(hit, int(value)), dtype=np.uint64)
        y.view(np.uint64)[flag] ^= np.bitwise_xor.reduce(np.uint64(1) << bits, axis=1)
    else:
        y = x[_lagging(flag)]
    return y


def _held(flag: Levels) -> NDArray[np.intp]:
    """Which sample stuck-at puts out at each, (n,): while active the one of the activation."""
    rows = np.arange(flag.size)
    begins = flag & ~np.concatenate(([False], flag[:-1]))
    return np.where(flag, np.maximum.accumulate(np.where(begins, rows, 0)), rows)


def _lagging(flag: Levels) -> NDArray[np.intp]:
    """Which sample a time delay puts out at each, (n,).

    It stands still after the activation sample, skips one when the fault has expired, and goes on at the lag it has
    by then: n samples of standing still leave n - 1. The next fault adds its own.
    """
    rows = np.empty(flag.size, np.intp)
    row = -1
    stood = 0
    was_active = False
    for k, is_active in enumerate(flag.tolist()):
        if is_active and was_active:
            stood += 1
        else:
            row += 2 if stood else 1
            stood = 0
        rows[k] = row
        was_active = is_active
    return rows


def _check(what: str, given: str, allowed: tuple[str, ...]) -> None:
    if given not in allowed:
        raise FaultError(f"fiblock: {what} {given!r} given, allowed are {', '.join(allowed)}")


def _check_values(
    fault: FaultType, value: float, event: EventType, event_value: float, effect: EffectType, effect_value: float
) -> None:
    """Refuse values that their fault, event or effect cannot have."""
    if fault in ("package_drop", "bias", "noise") and not np.isfinite(value):
        raise FaultError(f"fiblock: {fault}: value {value} given, allowed are finite numbers")
    if fault == "noise" and value < 0:
        raise FaultError(f"fiblock: noise: bound {value} % given, allowed is 0 % and more")
    if fault == "bit_flips" and not (value >= 1 and float(value).is_integer()):
        raise FaultError(f"fiblock: bit_flips: {value} bits given, allowed are whole numbers from 1 on")
    if not np.isfinite(event_value):
        raise FaultError(f"fiblock: {event}: event_value {event_value} given, allowed are finite numbers")
    if event == "failure_probability" and not 0 <= event_value <= 1:
        raise FaultError(f"fiblock: failure_probability: p {event_value} given, allowed 0..1 per sample")
    if effect == "constant_time" and not (effect_value >= 1 and float(effect_value).is_integer()):
        raise FaultError(
            f"fiblock: constant_time: {effect_value} samples given, allowed are whole numbers from 1 on; "
            "divide a time by the sample time"
        )
    if effect == "mttr" and not np.isfinite(effect_value):
        raise FaultError(f"fiblock: mttr: mean {effect_value} s given, allowed are finite numbers")


def _check_arrays(t: Samples, x: Samples, trigger: Levels | None) -> Levels:
    """Refuse arrays that do not fit together; returns the trigger levels."""
    if t.ndim != 1 or t.size == 0 or t.dtype != np.float64 or not np.all(np.isfinite(t)) or np.any(np.diff(t) <= 0):
        raise FaultError("fiblock: t must be (n,) float64 seconds, n >= 1, finite and rising from sample to sample")
    if x.shape != t.shape or x.dtype != np.float64:
        raise FaultError(f"fiblock: x of shape {x.shape}, {x.dtype} given, allowed is {t.shape}, float64")
    if trigger is None:
        return np.zeros(t.size, np.bool_)
    if trigger.shape != t.shape or trigger.dtype != np.bool_:
        given = f"trigger of shape {trigger.shape}, {trigger.dtype}"
        raise FaultError(f"fiblock: {given} given, allowed is {t.shape}, bool")
    return trigger
