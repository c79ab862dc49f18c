"""The rig in virtual time as a test sees it. Runs at 100 Hz, where a second costs least, unless the rate matters."""

import pytest

from canopen_exo.bus.trace import trace_hash
from canopen_exo.cia402 import DriveState
from canopen_exo.master import MasterState
from canopen_exo.plan import EMCY, HEARTBEAT, HLC_STATUS, SYNC
from fi_gateway.bus_control import DEFAULT_COMMAND_ID, DEFAULT_STATUS_ID, Command
from fi_gateway.errors import FaultError
from fi_gateway.quantity import QuantityError
from testbench.cli_rig import DEFAULT_SCENARIO
from testbench.errors import BenchError
from testbench.golden import first_difference
from testbench.plugin.golden import Goldens
from testbench.plugin.lockstep import LockStepExo, open_lockstep
from testbench.plugin.observer import ControllerState
from testbench.rig import build_rig
from testbench.run import rig_params
from testbench.scenario import parse_scenario

KNEE_POSITION = {"bus": "to_controller", "node": "right_knee", "signal": "position"}
BIAS = {"type": "bias", "value": "0.05 rad"}
FILE = """
name: in_file
rig: {plant: suspended, stops: off, rate: 100 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 7 s}
injectors:
  flip:
    target: {bus: to_controller, node: right_knee, signal: position}
    fault: {type: bit_flip, count: 1}
    event: {type: at, time: 0.1 s}
    effect: {type: constant_time, duration: 0.2 s}
"""
FLIP = {
    "target": KNEE_POSITION,
    "fault": {"type": "bit_flip", "count": 1},
    "event": {"type": "at", "time": "0.1 s"},
    "effect": {"type": "constant_time", "duration": "0.2 s"},
}

GOLDENS = Goldens()  # shared: a golden run costs most of a second


def rig(text: str = DEFAULT_SCENARIO, rate: str = "100 Hz") -> LockStepExo:
    return open_lockstep(parse_scenario(text, "test", [f"rig.rate={rate}"]), GOLDENS, frozenset())


# ---- live control over the bus --------------------------------------------------------------------------------------


def test_gateway_takes_commands_over_the_bus_where_that_is_asked_for() -> None:
    """docs/pytest.md: `--exo-control-frames`; a device under test that starts faults by frames does so here as well."""
    exo = open_lockstep(parse_scenario(FILE, "test"), GOLDENS, frozenset(), "drive")
    exo.run_until_motion()
    command = Command(3, 0, 1).frame(DEFAULT_COMMAND_ID)  # trigger
    exo.send(command.can_id, command.data, bus="drive")
    exo.expect(DEFAULT_STATUS_ID, within="1 cycle", bus="drive")
    assert exo.gateway.injection("flip").is_active


# ---- time -----------------------------------------------------------------------------------------------------------


def test_nothing_moves_unless_the_test_lets_it() -> None:
    """docs/pytest.md: virtual time goes on by the test's calls only, and exactly as far as asked."""
    exo = rig()
    assert (exo.time_ns, exo.rows) == (0, [])
    exo.run_for("1.25 ms")
    assert exo.time_ns == 1_250_000
    exo.run_for("3 cycles")
    assert exo.time_ns == 31_250_000
    assert exo.time_s == 0.03125


@pytest.mark.parametrize(
    ("duration", "error"),
    [("5", QuantityError), ("3 rad", QuantityError), ("-1 s", BenchError), ("cycles", QuantityError)],
)
def test_a_duration_needs_a_unit_and_does_not_go_back(duration: str, error: type[Exception]) -> None:
    """As in scenario files; time does not run backwards."""
    with pytest.raises(error):
        rig().run_for(duration)


@pytest.mark.long
def test_the_trace_is_that_of_the_same_rig_alone() -> None:
    """The test's node on both buses is silent, and how time is cut into calls changes nothing."""
    exo = rig(rate="500 Hz")
    exo.run_until_motion()
    exo.expect(SYNC, within="1 s")
    exo.run_for("7 cycles")
    alone = build_rig(rig_params(exo.scenario), [])
    alone.loop.run_until(exo.time_ns)
    assert first_difference(alone.loop.trace, exo.rows) is None


def test_run_until_asks_every_millisecond() -> None:
    """The condition is asked at every whole millisecond of the plant."""
    exo = rig()
    asked: list[int] = []

    def condition() -> bool:
        asked.append(exo.time_ns)
        return exo.time_ns >= 3_000_000

    exo.run_until(condition, within="1 s")
    assert asked == [0, 1_000_000, 2_000_000, 3_000_000]


def test_run_until_fails_when_the_time_is_over() -> None:
    """An AssertionError, so that the test fails and does not break."""
    exo = rig()
    with pytest.raises(AssertionError, match=r"did not hold within 5 ms, until 0.005 s"):
        exo.run_until(lambda: False, within="5 ms")
    assert exo.time_ns == 5_000_000


