"""Fault files: what a gateway between real buses needs, and no more; told apart from scenarios."""

from pathlib import Path

import pytest

from canopen_exo.bus.node import MS
from fi_gateway.control import LiveControl
from fi_gateway.gateway import Gateway
from fi_gateway.marked_yaml import FileErrors
from fi_gateway.schema import build_injectors
from testbench.cli import main
from testbench.fault_file import FaultFile, describe_faults, load_any, load_faults
from testbench.scenario import Scenario

ROOT = Path(__file__).parents[2]
KNEE = ROOT / "scenarios" / "knee_freeze.yaml"
EXAMPLE = ROOT / "examples" / "gateway" / "faults.yaml"

SILENCE = """\
injectors:
  silence:
    target: {bus: to_controller, cob_id: 0x185}
    fault: {type: drop}
    event: {type: at, time: 20 s}
    effect: {type: infinite}
"""


def read(folder: Path, text: str, *overrides: str) -> Scenario | FaultFile:
    file = folder / "f.yaml"
    file.write_text(text)
    return load_any(file, overrides)


def complaints(folder: Path, text: str, *overrides: str) -> list[str]:
    with pytest.raises(FileErrors) as caught:
        read(folder, text, *overrides)
    return [message.removeprefix(f"{folder}/") for message in caught.value.messages]


def test_injectors_alone_are_enough(tmp_path: Path) -> None:
    """500 Hz, seed 0; a time that lies far out is no mistake, since a gateway has no end of its own."""
    faults = read(tmp_path, SILENCE)
    assert isinstance(faults, FaultFile)
    assert (list(faults.injectors), faults.rig.cycle_ns, faults.seed) == (["silence"], 2 * MS, 0)
    assert faults.warnings == []


def test_a_gait_phase_is_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """design.md: gait_phase comes from the HLC's status frame alone; at a foreign master nobody sends it."""
    faults = read(tmp_path, SILENCE.replace("{type: at, time: 20 s}", "{type: gait_phase, phase: 30 %}"))
    assert isinstance(faults, FaultFile)
    (warning,) = faults.warnings
    assert warning.startswith("injectors.silence: waits for what `exo-hil hlc` says on the bus (COB-ID 0x2FF)")
    assert main(["check", str(tmp_path / "f.yaml")]) == 0
    assert f"warning: {warning}" in capsys.readouterr().err


def test_rig_of_a_scenario_may_stay(tmp_path: Path) -> None:
    """Who copies a scenario and takes its motion out has a fault file; the rate counts."""
    faults = read(tmp_path, f"rig: {{plant: suspended, stops: off, rate: 100 Hz}}\nseed: 3\n{SILENCE}")
    assert isinstance(faults, FaultFile)
    assert (faults.plan.cycle_ns, faults.seed) == (10 * MS, 3)


def test_overrides_change_a_fault_file(tmp_path: Path) -> None:
    """As for a scenario, also where the key is not in the file."""
    faults = read(tmp_path, SILENCE, "rig.rate=100Hz", "injectors.silence.event.time=1s", "seed=7")
    assert isinstance(faults, FaultFile)
    assert (faults.rig.cycle_ns, faults.seed) == (10 * MS, 7)
    assert faults.injectors["silence"].event.times() == (1000 * MS,)


@pytest.mark.parametrize("key", ["motion: {gait: walking}", "expect: []", "fail_on: error", "tolerance: 1 deg"])
def test_a_file_with_a_key_of_a_scenario_is_one(tmp_path: Path, key: str) -> None:
    """So that a scenario with its motion forgotten is told so."""
    assert any("needed: name, rig, motion" in line for line in complaints(tmp_path, f"{key}\n{SILENCE}"))


def test_gateway_takes_from_a_scenario_what_it_needs() -> None:
    """The same injectors with the same random streams as in a run."""
    scenario, faults = load_any(KNEE), load_faults(KNEE)
    assert isinstance(scenario, Scenario)
    assert faults.injectors == scenario.injectors
    assert (faults.name, faults.seed, faults.plan) == (scenario.name, scenario.seed, scenario.plan)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (SILENCE.replace("drop", "dropp"), "f.yaml:4:19: injectors.silence.fault.type: unknown fault 'dropp'; did you"),
        (SILENCE + "sed: 3\n", "f.yaml:7:1: sed: unknown key; did you mean 'seed'? (allowed: injectors, name, descr"),
        (SILENCE.replace("silence", "si lence"), "f.yaml:2:3: injectors.si lence: 'si lence' is no name"),
        (SILENCE.replace("to_controller", "to_drives"), "f.yaml:3:19: injectors.silence.target.bus: TPDO1 of right_"),
        (SILENCE + "rig: {rate: 3 Hz}\n", "f.yaml:7:13: rig.rate: '3 Hz' is not a rate this rig can run at"),
        (SILENCE + "rig: {plant: walking}\n", "f.yaml:7:14: rig.plant: plant 'walking' is not available yet"),
        ("injectors: 3\n", "f.yaml:1:12: injectors: expected a mapping of names; got 3"),
    ],
)
def test_wrong_fault_file_is_told_by_line_and_key(tmp_path: Path, text: str, words: str) -> None:
    """As for a scenario: where, what, what is allowed."""
    assert complaints(tmp_path, text)[0].startswith(words)


def test_example_is_checked_and_said_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    """`exo-hil check faults.yaml` says what the gateway will do, and where time 0 comes from."""
    assert main(["check", str(EXAMPLE)]) == 0
    said = capsys.readouterr()
    # of the one that only a person starts, no more is warned of than that
    assert all("dead_sensor: will stay silent" in line for line in said.err.splitlines())
    faults = load_faults(EXAMPLE)
    assert said.out.splitlines() == describe_faults(faults)
    assert "time 0: the controller's status frame (COB-ID 0x2FF), or `exo-hil fault start`" in said.out
    assert len(build_injectors(faults.injectors, faults.plan, faults.seed, 0)) == 3


def test_injector_of_the_example_that_is_started_by_hand_acts_when_it_is_triggered() -> None:
    """Its comment says how; an event that is over when it is armed would leave it without effect."""
    faults = load_faults(EXAMPLE)
    gateway = Gateway(build_injectors(faults.injectors, faults.plan, faults.seed, 0), faults.plan.cycle_ns)
    control = LiveControl(gateway)
    control.start(0)
    assert control.trigger("dead_sensor", 3_000_000_000)
    assert [row.state for row in control.listing() if row.name == "dead_sensor"] == ["active"]
