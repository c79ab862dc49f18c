"""One run of a campaign as one row: against the document of a single run, and golden runs made once."""

import json
from pathlib import Path

import pytest

from fi_gateway.marked_yaml import FileErrors
from testbench.campaign.execute import Workshop, make_run
from testbench.campaign.records import Outcome
from testbench.run import run_scenario
from testbench.scenario import load_scenario
from tests.testbench.campaign.specs import SCENARIOS, spec

SHORT = "motion.duration=2 s"
pytestmark = pytest.mark.run


@pytest.fixture(scope="module")
def workshop() -> Workshop:
    return Workshop()


def test_a_row_says_what_the_document_of_the_single_run_says(workshop: Workshop) -> None:
    """Metrics, counts, injections and hashes of `exo-hil run --json`, number for number."""
    row = make_run(spec("knee_freeze", SHORT), workshop)
    document = run_scenario(load_scenario(SCENARIOS / "knee_freeze.yaml", ["seed=1", SHORT])).document
    joints = document["joints"].items()
    assert row.metrics == {f"{joint}.{key}": value for joint, one in joints for key, value in one.items()}
    assert {"activated": row.activated, "injected": row.injected, "manifested": row.manifested} == document["counts"]
    assert (row.golden_hash, row.trace_hash) == (document["trace_hash"]["golden"], document["trace_hash"]["faulted"])
    assert (row.errors, row.failures) == (len(document["errors"]), len(document["failures"]))
    assert row.failures_at_3deg == len(document["failures_at_3deg"])
    keys = ("injector", "index", "start_s", "end_s", "duration_s", "frames", "signal", "cause")
    assert [{key: getattr(one, key) for key in keys} for one in row.injections] == [
        {key: one[key] for key in keys} for one in document["injections"]  # type: ignore[literal-required]
    ]
    assert row.outcome is Outcome.FAILURE_SILENT
    assert document["outcome"] == "failure"
    assert row.failure_s == document["failures"][0]["time_s"]
    assert row.ended_s == document["duration_s"]


def test_the_golden_run_is_made_once_per_process_and_setting() -> None:
    """Whatever the faults and the seed; pins, motion or rate need another one."""
    own = Workshop()
    for seed in (1, 2):
        make_run(spec("bit_flip", "motion.duration=0.1 s", seed=seed), own)
    make_run(spec("knee_freeze", "motion.duration=0.1 s"), own)
    assert own.made == 1
    make_run(spec("knee_freeze", "motion.duration=0.1 s", "rig.stops=on"), own)
    assert own.made == 2
    make_run(spec("bit_flip", "motion.duration=0.1 s", "rig.rate=250 Hz"), own)
    assert own.made == 3


def test_a_scenario_that_cannot_be_read_is_an_error_not_a_row(workshop: Workshop) -> None:
    """Bad campaign files fail; no run may stand for one."""
    good = spec("golden")
    bad = type(good)(**{name: getattr(good, name) for name in good.__slots__} | {"scenario": "name: x\n"})
    with pytest.raises(FileErrors):
        make_run(bad, workshop)


def test_a_run_whose_motion_never_begins_is_invalid_and_says_why(workshop: Workshop, tmp_path: Path) -> None:
    """What proves nothing has no metrics, and a reason."""
    silent = (
        "injectors={mute: {target: {bus: to_controller, node: right_knee, kind: sdo_answer}, fault: {type: drop}, "
        "event: {type: at, times: [0 s]}, effect: {type: infinite}, from: power_up}}"
    )
    row = make_run(spec("golden", silent, "motion.duration=0.1 s"), workshop)
    assert row.outcome is Outcome.INVALID
    assert "the motion never began" in row.reason
    assert row.metrics == {}


def test_traces_are_kept_as_a_result_folder_when_asked_for(workshop: Workshop, tmp_path: Path) -> None:
    """The same files as `exo-hil run`; "failures" keeps those of failing runs only."""
    failing = make_run(spec("knee_freeze", SHORT, keep_traces="failures", folder=str(tmp_path / "one")), workshop)
    masked = make_run(spec("bit_flip", SHORT, keep_traces="failures", folder=str(tmp_path / "two")), workshop)
    assert failing.outcome is Outcome.FAILURE_SILENT
    assert masked.outcome not in (Outcome.FAILURE_SILENT, Outcome.FAILURE_DETECTED)
    assert [path.name for path in tmp_path.iterdir()] == ["one"]
    summary = json.loads((tmp_path / "one" / "summary.json").read_text(encoding="utf-8"))
    assert summary["trace_hash"]["faulted"] == failing.trace_hash
    assert (tmp_path / "one" / "joints.png").is_file()
