"""Runs to be made, from the shipped scenarios or from text."""

from pathlib import Path

from testbench.campaign.records import Point, RunSpec, Wanted
from testbench.scenario import load_scenario

SCENARIOS = Path(__file__).parents[3] / "scenarios"


def spec(
    name: str,
    *overrides: str,
    seed: int = 1,
    fork: bool = False,
    grace_s: float | None = None,
    keep_traces: str = "never",
    folder: str = "",
) -> RunSpec:
    """A run of a shipped scenario. grace_s: ends so long after the first failure, None: it does not."""
    scenario = load_scenario(SCENARIOS / f"{name}.yaml", [f"seed={seed}", *overrides])
    return RunSpec(
        identity=f"{name}{overrides}",
        wanted=Wanted(Point(()), seed),
        seed=seed,
        scenario=scenario.resolved_yaml(),
        code_version="test",
        stop_on=None if grace_s is None else "failure",
        grace_s=grace_s or 0.0,
        keep_traces=keep_traces,
        folder=folder,
        time_limit_s=600.0,
        fork=fork,
    )
