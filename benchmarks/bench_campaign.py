"""What a run of a campaign costs: experiment 1 of the paper, no pins, with and without forking, one process and two.

A sample of its runs (the seeds in turn through durations of the fault); each is made twice in turn in one process, from
power-up and from a snapshot of the golden run, and the two rows must be equal. CPU time of the process. The golden run
is made once, before; its cost is printed beside. For comparison stands what a scenario costs by itself (`exo-hil run`),
which makes its golden run every time. Then the same runs in the campaign's own pool, one process against two, by the
clock, once each process has its golden run: that means little on a machine that does other work.
Nothing is asserted about time: the budget stands beside the figure.
"""

import argparse
import dataclasses
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from testbench.campaign.making.execute import Workshop, make_run
from testbench.campaign.making.pool import Pool
from testbench.campaign.records import Point, RunRow, RunSpec, Wanted
from testbench.run import rig_params, run_scenario
from testbench.scenario import load_scenario, parse_scenario

SCENARIO: Final = Path(__file__).parent.parent / "scenarios" / "knee_freeze.yaml"
DURATIONS_S: Final = (0.05, 0.15, 0.5, 1.0, 3.0)
"""Of the 20 points of experiment 1."""
KEYS: Final = ("injectors.freeze_position.effect.duration", "injectors.zero_velocity.effect.duration")
SECOND_PROCESS_BUDGET: Final = 1.8
"""Least that a second process must give, in runs of one process."""
ROUNDS: Final = 3

Figures = dict[str, float]


def spec(seed: int) -> RunSpec:
    """A run of experiment 1, from power-up."""
    duration = f"{DURATIONS_S[seed % len(DURATIONS_S)]} s"
    scenario = load_scenario(SCENARIO, [f"seed={seed}", "rig.stops=off", *(f"{key}={duration}" for key in KEYS)])
    return RunSpec(
        identity=str(seed),
        wanted=Wanted(Point((("duration", duration),)), seed),
        seed=seed,
        scenario=scenario.resolved_yaml(),
        code_version="",
        stop_on=None,
        grace_s=0.0,
        keep_traces="never",
        folder="",
        time_limit_s=600.0,
        fork=False,
    )


def timeless(row: RunRow) -> RunRow:
    """The row but for what it took to make it."""
    return dataclasses.replace(row, started="", wall_s=0.0, cpu_s=0.0, forked_s=0.0)


def seconds(work: Callable[[], object]) -> float:
    """CPU time of one call."""
    start = time.process_time()
    work()
    return time.process_time() - start


def one_process(specs: list[RunSpec]) -> Figures:
    """What runs cost with and without forking; raises AssertionError when a row hangs on it."""
    workshop = Workshop()
    params = rig_params(parse_scenario(specs[0].scenario))
    golden_s = seconds(lambda: workshop.golden(params, fork=True))
    straight, forked, taken_over = [], [], []
    for one in specs:
        whole, part = make_run(one, workshop), make_run(dataclasses.replace(one, fork=True), workshop)
        assert timeless(whole) == timeless(part), f"seed {one.seed}: other results with forking than without"
        straight.append(whole.cpu_s)
        forked.append(part.cpu_s)
        taken_over.append(part.forked_s)
    assert workshop.made == 1, f"the golden run was made {workshop.made} times"
    single = statistics.median(seconds(lambda: run_scenario(parse_scenario(specs[0].scenario))) for _ in range(ROUNDS))
    gains = [a / b for a, b in zip(straight, forked, strict=True)]
    return {
        "golden_s": golden_s,
        "golden_runs": workshop.made,
        "straight_s": statistics.mean(straight),
        "forked_s": statistics.mean(forked),
        "taken_over_s": statistics.mean(taken_over),
        "gain_of_forking": sum(straight) / sum(forked),
        "gain_of_forking_least": min(gains),
        "gain_of_forking_most": max(gains),
        "single_s": single,
    }


def runs_per_minute(jobs: int, specs: list[RunSpec]) -> float:
    """By the clock, from when every process has its golden run."""
    pool = Pool(jobs)
    try:
        make(pool, [dataclasses.replace(specs[0], identity=f"first {k}") for k in range(jobs)])
        begun = time.monotonic()
        make(pool, specs)
        return 60 * len(specs) / (time.monotonic() - begun)
    finally:
        pool.stop()


def make(pool: Pool, specs: list[RunSpec]) -> None:
    """Make these runs, one in each process at a time."""
    waiting, finished = list(reversed(specs)), 0
    while finished < len(specs):
        while waiting and pool.free() > 0:
            pool.submit(waiting.pop())
        finished += len(pool.collect(1.0))


def two_processes(specs: list[RunSpec]) -> Figures:
    """One process and two, in turn."""
    rates = [(runs_per_minute(1, specs), runs_per_minute(2, specs)) for _ in range(ROUNDS)]
    return {
        "one_process_per_min": statistics.median(one for one, _ in rates),
        "two_processes_per_min": statistics.median(two for _, two in rates),
        "gain_of_second_process": statistics.median(two / one for one, two in rates),
    }


def show(found: Figures) -> None:
    """The figures for people."""
    least, most = found["gain_of_forking_least"], found["gain_of_forking_most"]
    straight, forked, single = found["straight_s"], found["forked_s"], found["single_s"]
    print(f"experiment 1, no pins, {found['runs']:.0f} runs; CPU time in one process")
    print(f"  golden run, {found['golden_runs']:.0f} x    {1000 * found['golden_s']:6.0f} ms with its snapshots")
    print(f"  from power-up      {1000 * straight:6.0f} ms a run, {60 / straight:5.0f} runs/min")
    print(f"  forked             {1000 * forked:6.0f} ms a run, {60 / forked:5.0f} runs/min")
    print(f"  gain of forking    {found['gain_of_forking']:6.2f}, of single runs {least:.2f} to {most:.2f}; "
          f"{found['taken_over_s']:.1f} s of a run taken over on average")  # fmt: skip
    print(f"  `exo-hil run`      {1000 * single:6.0f} ms with its own golden run, {single / forked:.1f} forked runs")
    if "gain_of_second_process" in found:
        print("forked, by the clock")
        print(f"  one process        {found['one_process_per_min']:6.0f} runs/min")
        print(f"  two processes      {found['two_processes_per_min']:6.0f} runs/min")
        print(f"  gain               {found['gain_of_second_process']:6.2f} (at least {SECOND_PROCESS_BUDGET})")


def main() -> int:
    """Measure and print; 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=int, default=15, help="runs in the sample")
    parser.add_argument("--one-process", action="store_true", help="leave the second process out")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    options = parser.parse_args()
    specs = [spec(seed) for seed in range(1, options.runs + 1)]
    found: Figures = {"runs": len(specs), **one_process(specs)}
    if not options.one_process:
        found.update(two_processes([dataclasses.replace(one, fork=True) for one in specs]))
    if options.json:
        print(json.dumps(found, indent=2))
    else:
        show(found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
