"""scenarios/faults: a scenario for each group of fault types; what the counts must be follows from rate and window."""

from pathlib import Path

import pytest

from testbench.run import run_scenario
from testbench.scenario import load_scenario, parse_scenario

FOLDER = Path(__file__).parents[2] / "scenarios" / "faults"

COUNTS = {
    "noisy_sensors": {
        "drifting_position": {"seen": 500, "injected": 500},  # 1 s at 500 Hz
        "noisy_velocity": {"seen": 1000, "injected": 1000},
    },
    "lagging_knee": {"late_position": {"seen": 500, "injected": 500, "lost": 0}},
    "stuck_bit": {"stuck_bit": {"seen": 750, "injected": 750, "lost": 0}},
    "burst_losses": {"lossy_bus": {"seen": 3000, "changed": 0, "delayed": 0}},
    "late_torques": {
        "late_torque": {"seen": 250, "delayed": 250, "lost": 0, "inserted": 0},
        "repeated_torque": {"seen": 250, "inserted": 250, "delayed": 0},
    },
    "forged_stop": {
        "impostor": {"seen": 100, "inserted": 100, "changed": 0},
        "stop_knee": {"seen": 1, "inserted": 1},
    },
    "disturbed_bits": {
        "flipped_bit": {"seen": 0, "changed": 0},
        "forged_position": {"seen": 5, "changed": 5},
        "local_error": {"seen": 0, "changed": 0},
        "unheard": {"seen": 0, "changed": 0},
        "short_circuit": {"seen": 0, "changed": 0},
    },
    "noisy_wires": {"noise": {"seen": 0}, "bursts": {"seen": 0}},
    "knee_bus_off": {"knee_off": {"seen": 0, "inserted": 0}},
    "babbling_idiot": {"babble": {"seen": 0, "changed": 0}},
}


def test_every_scenario_is_in_the_table() -> None:
    """None is shipped untested."""
    assert {path.stem for path in FOLDER.glob("*.yaml")} == set(COUNTS)


@pytest.mark.parametrize("name", COUNTS)
def test_it_is_read_without_warnings_and_written_back(name: str) -> None:
    """The resolved file reads as an equal scenario."""
    scenario = load_scenario(FOLDER / f"{name}.yaml")
    assert scenario.name == name
    assert scenario.warnings == []
    assert parse_scenario(scenario.resolved_yaml()) == scenario


@pytest.mark.run
@pytest.mark.parametrize("name", COUNTS)
def test_it_runs_and_injects_as_often_as_it_says(name: str) -> None:
    """Valid runs; frames seen, injected, changed, lost, delayed and inserted as rate and window have it."""
    document = run_scenario(load_scenario(FOLDER / f"{name}.yaml")).document
    assert document["valid"]
    found = {one["injector"]: one for one in document["injections"]}
    wanted = COUNTS[name]
    assert set(found) == set(wanted)
    for injector, counts in wanted.items():
        assert {key: found[injector][f"frames_{key}"] for key in counts} == counts  # type: ignore[literal-required]
    assert document["trace_hash"]["golden"] != document["trace_hash"]["faulted"]


@pytest.mark.run
def test_bursts_lose_the_share_that_was_asked_for() -> None:
    """burst_losses: 20 % of 3000 frames in bursts of 4. Correlation makes the variance (1 + c) / (1 - c) as large.

    c = 1 - p - r = 0.6875, so the standard deviation of the count is sqrt(3000 x 0.2 x 0.8 x 5.4) = 51; 4 of them.
    """
    (one,) = run_scenario(load_scenario(FOLDER / "burst_losses.yaml")).document["injections"]
    assert abs(one["frames_lost"] - 600) <= 4 * 51
