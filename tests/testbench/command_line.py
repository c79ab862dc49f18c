"""The program as a command, the scenarios it is tried on, and what stands in a folder."""

import subprocess
import sys
from pathlib import Path

import pytest

import testbench.cli
import testbench.run
from testbench.store import default_folder

ROOT = Path(__file__).parents[2]
SCENARIOS = ROOT / "scenarios"
KNEE = str(SCENARIOS / "knee_freeze_at.yaml")
GOLDEN = str(SCENARIOS / "golden.yaml")

# A short motion with a whole fault window in it.
SHORT = ["--seed", "7"]
for override in (
    "motion.duration=0.5s",
    "injectors.freeze_position.event.time=0.1s",
    "injectors.freeze_position.effect.duration=0.2s",
    "injectors.zero_velocity.effect.duration=0.2s",
):
    SHORT += ["--set", override]
RESULT = default_folder("knee_freeze_at", 7, SHORT[3::2]).name

# The program, with the interrupt key at work also where this test runs in the background of a shell.
PROGRAM = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from testbench.cli import main; sys.exit(main())"
)


def exo_hil(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The program in a process of its own, started in `folder`."""
    command = [sys.executable, "-c", PROGRAM, *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def forbid_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulation must not be reached."""

    def run(*arguments: object) -> None:
        raise AssertionError("the scenario was run")

    monkeypatch.setattr(testbench.run, "run_scenario", run)
