"""How well the searches do in worlds that are known: `python -m tests.testbench.campaign.search_table [SEEDS]`.

Prints, for each world, method and quantile: what the searches came to, how often the interval held the true value,
the median of its width and of the runs used, and how far off the estimates were. docs/statistics.md shows the table.
"""

import math
import sys
from collections import Counter
from collections.abc import Callable
from decimal import Decimal
from multiprocessing import Pool
from statistics import median

from testbench.campaign.plans.critical import Answer, CriticalResult
from testbench.campaign.plans.search import METHODS, CriticalSearch
from tests.testbench.campaign.worlds import Logistic, searched

AXIS = ("duration", Decimal("0.05"), Decimal("3"), Decimal("0.01"), "s")


def step(x: float) -> float:
    return float(x > 0.7321)


def weibull(x: float) -> float:
    return 1 - math.exp(-(x**3))


def saturating(x: float) -> float:
    return 1 - math.exp(-x / 0.7)


def never(x: float) -> float:
    return 0.0


def always(x: float) -> float:
    return 1.0


def flat(x: float) -> float:
    return 0.5


def hump(x: float) -> float:
    return float(0.4 < x < 1.5)


SHALLOW, STEEP, EARLY = Logistic(1.0, 4.0), Logistic(1.0, 40.0), Logistic(0.15, 10.0)
World = tuple[str, Callable[[float], float], Callable[[float], float] | None]
WORLDS: tuple[World, ...] = (
    ("logistic, 4/s", SHALLOW, SHALLOW.at),
    ("logistic, 40/s", STEEP, STEEP.at),
    ("logistic at the low end", EARLY, EARLY.at),
    ("step", step, lambda q: 0.7321),
    ("Weibull, no logistic", weibull, lambda q: (-math.log(1 - q)) ** (1 / 3)),
    ("saturating, no logistic", saturating, lambda q: -0.7 * math.log(1 - q)),
    ("never", never, None),
    ("always", always, None),
    ("flat at 50 %", flat, None),
    ("hump", hump, None),
)


def one(task: tuple[int, CriticalSearch, int]) -> CriticalResult:
    number, search, seed = task
    return searched(search, WORLDS[number][1], seed)


def holds(result: CriticalResult, true: float) -> bool:
    return (result.low is None or result.low <= true) and (result.high is None or true <= result.high)


def line(results: list[CriticalResult], true: float | None) -> str:
    answers = ", ".join(f"{count} {answer.value}" for answer, count in Counter(r.answer for r in results).items())
    runs = median(result.runs for result in results)
    found = [result for result in results if result.answer is Answer.FOUND]
    if true is None or not found:
        return f"{runs:.0f} | {answers} | | | "
    claims = [one for one in results if one.low is not None or one.high is not None]
    covered = sum(holds(result, true) for result in claims)
    widths = [one.high - one.low for one in found if one.low is not None and one.high is not None]
    errors = [one.value - true for one in found if one.value is not None]
    rms = math.sqrt(sum(error * error for error in errors) / len(errors))
    width = f"{median(widths):.3f} s" if widths else "open"
    return f"{runs:.0f} | {answers} | {covered} of {len(claims)} | {width} | {rms:.3f} s"


def main(seeds: int) -> None:
    print("| world | method | quantile | runs | answers | interval held it | width | error (rms) |")
    print("|---|---|---|---|---|---|---|---|")
    with Pool() as pool:
        for number, (name, _, true) in enumerate(WORLDS):
            for method in METHODS:
                for quantile in (0.5, 0.1) if true else (0.5,):
                    search = CriticalSearch(*AXIS, quantile=quantile, method=method)
                    results = pool.map(one, [(number, search, seed) for seed in range(seeds)], chunksize=4)
                    shown = line(results, true(quantile) if true else None)
                    print(f"| {name} | {method} | {quantile:.0%} | {shown} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