# ---- what it shows --------------------------------------------------------------------------------------------------


def test_motion_begins_with_everything_enabled() -> None:
    """run_until_motion returns when the controller's status has said so on the bus."""
    exo = rig()
    exo.run_until_motion()
    assert exo.controller.state is ControllerState.MOTION
    assert exo.master.state is MasterState.OPERATIONAL
    assert {drive.state for drive in exo.drives.values()} == {DriveState.OPERATION_ENABLED}
    assert 0 < exo.motion_s <= 0.001
    assert exo.rig.controller.time_zero == exo.observer.time_zero_ns
    before = exo.time_ns
    exo.run_until_motion()
    assert exo.time_ns == before


def test_frames_and_plant_agree() -> None:
    """0x6064 is the plant's angle at the last SYNC, within one count (17 bits a turn) and one cycle of motion."""
    exo = rig(rate="500 Hz")
    exo.run_until_motion()
    exo.run_for("0.5 s")
    one_cycle = 2 * 0.002  # rad: the fastest joint turns at about 5 rad/s, less than half of that here
    for at, drive in enumerate(exo.drives.values()):
        assert drive.position_rad == pytest.approx(exo.plant.q[at], abs=one_cycle + 5e-5)


def test_motion_time_before_the_motion_raises() -> None:
    """No neutral value stands for failure."""
    with pytest.raises(BenchError, match="run_until_motion"):
        _ = rig().motion_s


def test_a_failed_start_says_why() -> None:
    """The reason reaches the test: which drive, what was missing."""
    exo = rig()
    exo.gateway.inject(target={"bus": "to_controller", "cob_id": HEARTBEAT + 5}, fault={"type": "drop"})
    with pytest.raises(AssertionError, match=r"right_knee \(node 5\): no boot-up message"):
        exo.run_until_motion()
    assert exo.master.state is MasterState.FAILED
    assert exo.time_s < 2  # at once, not at the end of the time that a start may take


def test_a_start_that_the_master_gives_up_is_not_waited_for() -> None:
    """Drives that cannot be enabled: the controller leaves without a word on its bus, and the test is told at once."""
    exo = rig()
    exo.gateway.inject(target={"bus": "to_drives", "pdo": "RPDO1"}, fault={"type": "drop"})
    with pytest.raises(AssertionError, match="not in Operation enabled after 2 s"):
        exo.run_until_motion()
    assert exo.master.state is MasterState.STOPPED
    assert exo.time_s < 3


def test_last_frames_are_the_last_of_that_bus() -> None:
    """Oldest first, of one bus."""
    exo = rig()
    exo.run_for("1 s")
    frames = exo.frames("controller", last=7)
    assert frames == [row for row in exo.rows if row.bus == 0][-7:]
    with pytest.raises(BenchError, match="allowed: controller, drive"):
        exo.frames("can0")


# ---- expectations ---------------------------------------------------------------------------------------------------


def test_an_expected_frame_ends_the_wait_at_its_end() -> None:
    """The rig stands at the very end of the frame; the next call looks for the next one."""
    exo = rig()
    exo.run_until_motion()
    first = exo.expect(SYNC, within="1 s")
    assert exo.time_ns == first.end_ns
    second = exo.expect(SYNC, within="1 s")
    one_frame = 135_000  # ns: a SYNC waits for the frame under way, at most 135 bits of 1 us
    assert second.end_ns == pytest.approx(first.end_ns + exo.plan.cycle_ns, abs=one_frame)


def test_an_expected_frame_must_be_on_that_bus() -> None:
    """The status frame of the controller reaches the drive bus one frame later."""
    exo = rig()
    exo.run_until_motion()
    there = exo.expect(HLC_STATUS, within="1 s", bus="controller")
    behind = exo.expect(HLC_STATUS, within="1 ms", bus="drive")
    assert 0 < behind.end_ns - there.end_ns < 1_000_000


def test_a_frame_that_does_not_come_fails_with_the_last_ones() -> None:
    """What was expected, how long, and what came instead."""
    exo = rig()
    exo.run_until_motion()
    with pytest.raises(AssertionError) as failed:
        exo.expect(HLC_STATUS, within="150 ms", data="03 .. .. .. ..")
    text = str(failed.value)
    assert "no frame 2FF with data 03 .. .. .. .. (controller status) on the drive bus within 150 ms, until" in text
    assert text.splitlines()[-1].split()[2:4] == ["2FF", "02"]
    with pytest.raises(AssertionError, match=r"2FF  02 .* controller status  length 5, data has 8$"):
        exo.expect(HLC_STATUS, within="30 ms", data="02 .. .. .. .. .. .. ..")
    with pytest.raises(AssertionError, match="none with that id"):
        exo.expect(0x456, within="1 ms")


