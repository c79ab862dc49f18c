"""Wire faults in scenarios: what they do to the rig, what is recorded, and what they leave alone."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from canopen_exo.bus.frame import FLAG_ERROR
from canopen_exo.bus.medium import Transmission
from testbench.cli import main
from testbench.document import InjectionEntry
from testbench.record import RunRecord
from testbench.rig import DRIVE_BUS
from testbench.run import Result, run_scenario
from testbench.scenario import Scenario, load_scenario, parse_scenario
from testbench.summary import summary_text

FOLDER: Final = Path(__file__).parents[2] / "scenarios" / "faults"

HEAD: Final = """\
name: wire
rig: {plant: suspended, stops: off, rate: 500 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 1 s}
seed: 7
injectors:
"""


def scenario_of(*injectors: str) -> Scenario:
    """One second of walking with these injectors."""
    return parse_scenario(HEAD + "".join(f"  {one}\n" for one in injectors))


def injector(name: str, target: str, fault: str, when: str = "{type: at, time: 0.5 s}", more: str = "") -> str:
    effect = "effect: {type: once}" if "effect" not in more else ""
    rest = ", ".join(part for part in (effect, more) if part)
    return f"{name}: {{target: {target}, fault: {fault}, event: {when}, {rest}}}"


def found(result: Result, name: str) -> InjectionEntry:
    return next(one for one in result.document["injections"] if one["injector"] == name)


def rows(record: RunRecord) -> list[tuple[int, int, str]]:
    return [(row.end_ns, row.bus, repr(row.frame)) for row in record.rows]


def error_rows(record: RunRecord) -> list[Transmission]:
    return [row for row in record.rows if row.frame.flags & FLAG_ERROR]


pytestmark = pytest.mark.run


def test_a_run_up_to_the_first_disturbed_attempt_is_the_golden_one() -> None:
    """A bus on which errors can happen, and do not yet, has the same frames at the same times."""
    flip = injector("flip", "{pdo: TPDO1, node: left_hip}", "{type: bit_error, field: crc}")
    result = run_scenario(scenario_of(flip))
    golden, faulted = rows(result.golden), rows(result.faulted)
    first = next(at for at, pair in enumerate(zip(golden, faulted, strict=False)) if pair[0] != pair[1])
    error = error_rows(result.faulted)[0]
    assert faulted[first] == (error.end_ns, error.bus, repr(error.frame))
    activation = result.faulted.activations[0]
    assert first > 1000
    assert activation.start_ns < error.end_ns == activation.first_ns
    assert error.bus == DRIVE_BUS
    assert len(error_rows(result.faulted)) == 1  # once: one attempt, then the retransmission passes


def test_attempts_are_counted_and_the_first_disturbed_frame_is_recorded() -> None:
    """Three attempts of one frame, then it passes: nothing is lost."""
    more = "effect: {type: frames, n: 3}"
    one = injector("flip", "{pdo: TPDO1, node: left_hip}", "{type: bit_error, field: data, bit: 9}", more=more)
    result = run_scenario(scenario_of(one))
    entry = found(result, "flip")
    assert (entry["attempts_seen"], entry["attempts_disturbed"], entry["frames"]) == (3, 3, 3)
    assert (entry["frames_seen"], entry["frames_changed"], entry["frames_lost"]) == (0, 0, 0)
    assert (entry["first_before"] or "").startswith("181#")
    assert entry["first_after"] is None
    assert entry["signal"] == "left_hip.TPDO1@drive"
    assert result.document["counts"] == {"activated": 1, "injected": 3, "manifested": 3}
    assert "3 of 3 attempts disturbed" in summary_text(result.document)
    sent = [[row.frame for row in run.rows if row.frame.can_id == 0x181] for run in (result.golden, result.faulted)]
    assert len(sent[0]) == len(sent[1])


def test_a_missing_acknowledgement_that_another_node_gives_disturbs_nothing() -> None:
    """Of seven nodes one is silent: injected, never manifested. Nobody's acknowledgement is an error."""
    more = "effect: {type: constant_time, duration: 20 ms}"
    quiet = injector("one", "{pdo: TPDO1}", "{type: no_ack, receivers: [gateway]}", more=more)
    all_ = injector("all", "{pdo: TPDO1, node: left_hip}", "{type: no_ack}", "{type: at, time: 0.7 s}", more)
    result = run_scenario(scenario_of(quiet, all_))
    one, everybody = found(result, "one"), found(result, "all")
    assert one["attempts_seen"] == 60  # 20 ms of six drives at 500 Hz
    assert one["attempts_disturbed"] == 0
    assert everybody["attempts_disturbed"] > 10
    assert everybody["attempts_seen"] - everybody["attempts_disturbed"] <= 1  # the last one's ACK slot comes after


