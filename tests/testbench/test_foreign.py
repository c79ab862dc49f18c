"""Whole runs with foreign software in the place of one part: `exo-hil run --realtime --without ...`, as a user does it.

What is foreign starts when the run says what it waits for, and where. At 100 Hz on an own hub.
"""

import json
import math
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from testbench.cli import main
from tests.parity.patience import Late, Patience, is_lateness, why_invalid
from tests.testbench.foreign import Drives

pytestmark = pytest.mark.realtime

CYCLE_MS = 10.0

BASE = """\
name: foreign
rig: {plant: suspended, stops: on, rate: 100 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 1 s}
tolerance: 5 deg
"""
NO_TORQUE = """\
injectors:
  no_torque:
    target: {bus: to_drives, node: right_knee, signal: target_torque}
    fault: {type: stuck_at_value, value: 0 N m}
    event: {type: at, time: 0.3 s}
    effect: {type: constant_time, duration: 0.5 s}
"""
BIAS = """\
injectors:
  bias:
    target: {bus: to_controller, node: right_knee, signal: position}
    fault: {type: bias, value: 0.1 rad}
    event: {type: at, time: 0.3 s}
    effect: {type: constant_time, duration: 0.5 s}
"""

PROGRAM = Path(__file__).with_name("foreign.py")


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of one `exo-hil run`. document: {} when there is none; said: by the run; foreign: what foreign programs said."""

    code: int
    document: dict[str, Any]
    said: list[str]
    foreign: str


def run(folder: Path, text: str, part: str, wanted: Callable[[str], list[str] | None]) -> Outcome:
    """One run without that part. wanted: the program to start at a line of the run, which ends the one before it."""
    (folder / "scenario.yaml").write_text(text)
    command = [sys.executable, "-m", "testbench.cli", "run", "--realtime", "--json", "--without", part, "scenario.yaml"]
    command += ["--listen", "127.0.0.1:0", "--control", str(folder / "control"), "--out", str(folder / "result")]
    said: list[str] = []
    programs: list[subprocess.Popen[bytes]] = []
    out, foreign = folder / "stdout", folder / "foreign"
    with out.open("w") as file, foreign.open("wb") as words, ExitStack() as ending:
        started = ending.enter_context(
            subprocess.Popen(command, cwd=folder, stdout=file, stderr=subprocess.PIPE, text=True)
        )
        ending.callback(started.kill)
        assert started.stderr is not None
        for line in started.stderr:
            said.append(line.rstrip())
            program = wanted(said[-1])
            if program is not None:
                for one in programs:
                    one.kill()
                programs.append(subprocess.Popen([sys.executable, *program], stdout=words, stderr=words))
                ending.enter_context(programs[-1])
                ending.callback(programs[-1].kill)
        code = started.wait()
    found = out.read_text()
    return Outcome(code, json.loads(found) if found else {}, said, foreign.read_text())


def late_or(outcome: Outcome) -> Outcome | Late:
    """The outcome of a valid run; what a machine that is too busy does to one is Late, anything else fails."""
    if outcome.code != 3:
        return outcome
    reasons = outcome.document.get("invalid_reasons") or outcome.said[-1:]
    # a foreign program that says so itself was not served in time either
    assert is_lateness(reasons, CYCLE_MS) or "NotInTimeError" in outcome.foreign, outcome
    return Late(why_invalid(outcome.document) or "; ".join(outcome.said))


# --- foreign controller ----------------------------------------------------------------------------------------------


def test_run_with_a_canopen_master_for_the_controller(tmp_path: Path, patience: Patience) -> None:
    """A test replaces the HLC by a `canopen` master: both runs, an injection, and metrics of our plant."""
    control = str(tmp_path / "control")

    def master(line: str) -> list[str] | None:
        found = re.fullmatch(r"(?:golden|faulted) run: ready for a controller on hub:(\S+): time 0 is .*", line)
        if found is None:
            return None
        assert f"`exo-hil fault start --at {control}`" in line
        return [str(PROGRAM), "master", found[1], control]

    outcome = patience.until_punctual(lambda: late_or(run(tmp_path, BASE + NO_TORQUE, "hlc", master)))
    document = outcome.document
    assert (outcome.code, document["source"], document["valid"]) == (0, "plant", True), outcome
    (injection,) = document["injections"]
    assert (injection["injector"], injection["signal"]) == ("no_torque", "right_knee.target_torque")
    assert document["golden"]["tracking_rmse_rad"] == {}  # what it follows is its own business
    # 15 % of 54.9 N m hold the knee flexed; without them it falls back
    assert document["joints"]["right_knee"]["rmse_torque_nm"] > 2.0
    assert document["joints"]["right_knee"]["rmse_position_rad"] > 0.01
    assert document["joints"]["left_knee"]["rmse_torque_nm"] < 1.0


# --- foreign drives --------------------------------------------------------------------------------------------------


def test_run_with_foreign_drives_takes_its_metrics_from_frames(tmp_path: Path, patience: Patience) -> None:
    """Without our plant the metrics come from frames and say `source: bus`: the angles that the drives sent."""

    def drives(line: str) -> list[str] | None:
        found = re.fullmatch(r"golden run: waiting for drives on hub:(\S+): they must answer SDO requests", line)
        return None if found is None else [str(PROGRAM), "drives", found[1]]

    outcome = patience.until_punctual(lambda: late_or(run(tmp_path, BASE + BIAS, "joints", drives)))
    document = outcome.document
    assert (outcome.code, document["source"], document["valid"]) == (0, "bus", True), outcome
    for name, joint in document["joints"].items():
        mean_deg = -30.0 if name.endswith("knee") else 0.0
        # sampled 50 times a swing: the extreme is missed by 10 deg x (1 - cos(pi / 50)), far below 0.1 deg
        assert joint["max_angle_deg"] == pytest.approx(mean_deg + 10.0, abs=0.1)
        assert joint["min_angle_deg"] == pytest.approx(mean_deg - 10.0, abs=0.1)
        rpm = math.radians(10.0) * math.tau / Drives.SWING_S * 60 / math.tau
        assert joint["max_speed_rpm"] == pytest.approx(rpm, rel=0.02)
    (injection,) = document["injections"]  # on the way to the controller: not in what the drives say of themselves
    assert (injection["injector"], injection["signal"]) == ("bias", "right_knee.position")
    assert document["golden"]["tracking_rmse_rad"]["right_knee"] > 0.01  # they do not follow


# --- foreign gateway -------------------------------------------------------------------------------------------------


def test_run_with_can_bridge_for_the_gateway(tmp_path: Path, patience: Patience) -> None:
    """python-can's can_bridge stands between the buses; the supervisor hears both; there are no activations."""

    def bridge(line: str) -> list[str] | None:
        found = re.fullmatch(r"golden run: waiting for a gateway between hub:(\S+) and hub:(\S+): it must .*", line)
        if found is None:
            return None
        one, other = (
            [f"--bus{number}-interface", "hub", f"--bus{number}-channel", channel]
            for number, channel in enumerate(found.groups(), 1)
        )
        return ["-m", "can.bridge", *one, *other]

    outcome = patience.until_punctual(lambda: late_or(run(tmp_path, BASE + BIAS, "gateway", bridge)))
    document = outcome.document
    assert (outcome.code, document["source"], document["valid"]) == (0, "plant", True), outcome
    assert "injectors bias: not used, the gateway is left out" in outcome.said
    assert (document["injectors"], document["injections"]) == (0, [])
    assert document["golden"]["tracking_rmse_rad"]["right_knee"] < 0.03
    for bus in ("controller", "drive"):
        assert document["bus"][bus]["frames"] > 100 * (1 + 6 + 6)
    assert document["realtime"]["golden"]["not_judged"] == ["gateway: foreign: what it delays and adds"]
    assert document["realtime"]["faulted"]["not_judged"] == ["gateway: foreign: what it loses, delays and adds"]
    log = (tmp_path / "result" / "drive.log").read_text().splitlines()
    assert any(" 205#" in line for line in log)
    assert any(" 185#" in line for line in log)


