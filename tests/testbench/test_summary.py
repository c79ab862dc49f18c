"""The JSON contract, and the text for the terminal."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest

from canopen_exo.bus.frame import FLAG_REMOTE, Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import NEVER
from canopen_exo.bus.trace import trace_hash
from fi_gateway.activation import Activation
from hlc.limits import limits_of
from testbench.document import ReplayEntry, Summary
from testbench.errors import BenchError
from testbench.expect import parse_expectation
from testbench.record import RunRecord
from testbench.summary import MOST_LINES, check_finite, summary_document, summary_json, summary_text
from testbench.verdict import judge

RunMaker = Callable[..., RunRecord]
ActivationMaker = Callable[..., Activation]

SIX = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
LIMITS = {joint: limits_of(joint) for joint in SIX}


def document(golden: RunRecord, faulted: RunRecord, expected: Sequence[str] = (), injectors: int = 0) -> Summary:
    lines = [parse_expectation(line, SIX) for line in expected]
    judgement = judge(SIX, LIMITS, golden, faulted, expectations=lines)
    return summary_document(
        "knee_freeze", 2020, golden, faulted, judgement, injectors=injectors, sim_time_s=17.0, wall_time_s=2.0
    )


@pytest.fixture
def failed(run_maker: RunMaker, activation_maker: ActivationMaker) -> Summary:
    faulted = run_maker(bump_rad=2.0, activations=[activation_maker(), activation_maker("zero_velocity", "", 5.0)])
    return document(run_maker(), faulted, ["golden.tracking_rmse < 0.01 rad", "failures == 0"])


def test_document_has_every_key_of_the_contract(failed: Summary) -> None:
    """Design, "Command line": `run --json` prints at least these keys."""
    read = json.loads(summary_json(failed))
    assert set(read) >= {
        *("scenario", "seed", "valid", "verdict", "outcome", "sim_time_s", "wall_time_s", "x_realtime", "bus"),
        *("trace_hash", "injections", "joints", "golden", "errors", "failures"),
    }
    assert set(read["bus"]) == {"controller", "drive"}
    assert all(set(bus) >= {"frames", "load"} for bus in read["bus"].values())
    assert set(read["trace_hash"]) == {"golden", "faulted"}
    assert set(read["injections"][0]) >= {"injector", "start_s", "end_s", "frames", "signal", "cause"}
    assert list(read["joints"]) == list(SIX)
    assert set(read["joints"]["right_knee"]) == {
        *("rmse_position_rad", "rmse_velocity_rad_s", "rmse_torque_nm", "min_angle_deg", "max_angle_deg"),
        *("max_speed_rpm", "max_torque_nm", "held_cycles"),
    }
    assert list(read["golden"]["tracking_rmse_rad"]) == list(SIX)
    assert set(read["failures"][0]) == {"joint", "kind", "time_s", "value", "limit"}
    assert read["errors"][0]["kind"] in ("torque", "speed")


def test_document_says_what_was_judged(failed: Summary) -> None:
    """The verdict, and where its numbers come from."""
    assert (failed["scenario"], failed["seed"], failed["valid"]) == ("knee_freeze", 2020, True)
    assert (failed["verdict"], failed["outcome"]) == ("fail", "failure")
    assert failed["x_realtime"] == 8.5
    assert (failed["time0_s"], failed["power_up_s"]) == (3.000056, 0.0)  # the first frame of these runs is at time 0
    assert [one["met"] for one in failed["expectations"]] == [True, False]
    assert failed["failures"][0]["joint"] == "right_knee"
    assert failed["events"][0]["text"] == "0x8400 velocity"
    assert failed["versions"]["exo-hil"]


def test_injection_times_count_from_time_0(failed: Summary) -> None:
    """Activations carry the loop's clock, the result counts from time 0, exact to the nanosecond."""
    first, second = failed["injections"]
    assert (first["start_s"], first["end_s"], first["frames"], first["frames_seen"]) == (3.0, 3.3, 148, 150)
    assert (first["duration_s"], first["frames_injected"]) == (0.3, 150)
    assert (first["signal"], second["signal"]) == ("right_knee.position", "")
    assert (first["first_before"], first["first_after"]) == ("185#0102030405060708", "185#0000000005060708")
    assert failed["counts"] == {"activated": 2, "injected": 300, "manifested": 296}


def test_window_without_end_and_lost_frame_are_null(run_maker: RunMaker, activation_maker: ActivationMaker) -> None:
    """NEVER is no number of seconds; a lost frame has no bytes."""
    endless = activation_maker(duration_s=NEVER / 1e9)
    endless.first_after = None
    (entry,) = document(run_maker(), run_maker(activations=[endless]))["injections"]
    assert entry["end_s"] is entry["duration_s"] is None
    assert entry["first_after"] is None