def test_a_wire_fault_triggers_a_payload_fault_and_is_triggered_by_one() -> None:
    """manifested -> bias -> ended -> a wire fault again, on the other bus."""
    result = run_scenario(
        scenario_of(
            injector("flip", "{kind: sync}", "{type: bit_error, field: crc, bit: 1}"),
            injector("bias", "{bus: to_controller, node: left_hip, signal: position}", "{type: bias, value: 1 deg}",
                     "{type: never}", "trigger: {any: [flip], on: manifested}"),
            injector("back", "{wire: controller, kind: sync}", "{type: bit_error, field: crc, bit: 1}",
                     "{type: never}", "trigger: {any: [bias], on: ended}"),
        )
    )  # fmt: skip
    flip, bias, back = (found(result, name) for name in ("flip", "bias", "back"))
    assert flip["first_frame_s"] == bias["start_s"]
    assert (bias["cause"], bias["frames_changed"]) == ("trigger:flip", 1)
    assert (back["cause"], back["start_s"], back["attempts_disturbed"]) == ("trigger:bias", bias["end_s"], 1)
    assert [row.bus for row in error_rows(result.faulted)] == [1, 0]


def test_noise_draws_from_its_own_stream_only() -> None:
    """Same seed, same hash; another injector beside it changes no draw of the noise; another seed changes it."""
    noise = injector("noise", "{}", "{type: bit_error_rate, rate: 1e-5}", more="effect: {type: infinite}")
    other = injector("other", "{bus: both, cob_id: 0x7FF}", "{type: drop, probability: 50 %}", more="from: power_up")
    first, again = run_scenario(scenario_of(noise)), run_scenario(scenario_of(noise))
    beside = run_scenario(scenario_of(other, noise))
    assert first.document["trace_hash"] == again.document["trace_hash"] == beside.document["trace_hash"]
    assert found(first, "noise")["attempts_disturbed"] > 0
    changed = scenario_of(noise)
    seeded = run_scenario(parse_scenario(changed.resolved_yaml(), "seeded", ["seed=8"]))
    assert seeded.document["trace_hash"]["faulted"] != first.document["trace_hash"]["faulted"]


def test_a_drive_that_goes_bus_off_says_8140_and_the_controller_ends_the_motion() -> None:
    """It is back 100 ms and 128 x 11 recessive bits after the window opened."""
    result = run_scenario(load_scenario(FOLDER / "knee_bus_off.yaml"))
    document = result.document
    assert document["valid"]
    assert not document["completed"]
    (told,) = [one for one in document["events"] if "8140" in one["text"]]
    assert told["node"] == "right_knee"
    assert 1.1 + 0.001408 < told["time_s"] < 1.11
    entry = found(result, "knee_off")
    assert (entry["start_s"], entry["end_s"], entry["attempts_disturbed"]) == (1.0, 1.08, 1)


def test_a_drive_that_stays_bus_off_is_lost_by_its_heartbeat() -> None:
    """Without an end it is never asked to restart. (From power-up: the end of the motion would end it.)"""
    more = "effect: {type: infinite}, from: power_up"
    off = injector("off", "{node: left_knee}", "{type: bus_off}", "{type: at, time: 2.2 s}", more)
    document = run_scenario(scenario_of(off)).document
    assert 0 < document["injections"][0]["start_s"] < 1
    kinds = {(one["node"], one["kind"]) for one in document["events"]}
    assert ("left_knee", "heartbeat_lost") in kinds
    assert not any("8140" in one["text"] for one in document["events"])