def test_run_with_a_gateway_that_loses_frames_is_invalid(tmp_path: Path, patience: Patience) -> None:
    """Every tenth answer of the right knee goes in and does not come out: in a golden run there is no reason to."""

    def bridge(line: str) -> list[str] | None:
        found = re.fullmatch(r"golden run: waiting for a gateway between hub:(\S+) and hub:(\S+): it must .*", line)
        return None if found is None else [str(PROGRAM), "bridge", *found.groups()]

    def attempt() -> Outcome | Late:
        outcome = run(tmp_path, BASE, "gateway", bridge)
        assert outcome.code == 3, outcome
        return outcome if outcome.document else late_or(outcome)

    outcome = patience.until_punctual(attempt)
    reasons = outcome.document["invalid_reasons"]
    assert any("foreign gateway, frames to the controller: lost: 185 (" in reason for reason in reasons), outcome


# --- what cannot be had ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("part", "line", "needed"),
    [
        ("hlc", "golden.tracking_rmse < 0.02 rad", "controller"),
        ("hlc", "golden.tracking_rmse.right_knee < 0.02 rad", "controller"),
        ("gateway", "injections >= 1", "gateway"),
        ("gateway", "manifested >= 1", "gateway"),
    ],
)
def test_expectation_that_needs_the_part_left_out_is_refused(
    tmp_path: Path, part: str, line: str, needed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything starts: which line, and what to do."""
    file = tmp_path / "scenario.yaml"
    file.write_text(f"{BASE}{BIAS}expect: ['{line}']\n")
    code = main(["run", "--realtime", "--without", part, str(file), "--out", str(tmp_path / "result")])
    said = capsys.readouterr().err
    assert f"expect: {line!r} needs our {needed}, and it is left out; remove one of them" in said
    assert code == 2
    assert not (tmp_path / "result").exists()


@pytest.mark.parametrize("verb", [["run", "--realtime"], ["up"]])
def test_gait_phase_without_our_controller_is_refused(
    tmp_path: Path, verb: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """design.md: with a foreign master gait_phase is refused, before anything starts."""
    file = tmp_path / "scenario.yaml"
    file.write_text(BASE + BIAS.replace("{type: at, time: 0.3 s}", "{type: gait_phase, phase: 30 %}"))
    place = ["--out", str(tmp_path / "result")] if verb[0] == "run" else []
    assert main([*verb, "--without", "hlc", str(file), *place]) == 2
    assert "waits for what our controller says on the bus (gait_phase" in capsys.readouterr().err
    assert not (tmp_path / "result").exists()
