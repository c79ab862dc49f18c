"""One run of a campaign as one row: against the document of a single run, and golden runs made once."""

import json
from pathlib import Path

import pytest

from fi_gateway.marked_yaml import FileErrors
from testbench.campaign.making.execute import Workshop, make_run
from testbench.campaign.making.executor import FolderError
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


def test_result_folder_that_cannot_be_written_is_an_error_not_a_row(workshop: Workshop, tmp_path: Path) -> None:
    """The run was judged: as crashed or invalid it would leave the shares because a disk is full."""
    (tmp_path / "file").touch()
    one = spec("golden", "motion.duration=0.1 s", keep_traces="always", folder=str(tmp_path / "file" / "1-0"))
    with pytest.raises(FolderError, match=r"^result folder .*1-0: .* is a file; give another place"):
        make_run(one, workshop)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


SILENCE = (
    "injectors={{mute: {{target: {{bus: to_drives, node: right_knee, pdo: RPDO1}}, fault: {{type: drop}}, "
    "event: {{type: at, time: 0.9 s}}, effect: {{type: constant_time, duration: {duration}}}}}}}"
)


@pytest.mark.parametrize(
    ("motion", "duration", "outcome"),
    [
        ("1 s", "0.1 ms", Outcome.NOT_MANIFESTED),
        ("1 s", "10 ms", Outcome.MASKED),
        ("1 s", "80 ms", Outcome.DETECTED_SAFE),
        ("2 s", "80 ms", Outcome.FAILURE_DETECTED),
    ],
)
def test_a_drive_without_commands_is_noticed_after_its_deadline(
    workshop: Workshop, motion: str, duration: str, outcome: Outcome
) -> None:
    """RPDO deadline: 10 cycles, 20 ms; then an EMCY, and the controller ends the motion. A leg without torque swings
    out of its range where there are no pins, so what is safe for 0.1 s is a failure, noticed, after 1 s."""
    row = make_run(spec("golden", SILENCE.format(duration=duration), f"motion.duration={motion}"), workshop)
    assert row.outcome is outcome
    assert row.first_start_s == pytest.approx(0.9, abs=1e-9)
    assert row.first_phase == pytest.approx(0.6, abs=1e-6)
    if duration == "80 ms":
        assert row.detection_latency_s is not None
        assert 0.018 <= row.detection_latency_s <= 0.023, "the last command came up to one cycle before"
    else:
        assert row.detected_s is None
    if outcome is Outcome.FAILURE_DETECTED:
        assert row.failure_s is not None
        assert row.detected_s is not None
        assert row.detected_s < row.failure_s
        assert row.beyond_deg > 0


def test_a_flipped_bit_that_only_exceeds_a_torque_is_an_error(workshop: Workshop) -> None:
    """No limit of travel was passed, and nobody noticed."""
    high = ["injectors.flip_position.fault={type: bit_flip, positions: [17]}", "injectors.flip_position.event.time=1 s"]
    row = make_run(spec("bit_flip", SHORT, *high), workshop)
    assert row.outcome is Outcome.ERROR
    assert (row.failure_s, row.detected_s, row.beyond_deg) == (None, None, 0.0)
    assert row.errors > 0


def test_a_golden_run_that_fails_makes_every_run_invalid(workshop: Workshop) -> None:
    """Nothing can be measured by it, so no faulted run is made."""
    fast = ["motion.stride=0.5 s", "motion.duration=0.6 s"]
    row = make_run(spec("knee_freeze_at", *fast, "injectors.freeze_position.event.time=0.1 s"), workshop)
    assert row.outcome is Outcome.INVALID
    assert "golden run" in row.reason
    assert row.metrics == {}
    assert row.trace_hash == ""