def test_a_babbling_idiot_starves_its_bus_while_it_babbles() -> None:
    """Id 0 wins every arbitration: nothing else passes until it falls silent; the run stays valid."""
    result = run_scenario(load_scenario(FOLDER / "babbling_idiot.yaml"))
    entry = found(result, "babble")
    zero = result.faulted.time0_ns
    start, end = (zero + round(1e9 * (entry[key] or 0)) for key in ("start_s", "end_s"))
    longest = 135_000  # a frame that was on the wire when it began
    inside = [r for r in result.faulted.rows if r.bus == DRIVE_BUS and start + longest < r.end_ns <= end]
    assert {row.frame.can_id for row in inside} == {0}
    assert len(inside) > 500
    idle = [r for r in result.faulted.rows if r.bus == DRIVE_BUS and r.frame.can_id == 0 and r.frame.dlc == 0]
    assert entry["frames_inserted"] == len(idle)
    assert result.document["valid"]
    assert not result.document["completed"]


def test_a_short_circuit_stops_its_bus_for_its_window() -> None:
    """No frame ends within it; afterwards everybody goes on."""
    more = "effect: {type: constant_time, duration: 3 ms}"
    result = run_scenario(scenario_of(injector("short", "{}", "{type: stuck_dominant}", more=more)))
    one = result.faulted.activations[0]
    inside = [
        row for row in result.faulted.rows
        if row.bus == DRIVE_BUS and one.start_ns + 135_000 < row.end_ns <= one.end_ns and not row.frame.flags
    ]  # fmt: skip
    assert inside == []
    assert one.manifested > 0
    assert max(row.end_ns for row in result.faulted.rows if row.bus == DRIVE_BUS) > one.end_ns + 400_000_000


def test_an_overload_frame_is_a_disturbed_attempt() -> None:
    """`once` ends with it; nobody repeats anything, and it is told."""
    fault = "{type: bit_error, field: eof, bit: 6, receivers: [left_knee]}"
    result = run_scenario(scenario_of(injector("overload", "{pdo: TPDO1, node: right_knee}", fault)))
    entry = found(result, "overload")
    assert (entry["attempts_seen"], entry["attempts_disturbed"]) == (1, 1)
    assert [row.frame.can_id for row in error_rows(result.faulted)] == [0x20000208]
    assert len(result.faulted.rows) == len(result.golden.rows) + 1


def test_a_bus_off_that_overlaps_another_one_lasts_until_both_are_over() -> None:
    """The drive is back after the end of the longer window, not of the shorter one."""
    first = injector("short", "{wire: drive, node: right_knee}", "{type: bus_off}", "{type: at, time: 0.2 s}",
                     "effect: {type: constant_time, duration: 10 ms}")  # fmt: skip
    second = injector("long", "{wire: drive, node: right_knee}", "{type: bus_off}", "{type: at, time: 0.205 s}",
                      "effect: {type: constant_time, duration: 80 ms}")  # fmt: skip
    result = run_scenario(scenario_of(first, second))
    (told,) = [one for one in result.document["events"] if "8140" in one["text"]]
    assert told["time_s"] > 0.285 + 0.001408
    assert [found(result, name)["attempts_disturbed"] for name in ("short", "long")] == [1, 1]


def test_idle_bits_that_are_disturbed_count_as_an_attempt() -> None:
    """Never more attempts disturbed than seen."""
    more = "effect: {type: constant_time, duration: 3 ms}"
    result = run_scenario(scenario_of(injector("short", "{}", "{type: stuck_dominant}", more=more)))
    entry = found(result, "short")
    assert 0 < entry["attempts_disturbed"] <= entry["attempts_seen"]


def test_two_nodes_that_send_one_id_collide_also_without_a_wire_fault() -> None:
    """A forged frame while the drive sends its own with that id: bit errors, and the run is valid."""
    fault = "{type: insert, cob_id: 0x185, payload: '01 02 03 04 05 06 07 08', every: 100 us}"
    more = "effect: {type: constant_time, duration: 2 ms}"
    forge = injector("forge", "{bus: to_drives, cob_id: 0x205}", fault, "{type: at, time: 0.2 s}", more)
    result = run_scenario(scenario_of(forge))
    assert result.document["valid"], result.document["invalid_reasons"]
    assert any(row.bus == DRIVE_BUS for row in error_rows(result.faulted))
    assert any("8120" in one["text"] for one in result.document["events"])


