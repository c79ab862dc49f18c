"""Whole runs against the clock on the hub: their result, and foreign drives. Parity is in tests/parity."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

from canopen_exo.bus.node import MS, NEVER
from testbench import realtime_run
from testbench.cli import INVALID, main
from testbench.realtime_run import RealTimeRun
from testbench.scenario import parse_scenario
from testbench.supervisor import Setup, Supervisor
from tests.parity.patience import Late, Patience, is_lateness, why_invalid
from tests.parity.walks import Bench, attempt_run, in_lock_step

pytestmark = pytest.mark.realtime

HUB = Bench(None, 100)

# --- the result ------------------------------------------------------------------------------------------------------


def test_run_realtime_gives_the_document_of_lock_step_and_how_well_it_kept_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], patience: Patience
) -> None:
    """Design: the same result document; additional keys say source, late cycles, and the limits in force."""
    file = tmp_path / "scenario.yaml"
    file.write_text(HUB.text() + "realtime: {late_share: 2 %, late_worst: 15 ms}\n")
    shorter = ["--set", "motion.duration=1s", "--json", "--out", str(tmp_path / "result")]

    def attempt() -> str | Late:
        code = main(["run", "--realtime", str(file), *shorter])
        output = capsys.readouterr()
        if code == INVALID:
            found = json.loads(output.out) if output.out else {}
            reasons = found.get("invalid_reasons") or output.err.splitlines()[-1:]
            assert is_lateness(reasons, HUB.cycle_ns / 1e6), (reasons, output.err)
            return Late(why_invalid(found) or output.err.strip())
        assert code == 0, output.err
        return output.out

    document = json.loads(patience.until_punctual(attempt))
    assert main(["run", str(file), *shorter]) == 0
    reference = json.loads(capsys.readouterr().out)
    assert list(document) == [*(key for key in reference if key != "versions"), "versions", "realtime"]
    assert (document["verdict"], document["outcome"], document["source"]) == ("pass", "not_activated", "plant")
    timing = document["realtime"]
    assert timing["limits"] == {"late_share": 0.02, "late_worst_ms": 15.0}
    assert timing["cycles"] == 200
    for name in ("golden", "faulted"):
        assert set(timing[name]["lateness"]) == {"hlc", "joints", "gateway"}
        assert timing[name]["lateness"]["joints"]["count"] > 1000  # a wake-up each ms
        assert set(timing[name]["latency"]) == {"controller", "drive"}
        assert timing[name]["latency"]["drive"]["count"] > 1000  # SYNC and six commands a cycle
    files = {path.name for path in (tmp_path / "result").iterdir()}
    assert files >= {"summary.json", "scenario.yaml", "controller.log", "drive.log", "golden.parquet", "joints.png"}


@pytest.mark.parametrize("name", ["joints", "gateway"])
def test_process_that_is_held_up_for_some_cycles_makes_a_run_invalid(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit 3, and the reason is lateness: one late cycle is one too many where the scenario allows none."""
    file = tmp_path / "scenario.yaml"
    file.write_text(HUB.text() + "realtime: {late_share: 0, late_worst: 0 s}\n")
    rigs: list[Supervisor] = []
    held: list[int] = []

    def hold_up(now: int) -> None:
        """In the golden run from 50 ms after time 0: stopped, and let go at the first look 30 ms later."""
        rig = rigs[0]
        zero = rig.watch.time_zero
        if not held and zero < NEVER and now > zero + 50 * MS:
            os.kill(rig.processes[name].pid, signal.SIGSTOP)
            held.append(now)
        elif len(held) == 1 and now >= held[0] + 30 * MS:
            os.kill(rig.processes[name].pid, signal.SIGCONT)
            held.append(now)

    def supervised(setup: Setup, **given: Any) -> Supervisor:
        rigs.append(Supervisor(setup, tick=hold_up if not rigs else lambda now: None, **given))
        return rigs[-1]

    monkeypatch.setattr(realtime_run, "Supervisor", supervised)
    out = ["--set", "motion.duration=0.5s", "--json", "--out", str(tmp_path / "result")]
    assert main(["run", "--realtime", str(file), *out]) == INVALID
    assert len(held) == 2
    output = capsys.readouterr()
    if output.out:  # else the drives have given up for want of SYNC, before the motion was as long as the plant's
        document = json.loads(output.out)
        assert document["realtime"]["golden"]["late_cycles"] > 0
        assert any(reason.startswith("golden run: ") and " late " in reason for reason in document["invalid_reasons"])
    else:
        assert "wake-ups served late" in output.err


# --- foreign drives --------------------------------------------------------------------------------------------------


def test_metrics_of_foreign_drives_come_from_frames(patience: Patience) -> None:
    """Without our plant the metrics come from frames and say `source: bus`; our own joints play the foreign ones."""
    scenario = parse_scenario(HUB.text(), overrides=["motion.duration=1s"])

    def attempt() -> RealTimeRun | Late:
        with Supervisor(Setup(scenario)) as foreign:
            foreign.start(["joints"])
            return attempt_run(Setup(scenario, foreign.buses, frozenset({"joints"}), faults=False, keep_parts=True))

    run = patience.until_punctual(attempt)
    assert run.record.source == "bus"
    wanted = in_lock_step(HUB.scenario()).truth
    assert run.record.truth.t_s.tolist() == wanted.t_s[:1001].tolist()
    # straight lines between samples 10 ms apart, stamped up to a frame time late, and what real time adds
    assert abs(run.record.truth.q[20:-20] - wanted.q[20:981]).max() < 0.04
