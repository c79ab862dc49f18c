"""What a run of a campaign costs: experiment 1 of the paper, without pins, with and without forking.

A sample of its points (durations of the fault) and seeds; every run is made twice in turn in one process, from power-up
and from a snapshot of the golden run, and the two rows must be equal. CPU time of the process. The golden run is made
once, before; its cost is printed beside. For comparison stands what a scenario costs by itself (`exo-hil run`), which
makes its golden run every time. With the campaign's own runner, one process against two, by the clock: means little
on a machine that does other work. Nothing is asserted about time: the budgets stand beside the figures.
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

from testbench.campaign.execute import Workshop, make_run
from testbench.campaign.records import Point, RunRow, RunSpec, Wanted
from testbench.run import rig_params, run_scenario
from testbench.scenario import load_scenario, parse_scenario

SCENARIO: Final = Path(__file__).parent.parent / "scenarios" / "knee_freeze.yaml"
DURATIONS_S: Final = (0.05, 0.15, 0.5, 1.0, 3.0)
"""Of the 20 points of experiment 1."""
KEYS: Final = ("injectors.freeze_position.effect.duration", "injectors.zero_velocity.effect.duration")

Figures = dict[str, float]


def spec(duration_s: float, seed: int) -> RunSpec:
    """A run of experiment 1, from power-up."""
    changes = [f"{key}={duration_s} s" for key in KEYS]
    scenario = load_scenario(SCENARIO, [f"seed={seed}", "rig.stops=off", *changes])
    point = Point((("duration", f"{duration_s} s"),))
    wanted = Wanted(point, seed)
    return RunSpec(f"{duration_s}-{seed}", wanted, seed, scenario.resolved_yaml(), "", None, 0.0, "never", "", 0.0, False)


def timeless(row: RunRow) -> RunRow:
    """The row but for what it took to make it."""
    return dataclasses.replace(row, started="", wall_s=0.0, cpu_s=0.0, forked_s=0.0)


def seconds(work: Callable[[], object]) -> float:
    """CPU time of one call."""
    start = time.process_time()
    work()
    return time.process_time() - start


def measure(seeds: int) -> Figures:
    """Figures by name; raises AssertionError when a row hangs on forking."""
    workshop = Workshop()
    specs = [spec(duration, seed) for seed in range(1, seeds + 1) for duration in DURATIONS_S]
    params = rig_params(parse_scenario(specs[0].scenario))
    golden_s = seconds(lambda: workshop.golden(params, fork=True))
    straight, forked, taken_over = [], [], []
    for one in specs:
        whole, part = make_run(one, workshop), make_run(dataclasses.replace(one, fork=True), workshop)
        assert timeless(whole) == timeless(part), f"{one.identity}: other results with forking than without"
        straight.append(whole.cpu_s)
        forked.append(part.cpu_s)
        taken_over.append(part.forked_s)
    assert workshop.made == 1, f"the golden run was made {workshop.made} times"
    single = [seconds(lambda: run_scenario(parse_scenario(specs[0].scenario))) for _ in range(3)]
    return {
        "runs": len(specs),
        "golden_s": golden_s,
        "golden_runs": workshop.made,
        "straight_s": statistics.mean(straight),
        "forked_s": statistics.mean(forked),
        "straight_per_min": 60 / statistics.mean(straight),
        "forked_per_min": 60 / statistics.mean(forked),
        "taken_over_s": statistics.mean(taken_over),
        "gain": sum(straight) / sum(forked),
        "gain_low": min(a / b for a, b in zip(straight, forked, strict=True)),
        "gain_high": max(a / b for a, b in zip(straight, forked, strict=True)),
        "single_s": statistics.median(single),
        "gain_over_single": statistics.median(single) / statistics.mean(forked),
    }


def show(found: Figures) -> None:
    """The figures for people."""
    print(f"experiment 1, no pins: {found['runs']:.0f} runs ({', '.join(f'{d:g} s' for d in DURATIONS_S)}), CPU time")
    print(f"  golden run with snapshots, {found['golden_runs']:.0f} x: {found['golden_s']:.2f} s")
    print(f"  from power-up    {1000 * found['straight_s']:7.0f} ms a run {found['straight_per_min']:7.0f} runs/min")
    print(f"  forked           {1000 * found['forked_s']:7.0f} ms a run {found['forked_per_min']:7.0f} runs/min"
          f"   {found['taken_over_s']:.1f} s taken over on average")  # fmt: skip
    print(f"  gain of forking  {found['gain']:7.2f}   (single runs {found['gain_low']:.2f} .. {found['gain_high']:.2f})")
    print(f"  `exo-hil run`    {1000 * found['single_s']:7.0f} ms, its golden run included; a forked run is "
          f"{found['gain_over_single']:.1f} times as fast")  # fmt: skip


def main() -> int:
    """Measure and print; 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=3, help="runs of each point")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    options = parser.parse_args()
    found = measure(options.seeds)
    if options.json:
        print(json.dumps(found, indent=2))
    else:
        show(found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