@pytest.mark.parametrize(
    ("target", "fault", "duration"),
    [
        ("{bus: to_drives, cob_id: 0x205}", "{type: insert, cob_id: 0x001, payload: '00', every: 50 us}", "50 ms"),
        ("{bus: to_controller, pdo: TPDO1}", "{type: delay, law: {type: exponential, mean: 50 ms}}", "0.5 s"),
    ],
)
def test_frames_that_full_queues_lose_because_of_a_fault_are_told_and_the_run_is_valid(
    target: str, fault: str, duration: str
) -> None:
    """Frames in addition, or held back and released at once."""
    more = f"effect: {{type: constant_time, duration: {duration}}}"
    result = run_scenario(scenario_of(injector("flood", target, fault, "{type: at, time: 0.2 s}", more)))
    document = result.document
    lost = {name: bus["queue_overflows"] for name, bus in document["bus"].items() if bus["queue_overflows"]}
    assert document["valid"], document["invalid_reasons"]
    assert lost
    for name, count in lost.items():
        assert f"{name} bus: {count} frames lost in full transmit queues, as faults had it" in summary_text(document)


def test_an_ideal_bus_stays_ideal_beside_one_with_errors() -> None:
    """A Wire is on the bus of the fault only; without wire faults there is none, and no error row."""
    result = run_scenario(scenario_of(injector("flip", "{wire: controller}", "{type: bit_error, field: crc}")))
    assert {row.bus for row in error_rows(result.faulted)} == {0}
    assert error_rows(result.golden) == []


@pytest.mark.parametrize(
    ("line", "what"),
    [
        (lambda path: ["gateway", path], "exo-hil gateway"),
        (lambda path: ["up", path], "exo-hil up"),
        (lambda path: ["run", path, "--realtime"], "exo-hil run --realtime"),
    ],
)
def test_what_has_no_emulated_bus_refuses_the_file_before_anything_runs(
    capsys: pytest.CaptureFixture[str], line: Callable[[str], list[str]], what: str
) -> None:
    """Exit 2, one line, with the reason and what can do it."""
    assert main(line(str(FOLDER / "knee_bus_off.yaml"))) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    (message,) = shown.err.splitlines()
    assert message.startswith(f"injectors.knee_off.fault: {what} cannot do bus_off: ")
    assert "`exo-hil run`" in message


def test_transmit_queues_that_keep_the_order_are_chosen_in_the_scenario() -> None:
    """The same frames without a fault; frames released at once leave in another order."""
    late = injector("late", "{bus: to_controller, pdo: TPDO1}", "{type: delay, law: {type: exponential, mean: 9 ms}}",
                    more="effect: {type: constant_time, duration: 50 ms}")  # fmt: skip
    results = [
        run_scenario(parse_scenario(HEAD + f"  {late}\n", overrides=[f"rig.queues={queues}"]))
        for queues in ("by_id", "fifo")
    ]
    golden = [[frame for _, bus, frame in rows(result.golden) if bus == DRIVE_BUS] for result in results]
    assert sorted(golden[0]) == sorted(golden[1])
    assert all(result.document["valid"] for result in results)
    assert results[0].document["trace_hash"]["faulted"] != results[1].document["trace_hash"]["faulted"]


def test_transmit_queues_that_keep_the_order_work_where_errors_are_possible() -> None:
    """A fault that could collide, and acts late: until then the run is the golden one, and frames go on passing."""
    late = injector("again", "{pdo: TPDO1, node: left_hip, bus: to_controller}", "{type: duplicate}",
                    "{type: at, time: 0.9 s}")  # fmt: skip
    result = run_scenario(parse_scenario(HEAD + f"  {late}\n", overrides=["rig.queues=fifo"]))
    assert result.document["valid"], result.document["invalid_reasons"]
    assert result.document["completed"]
    assert len(result.faulted.rows) == len(result.golden.rows) + 1


@pytest.mark.parametrize("line", [["up"], ["run", "--realtime"]])
def test_buses_whose_queues_cannot_be_chosen_refuse_the_scenario(
    line: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything runs, with what to do."""
    file = tmp_path / "fifo.yaml"
    file.write_text(HEAD.replace("rate: 500 Hz", "rate: 500 Hz, queues: fifo").replace("injectors:\n", ""))
    assert main([*line, str(file)]) == 2
    said = capsys.readouterr().err
    assert "rig.queues: fifo given" in said
    assert "virtual time" in said