def test_power_up_is_the_first_frame_that_a_gateway_counts_from(run_maker: RunMaker) -> None:
    """A classical 11-bit data frame: nothing else starts the times of `from: power_up`."""
    run = run_maker()
    zero = run.time0_ns
    early = [
        Transmission(zero - 9_000, 1, Frame(0x700, b"", FLAG_REMOTE, 1), 0),
        Transmission(zero - 5_000, 1, Frame(0x701, b"\0"), 0),
    ]
    assert document(run, replace(run, rows=[*early, *run.rows]))["power_up_s"] == -5e-6


@pytest.mark.parametrize(("same", "words"), [(True, "the same frames as"), (False, "other frames than")])
def test_text_says_whether_a_replay_gave_the_same_frames(failed: Summary, same: bool, words: str) -> None:
    """A replay that does not repeat the run must not look as if it did."""
    entry: ReplayEntry = {"trace_hash": "0" * 64, "same": same}
    replayed: Summary = {**failed, "replay": entry}
    assert f"replay: {words} in the recorded run" in summary_text(replayed)
    assert "replay" not in summary_text(failed)


def test_trace_hashes_are_those_of_the_rows(run_maker: RunMaker) -> None:
    """The hash in the document is the hash of that run's trace."""
    golden, faulted = run_maker(), run_maker()
    faulted = replace(faulted, rows=faulted.rows[:-1])
    hashes = document(golden, faulted)["trace_hash"]
    assert hashes == {"golden": trace_hash(golden.rows), "faulted": trace_hash(faulted.rows)}
    assert hashes["golden"] != hashes["faulted"]


def test_invalid_reasons_name_the_run(run_maker: RunMaker) -> None:
    """An invalid run says which and why."""
    found = document(run_maker(invalid_reasons=["late"]), run_maker(invalid_reasons=["drive bus: 3 frames lost"]))
    assert not found["valid"]
    assert (found["verdict"], found["outcome"]) == ("fail", "invalid")
    assert found["invalid_reasons"] == ["golden run: late", "faulted run: drive bus: 3 frames lost"]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_number_json_cannot_hold_raises_with_its_place(value: float) -> None:
    """Strict JSON: no NaN, no Infinity, no silent null."""
    with pytest.raises(BenchError, match=r"joints\.right_knee\[1\]\.rmse is"):
        check_finite({"seed": 1, "joints": {"right_knee": [0.0, {"rmse": value}]}})


def test_load_that_is_not_a_number_never_reaches_the_file(run_maker: RunMaker) -> None:
    """A broken statistic stops the document instead of spoiling it."""
    faulted = run_maker()
    broken = replace(faulted, buses=(replace(faulted.buses[0], load=math.nan), faulted.buses[1]))
    with pytest.raises(BenchError, match=r"bus\.controller\.load is nan"):
        document(run_maker(), broken)


def test_json_keeps_every_number_and_letter(failed: Summary) -> None:
    """Reading the text again gives the document."""
    assert json.loads(summary_json(failed)) == failed


def test_text_says_verdict_limits_and_expectations(failed: Summary) -> None:
    """What someone at a terminal needs, first things first."""
    lines = summary_text(failed).splitlines()
    assert lines[0] == "FAIL  knee_freeze, seed 2020: failure, a joint went beyond its range of travel"
    text = "\n".join(lines)
    assert "8.5 x real time" in text
    assert "2 activated, 296 of 300 frames hit" in text
    assert "max angle" in text
    assert "limit 54.9 N m" in text
    assert "not met: failures == 0 (found 1)" in text


@pytest.mark.parametrize(
    ("changed", "lost", "delayed", "inserted", "words", "total"),
    [
        (5, 0, 0, 0, "5 of 150 frames changed  event", "5 of 150 frames hit"),
        (0, 6, 0, 0, "6 of 150 frames lost  event", "6 of 150 frames hit"),
        (0, 0, 7, 0, "7 of 150 frames delayed  event", "7 of 150 frames hit"),
        (1, 2, 3, 0, "6 of 150 frames hit  event", "6 of 150 frames hit"),
        (0, 0, 0, 8, "0 of 150 frames changed, 8 inserted  event", "0 of 150 frames hit, 8 inserted"),
        (1, 0, 0, 8, "1 of 150 frames changed, 8 inserted  event", "1 of 150 frames hit, 8 inserted"),
    ],
)
def test_what_became_of_the_frames_is_counted_and_said(
    run_maker: RunMaker,
    activation_maker: ActivationMaker,
    changed: int,
    lost: int,
    delayed: int,
    inserted: int,
    words: str,
    total: str,
) -> None:
    """frames: all that were hit; each kind by itself; the terminal says it in a word."""
    one = activation_maker()
    one.frames_changed, one.frames_lost, one.frames_delayed, one.frames_inserted = changed, lost, delayed, inserted
    found = document(run_maker(), run_maker(activations=[one]))
    (entry,) = found["injections"]
    assert entry["frames"] == found["counts"]["manifested"] == changed + lost + delayed + inserted
    kinds = (entry["frames_changed"], entry["frames_lost"], entry["frames_delayed"], entry["frames_inserted"])
    assert kinds == (changed, lost, delayed, inserted)
    assert (entry["duration_s"], entry["frames_injected"]) == (0.3, 150)
    text = summary_text(found)
    assert words in text
    assert f"1 activated, {total}\n" in text


