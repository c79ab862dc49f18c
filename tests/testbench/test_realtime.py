"""Whole runs against the clock on the hub: their result, and foreign drives. Parity is in tests/parity."""

import json
from pathlib import Path

import pytest

from canopen_exo.bus.lateness import Lateness
from testbench.cli import INVALID, main
from testbench.merge import IncompleteError
from testbench.realtime_run import RealTimeRun, run_once
from testbench.scenario import parse_scenario
from testbench.supervisor import Setup, Supervisor
from tests.parity.patience import Late, Patience, distributions
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
            return Late(why_invalid(output.out) or output.err.strip())
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


def why_invalid(document: str) -> str:
    """The reasons in a result document, and how late each process served its wake-ups; "" when there is none."""
    if not document:
        return ""
    result = json.loads(document)
    late = {
        f"{run}, {name}": Lateness.from_document(one)
        for run in ("golden", "faulted")
        for name, one in result["realtime"][run]["lateness"].items()
    }
    return f"{', '.join(result['invalid_reasons'])}; {distributions(late)}"


def test_limits_that_nothing_can_keep_make_a_run_invalid(patience: Patience) -> None:
    """The limits stand in the scenario: with none allowed, one late cycle is one too many."""
    limits = "realtime={late_share: 0, late_worst: 0 s}"
    scenario = parse_scenario(HUB.text(), overrides=["motion.duration=0.5s", limits])

    def attempt() -> RealTimeRun | Late:
        try:
            return run_once(Setup(scenario, faults=False, keep_parts=True))
        except IncompleteError as error:
            return Late(str(error))

    run = patience.until_punctual(attempt)
    assert run.record.valid == (not run.timing.late and run.record.completed and not run.timing.lost)
    assert not run.timing.lost or run.timing.counted


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