def test_none_expected_lets_the_time_pass_or_fails_at_the_frame() -> None:
    """Both ways of expect_none."""
    exo = rig()
    exo.run_until_motion()
    before = exo.time_ns
    exo.expect_none(0x456, within="30 ms")
    assert exo.time_ns == before + 30_000_000
    with pytest.raises(AssertionError, match=r"frame 080 \(SYNC\) on the drive bus was not to come within 30 ms"):
        exo.expect_none(SYNC, within="30 ms")
    assert exo.time_ns < before + 45_000_000


def test_a_sent_frame_passes_the_gateway() -> None:
    """The test is one more node on the bus."""
    exo = rig()
    exo.send(0x123, b"\x01\x02", bus="drive")
    seen = exo.expect(0x123, within="1 ms", data=b"\x01\x02", bus="controller")
    assert [row.bus for row in exo.rows if row.frame.can_id == 0x123] == [1, 0]
    assert exo.frames("controller", last=1) == [seen]


def test_a_sent_frame_goes_on_the_controller_bus_unless_said() -> None:
    """docs/pytest.md: as the table of words has it."""
    exo = rig()
    exo.send(0x123, b"\x01")
    exo.expect(0x123, within="1 ms", bus="drive")
    assert [row.bus for row in exo.rows if row.frame.can_id == 0x123] == [0, 1]


# ---- faults ---------------------------------------------------------------------------------------------------------


def test_a_fault_injected_while_it_walks_acts_at_once_and_ends() -> None:
    """Immediate injection: the event is now. The drive bus shows the truth, the controller the fault."""
    exo = rig()
    exo.run_until_motion()
    fault = exo.gateway.inject(target=KNEE_POSITION, fault=BIAS, duration="0.1 s")
    assert fault.row.state == "active"
    exo.run_for("95 ms")
    read = exo.controller.drives["right_knee"].position_rad - exo.drives["right_knee"].position_rad
    assert read == pytest.approx(0.05, abs=2.5e-5)  # half a count of 4.8e-5 rad
    exo.run_for("20 ms")
    assert not fault.is_active
    assert (fault.row.activated, fault.row.injected, fault.row.manifested) == (1, 10, 10)


def test_a_fault_injected_before_the_run_is_there_from_the_first_frame() -> None:
    """Injected first, so the boot-up messages are hit too."""
    exo = rig()
    lost = exo.gateway.inject(target={"bus": "to_controller", "cob_id": HEARTBEAT + 1}, fault={"type": "drop"})
    exo.run_for("0.5 s")
    assert lost.row.manifested > 0
    assert HEARTBEAT + 1 in {row.frame.can_id for row in exo.frames("drive", last=10_000)}
    assert HEARTBEAT + 1 not in {row.frame.can_id for row in exo.frames("controller", last=10_000)}


@pytest.mark.long
@pytest.mark.parametrize("late", [False, True])
def test_an_injection_equals_the_same_injector_in_a_file(late: bool) -> None:
    """Same schema, same random stream: trace by trace, whether given before the run or before it was due."""
    in_file, injected = rig(FILE), rig()
    if late:
        injected.run_until_motion()
    injected.gateway.inject(name="flip", **FLIP)  # type: ignore[arg-type]
    hashes = []
    for exo in (in_file, injected):
        exo.run_until_motion()
        exo.run_for("0.4 s")
        hashes.append(trace_hash(exo.rows))
    assert in_file.gateway.injection("flip").row.manifested > 0
    assert hashes[0] == hashes[1]


def test_live_control_reaches_an_injector() -> None:
    """trigger, disarm, arm, stop, resume; an unknown name is refused with those there are."""
    exo = rig(FILE)
    with pytest.raises(FaultError, match="has not run yet"):
        exo.gateway.injection("flip").trigger()
    exo.run_until_motion()
    flip = exo.gateway.injection("flip")
    flip.trigger()
    assert flip.is_active
    flip.disarm()
    assert flip.row.state == "disarmed"
    flip.arm()
    assert flip.row.state == "armed"
    exo.gateway.stop()
    assert flip.row.state == "held"
    exo.gateway.resume()
    assert flip.row.state == "armed"
    with pytest.raises(FaultError, match="no injector 'flop'; there are: flip"):
        exo.gateway.injection("flop")


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"fault": {"type": "biass"}}, "did you mean 'bias'"),
        ({"duration": "3 rad"}, "injector injection_1: effect.duration: '3 rad' is an angle"),
        ({"duration": "1 s", "effect": {"type": "once"}}, "duration stands for one"),
        ({"start": "power_up"}, "start given without an event"),
        ({"event": {"type": "at", "time": "1 s"}, "start": "noon"}, "from: "),
        ({"trigger": {"any": ["nobody"]}}, "no injector is called 'nobody'"),
    ],
)
@pytest.mark.parametrize("running", [False, True])
def test_a_wrong_injection_is_refused_in_the_words_of_a_file(
    keys: dict[str, object], words: str, running: bool
) -> None:
    """The same before and while the rig runs; nothing is changed."""
    exo = rig()
    if running:
        exo.run_for("1 ms")
    with pytest.raises(FaultError, match=words):
        exo.gateway.inject(**{"target": KNEE_POSITION, "fault": BIAS, **keys})  # type: ignore[arg-type]
    assert exo.gateway.listing() == []
    assert exo.gateway.inject(target=KNEE_POSITION, fault=BIAS).name == "injection_1"