def test_text_of_an_invalid_run_is_not_headed_with_a_verdict(failed: Summary) -> None:
    """It proves nothing, so it did not fail either."""
    text = summary_text({**failed, "valid": False, "outcome": "invalid", "invalid_reasons": ["golden run: too late"]})
    assert text.splitlines()[0] == "INVALID  knee_freeze, seed 2020: the run is invalid and proves nothing"


def test_columns_of_the_text_are_aligned(failed: Summary) -> None:
    """The separators of the joint table stand in one column."""
    table = [line for line in summary_text(failed).splitlines() if "|" in line]
    assert len(table) == 1 + len(SIX)
    assert len({line.index("|") for line in table}) == 1


@pytest.mark.parametrize("activations", [0, 1, 3, 40])
@pytest.mark.parametrize("reasons", [0, 5])
def test_text_fits_on_a_terminal_whatever_happened(
    run_maker: RunMaker, activation_maker: ActivationMaker, activations: int, reasons: int
) -> None:
    """At most MOST_LINES lines of at most 100 columns, and it says how much is left out."""
    many = [activation_maker(index=k, start_s=k * 0.1, duration_s=0.05) for k in range(activations)]
    faulted = run_maker(bump_rad=9.0, activations=many, invalid_reasons=[f"reason {k}" for k in range(reasons)])
    faulted.truth.q[2000:2100] += 9.0
    faulted.truth.dq[2000:2100] += 9.0
    lines = ["failures == 0", "errors == 0", "joints.left_hip.max_angle < 1 deg", "joints.left_hip.max_speed < 1 rpm"]
    text = summary_text(document(run_maker(), faulted, lines)).splitlines()
    assert len(text) <= MOST_LINES
    assert max(len(line) for line in text) <= 100
    assert any("more failures, see summary.json" in line for line in text)
    assert any("more expectations not met" in line for line in text)
    assert any("more injections" in line for line in text) is (activations == 40)
    assert any("more reasons" in line for line in text) is (reasons == 5)


def test_text_of_a_run_without_fault_is_short(run_maker: RunMaker) -> None:
    """Nothing happened: nothing is listed."""
    text = summary_text(document(run_maker(), run_maker()))
    assert text.startswith("PASS  knee_freeze, seed 2020: no fault was activated\n")
    assert "injections: none\n" in text
    assert len(text.splitlines()) == 11


@pytest.mark.parametrize(
    ("injectors", "windows", "expected", "words"),
    [
        (2, 0, [], "injectors: 2, none was activated; `expect: [injections >= 1]` makes that a failed verdict"),
        (2, 0, ["failures == 0"], "injectors: 2, none was activated"),
        (2, 1, ["injections >= 1"], "no activation changed a frame; `expect: [manifested >= 1]`"),
        (2, 0, ["injections == 0"], ""),
        (2, 1, ["manifested == 0"], ""),
        (0, 0, [], ""),
    ],
)
def test_a_pass_in_which_no_fault_acted_is_headed_so(
    run_maker: RunMaker,
    activation_maker: ActivationMaker,
    injectors: int,
    windows: int,
    expected: list[str],
    words: str,
) -> None:
    """Only with injectors, and where no `expect:` line says what is wanted; the verdict stays pass."""
    activation = activation_maker()
    activation.frames_changed = activation.frames_lost = activation.frames_delayed = activation.frames_inserted = 0
    found = document(run_maker(), run_maker(activations=[activation] * windows), expected, injectors)
    assert found["verdict"] == "pass"
    lines = summary_text(found).splitlines()
    assert lines[0].startswith("PASS (no fault acted)  knee_freeze, seed 2020" if words else "PASS  knee_freeze")
    assert (words or "simulated in") in lines[1]
    assert max(len(line) for line in lines) <= 100


def test_an_invalid_run_is_headed_invalid_alone(run_maker: RunMaker) -> None:
    """Whether a fault acted does not matter then, and an expectation would change nothing."""
    found = document(run_maker(), run_maker(), [], 2)
    found["valid"] = False
    text = summary_text(found)
    assert text.startswith("INVALID  ")
    assert "injections >= 1" not in text


@pytest.mark.parametrize("line", ["injections >= 1", "manifested >= 1"])
def test_an_expectation_that_a_fault_acts_fails_a_run_in_which_none_did(run_maker: RunMaker, line: str) -> None:
    """What CI reads is the exit code."""
    found = document(run_maker(), run_maker(), [line], 1)
    assert found["verdict"] == "fail"
    text = summary_text(found)
    assert text.startswith("FAIL  knee_freeze, seed 2020: no fault was activated; 1 of 1 expectations not met\n")