def test_nothing_is_said_of_an_injector_before_the_rig_runs() -> None:
    """A count of 0 would read as if it had been there and done nothing."""
    fault = rig().gateway.inject(target=KNEE_POSITION, fault=BIAS)
    with pytest.raises(BenchError, match="has not run yet"):
        _ = fault.row


# ---- golden comparison ----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_without_a_fault_nothing_deviates() -> None:
    """Same scenario, same trace: exactly 0, in every joint."""
    exo = rig()
    exo.run_until_motion()
    exo.run_for("0.5 s")
    for joint in exo.drives:
        assert exo.deviation(joint).rmse_position_rad == 0.0
        assert exo.deviation(joint).rmse_torque_nm == 0.0


@pytest.mark.long
def test_deviation_is_the_rmse_from_time_zero_to_now() -> None:
    """Against the definition: sqrt(mean((q - q_golden)^2)) over the plant's 1 ms grid, ends included."""
    exo = rig()
    exo.run_until_motion()
    exo.gateway.inject(target=KNEE_POSITION, fault=BIAS)
    exo.run_for("0.3 s")
    zero, now = exo.observer.time_zero_ns, exo.time_ns
    angles = [row.q[4] for row in exo.rig.rack.truth if zero <= row.time_ns <= now]
    golden = exo.golden.truth.q[:, 4].tolist()
    expected = (sum((a - b) ** 2 for a, b in zip(angles, golden, strict=False)) / len(angles)) ** 0.5
    assert expected > 0.01
    assert exo.deviation("right_knee").rmse_position_rad == pytest.approx(expected, rel=1e-12)


@pytest.mark.long
def test_deviation_ends_with_the_motion() -> None:
    """What the drives do after the motion has no golden counterpart."""
    exo = open_lockstep(
        parse_scenario(DEFAULT_SCENARIO, "test", ["rig.rate=100 Hz", "motion.duration=0.3 s"]), GOLDENS, frozenset()
    )
    exo.run_until_motion()
    exo.run_for("1 s")
    assert exo.controller.state is ControllerState.STOPPED
    assert exo.deviation("left_hip").rmse_position_rad == 0.0


def test_deviation_needs_a_motion_and_a_joint() -> None:
    """Errors say what to do."""
    exo = rig()
    with pytest.raises(BenchError, match="run_until_motion"):
        exo.deviation("right_knee")
    exo.run_until_motion()
    with pytest.raises(BenchError, match="this rig has left_hip, left_knee"):
        exo.deviation("elbow")


def test_a_golden_run_is_made_once() -> None:
    """A session pays once for each kind of rig; faults and names make no other kind."""
    goldens = Goldens()
    scenario = parse_scenario(FILE, "test", ["motion.duration=0.1 s"])
    assert goldens.of(scenario) is goldens.of(parse_scenario(FILE, "test", ["motion.duration=0.1 s", "seed=5"]))
    assert goldens.of(scenario).activations == []


# ---- events and parts -----------------------------------------------------------------------------------------------


def test_the_controllers_own_events_are_shown() -> None:
    """In lock-step the test sees what the controller noticed, not only what was on the bus."""
    exo = rig()
    exo.run_until_motion()
    exo.gateway.inject(target={"bus": "to_drives", "node": "right_knee", "pdo": "RPDO1"}, fault={"type": "drop"})
    exo.expect(EMCY + 5, within="15 cycles", data="50 82 .. .. .. .. .. ..")
    exo.run_until(lambda: exo.controller.state is ControllerState.STOPPED, within="60 cycles")
    kinds = [(event.joint, event.kind) for event in exo.controller.events]
    assert ("right_knee", "emcy") in kinds
    assert exo.rig.rack.drives[4].torque_nm == 0  # the right knee, whatever its last frame said


def test_no_part_is_foreign_in_virtual_time() -> None:
    """Foreign software does not run in virtual time."""
    with pytest.raises(BenchError, match="--exo-bus"):
        open_lockstep(parse_scenario(FILE), GOLDENS, frozenset({"hlc"}))


