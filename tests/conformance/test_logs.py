"""The logs of a run, read by other people's tools, against the plant and the controller they tell of.

python-can reads the candump logs, cantools decodes them with the shipped DBC, pyarrow reads the truth. Nothing of the
project decodes here; limits and rates are the paper's table and the bus plan's published defaults.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import cantools
import numpy as np
import pyarrow.parquet as pq
import pytest
from can import CanutilsLogReader, Message
from cantools.database.can import Database
from numpy.typing import NDArray
from scipy.signal import lfilter

from testbench.document import Summary
from testbench.run import run_scenario
from testbench.scenario import JOINT_NAMES, load_scenario
from testbench.store import result_files, write_result

pytestmark = pytest.mark.run

Floats = NDArray[np.float64]

SCENARIO = Path(__file__).parents[2] / "scenarios" / "knee_freeze.yaml"
RATED_NM = {"hip": 72.9, "knee": 54.9, "ankle": 128.7}
"""ESREL 2020, table 1: rated torque of the drives (0x6076), and the controller's clamp."""

COUNT_RAD = 2 * math.pi / 131_072
"""One count of a 17-bit encoder."""

DBC_ROUNDING_RAD = 1e-9
"""The DBC prints its scale factors with 12 digits and more; nothing in a log is larger than 10 rad, or rad/s."""

LOW_PASS = 1 - math.exp(-2 * math.pi * 100 * 0.001)
"""Share that the drive's speed filter, 100 Hz at 1 ms, takes over in one sample."""

CYCLE_MS = 2
MOTION_MS = 7000
SYNC, TPDO1, RPDO1, TPDO2, HLC_STATUS = 0x080, 0x180, 0x200, 0x280, 0x2FF
RIGHT_KNEE = 5


@dataclass(frozen=True)
class Log:
    """One log. us: time of each message, whole microseconds; sync_us, sync_ms: of each SYNC, and its millisecond."""

    bus: str
    messages: list[Message]
    us: NDArray[np.int64]

    def of(self, can_id: int) -> tuple[list[Message], NDArray[np.int64]]:
        """The messages of one id and their times."""
        at = [k for k, message in enumerate(self.messages) if message.arbitration_id == can_id]
        return [self.messages[k] for k in at], self.us[at]

    def since_sync(self, can_id: int) -> tuple[list[Message], NDArray[np.int64], NDArray[np.int64]]:
        """As `of`, without those before the first SYNC, and the millisecond in which the last SYNC before each went."""
        messages, us = self.of(can_id)
        _, sync_us = self.of(SYNC)
        last = np.searchsorted(sync_us, us, side="right") - 1
        kept = np.flatnonzero(last >= 0)
        return [messages[k] for k in kept], us[kept], sync_us[last[kept]] // 1000


@dataclass(frozen=True)
class Written:
    """A result folder without its plots, and the DBC."""

    folder: Path
    document: Summary
    dbc: Database
    logs: dict[str, Log]

    @property
    def zero_ms(self) -> int:
        """Time 0 on the logs' clock: the millisecond in which the controller asked for the SYNC of cycle 0."""
        return math.floor(self.document["time0_s"] * 1000)

    def truth(self, run: str, joint: str, quantity: str) -> Floats:
        """A column of the plant's truth, one value per millisecond from time 0."""
        return np.asarray(pq.read_table(self.folder / f"{run}.parquet")[f"{joint}.{quantity}"].to_numpy())

    def decoded(self, messages: list[Message], name: str) -> Floats:
        """One signal of every message, as the DBC has it."""
        if not messages:
            return np.zeros(0)
        kind = self.dbc.get_message_by_frame_id(messages[0].arbitration_id)
        rows = [kind.decode_simple(bytes(one.data), decode_choices=False) for one in messages]
        return np.array([row[name] for row in rows], dtype=np.float64)

    def windows(self, injector: str) -> list[tuple[float, float]]:
        """Start and end of an injector's activations on the logs' clock [us]."""
        zero_s, spans = self.document["time0_s"], []
        for one in self.document["injections"]:
            if one["injector"] == injector:
                assert one["end_s"] is not None
                spans.append((1e6 * (zero_s + one["start_s"]), 1e6 * (zero_s + one["end_s"])))
        return spans


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Written]:
    """knee_freeze.yaml, run and written, its four logs read back."""
    scenario = load_scenario(SCENARIO)
    result = run_scenario(scenario)
    made = result_files(scenario.resolved_yaml(), result.document, JOINT_NAMES, result.golden, result.faulted)
    folder = write_result(tmp_path_factory.mktemp("logs") / "result", made)
    logs = {}
    for name in ("controller", "drive", "golden_controller", "golden_drive"):
        messages = list(CanutilsLogReader(folder / f"{name}.log"))
        us = np.array([round(message.timestamp * 1e6) for message in messages])
        logs[name] = Log(name.removeprefix("golden_"), messages, us)
    document: Summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    dbc = cantools.database.load_string((files("dbc") / "exo.dbc").read_text(encoding="utf-8"), "dbc")
    assert isinstance(dbc, Database)
    yield Written(folder, document, dbc, logs)
    logs.clear()


def rated(joint: str) -> float:
    return RATED_NM[joint.split("_")[1]]


# --- the files -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["controller", "drive", "golden_controller", "golden_drive"])
def test_log_is_read_line_by_line_by_python_can(written: Written, name: str) -> None:
    """`candump -L` format: one message a line, in time order, classical 11-bit frames on the bus of that name."""
    log = written.logs[name]
    lines = (written.folder / f"{name}.log").read_text(encoding="ascii").splitlines()
    assert len(log.messages) == len(lines) > 50_000
    assert np.all(np.diff(log.us) > 0)
    for message in log.messages:
        assert message.channel == log.bus
        assert not any((message.is_extended_id, message.is_remote_frame, message.is_fd, message.is_error_frame))


def test_every_frame_but_sdo_is_in_the_dbc_with_its_length(written: Written) -> None:
    """The DBC describes what is on the bus; SDO transfers have no fixed content and are left out of it."""
    sizes = {message.frame_id: message.length for message in written.dbc.messages}
    sdo = {base + node for base in (0x580, 0x600) for node in range(1, 7)}
    seen = {(one.arbitration_id, one.dlc) for log in written.logs.values() for one in log.messages}
    assert {can_id for can_id, _ in seen} - sdo <= set(sizes)
    assert all(sizes.get(can_id, 8) == length for can_id, length in seen)
    assert {can_id for can_id, _ in seen} >= {base + node for base in (TPDO1, RPDO1, TPDO2) for node in range(1, 7)}


def test_frames_counted_in_the_summary_are_those_in_the_logs(written: Written) -> None:
    """summary.json: bus.*.frames, over the motion: ended after the request of SYNC 0, at most 7 s later."""
    for bus in ("controller", "drive"):
        us = written.logs[bus].us - 1000 * written.zero_ms
        assert written.document["bus"][bus]["frames"] == np.sum((us > 0) & (us <= 1000 * MOTION_MS))


def test_time_zero_is_the_sync_that_the_status_frame_tells(written: Written) -> None:
    """Design, "Time zero": state MOTION with cycle c says that time 0 was c cycles before the latest SYNC."""
    for name in ("controller", "golden_controller"):
        log = written.logs[name]
        messages, us = log.of(HLC_STATUS)
        moving = written.decoded(messages, "state") == 2
        cycles = written.decoded(messages, "cycle")
        _, sync_us = log.of(SYNC)
        last = sync_us[np.searchsorted(sync_us, us, side="right") - 1]
        assert cycles[moving][0] == 0
        assert last[moving][0] == math.floor(written.document["time0_s"] * 1e6)  # logs cut to whole microseconds
        asked_ms = last[moving] // 1000
        assert np.array_equal(asked_ms - written.zero_ms, CYCLE_MS * cycles[moving])


# --- what the drives say -------------------------------------------------------------------------------------------


def samples(written: Written, name: str, joint: str) -> tuple[list[Message], NDArray[np.int64], NDArray[np.int64]]:
    """TPDO1 of a joint: messages, their times, and the plant's millisecond from time 0 that their SYNC latched."""
    node = JOINT_NAMES.index(joint) + 1
    messages, us, sync_ms = written.logs[name].since_sync(TPDO1 + node)
    latched = sync_ms - written.zero_ms
    kept = np.flatnonzero((latched >= 0) & (latched <= MOTION_MS))
    return [messages[k] for k in kept], us[kept], latched[kept]


def low_passed(dq: Floats) -> Floats:
    """What a drive without quantisation would make of the plant's speed, which is its angle's step over 1 ms."""
    return np.asarray(lfilter([LOW_PASS], [1, LOW_PASS - 1], dq))


SETTLED_MS = 50
"""The filter forgets by 0.53 per ms; what it held at time 0, which the truth does not tell, is 1e-14 of itself."""

SPEED_BOUND = (1000 * LOW_PASS + 0.5) * COUNT_RAD + DBC_ROUNDING_RAD
"""Each of two angles is off by half a count; through the filter of the difference the errors' weights sum up to
2 x LOW_PASS x 1000/s, so LOW_PASS x 1000 counts/s; and half a count/s for rounding 0x606C. 0.022 rad/s."""


@pytest.mark.parametrize("joint", JOINT_NAMES)
def test_position_on_the_bus_is_the_plants_at_the_sync(written: Written, joint: str) -> None:
    """0x6064 is the angle of the plant step that SYNC latched, to the nearest count of the encoder; one a cycle."""
    for run, name in (("golden", "golden_drive"), ("faulted", "drive")):
        messages, _, latched = samples(written, name, joint)
        assert np.array_equal(latched, np.arange(0, MOTION_MS + 1, CYCLE_MS))
        q = written.truth(run, joint, "q")[latched]
        assert np.max(np.abs(written.decoded(messages, "position") - q)) <= COUNT_RAD / 2 + DBC_ROUNDING_RAD
        assert np.ptp(q) > 1000 * COUNT_RAD  # the joint moved; a constant would prove nothing


@pytest.mark.parametrize("joint", JOINT_NAMES)
def test_velocity_on_the_bus_is_the_plants_through_the_drives_filter(written: Written, joint: str) -> None:
    """0x606C is the plant's speed behind a 100 Hz low-pass, within what the encoder's counts add."""
    for run, name in (("golden", "golden_drive"), ("faulted", "drive")):
        messages, _, latched = samples(written, name, joint)
        wanted = low_passed(written.truth(run, joint, "dq"))[latched]
        settled = latched >= SETTLED_MS
        error = np.abs(written.decoded(messages, "velocity") - wanted)[settled]
        assert np.max(error) <= SPEED_BOUND
        assert np.ptp(wanted) > 20 * SPEED_BOUND


def test_frozen_knee_reads_its_last_value_inside_the_windows_and_the_truth_outside(written: Written) -> None:
    """stuck_at: the last value that arrived before the window, for every frame that arrives in it, and in no other."""
    _, arrived_us, latched = samples(written, "drive", "right_knee")
    messages, _, passed = samples(written, "controller", "right_knee")
    assert np.array_equal(passed, latched)  # none lost, none late into the next cycle
    read = written.decoded(messages, "position")
    q = written.truth("faulted", "right_knee", "q")[latched]
    inside = np.zeros(len(read), dtype=bool)
    windows = written.windows("freeze_position")
    assert windows
    for start_us, end_us in windows:
        window = (arrived_us >= start_us) & (arrived_us < end_us)
        before = np.flatnonzero(arrived_us < start_us)[-1]
        assert np.sum(window) == 150  # 0.3 s at 500 Hz
        assert np.max(np.abs(read[window] - q[before])) <= COUNT_RAD / 2 + DBC_ROUNDING_RAD
        assert np.ptp(read[window]) == 0
        assert np.ptp(q[window]) > 100 * COUNT_RAD  # while the knee itself went on
        inside |= window
    assert np.max(np.abs(read - q)[~inside]) <= COUNT_RAD / 2 + DBC_ROUNDING_RAD


def test_velocity_reads_zero_inside_the_windows_and_the_truth_outside(written: Written) -> None:
    """stuck_at_value 0 on 0x606C, chained to the frozen position."""
    _, arrived_us, latched = samples(written, "drive", "right_knee")
    messages, _, _ = samples(written, "controller", "right_knee")
    read = written.decoded(messages, "velocity")
    wanted = low_passed(written.truth("faulted", "right_knee", "dq"))[latched]
    inside = np.zeros(len(read), dtype=bool)
    for start_us, end_us in written.windows("zero_velocity"):
        inside |= (arrived_us >= start_us) & (arrived_us < end_us)
    assert np.sum(inside) == 150 * len(written.windows("freeze_position"))
    assert np.all(read[inside] == 0)
    assert np.max(np.abs(wanted[inside])) > 20 * SPEED_BOUND  # the knee did not stand still
    outside = ~inside & (latched >= SETTLED_MS)
    assert np.max(np.abs(read - wanted)[outside]) <= SPEED_BOUND


def test_other_frames_pass_the_gateway_unchanged_and_in_order(written: Written) -> None:
    """Only TPDO1 of the right knee is a target: every other id has the same payloads on both buses, in one order."""
    ids = {one.arbitration_id for log in written.logs.values() for one in log.messages} - {TPDO1 + RIGHT_KNEE}
    for can_id in sorted(ids):
        there, _ = written.logs["controller"].of(can_id)
        here, _ = written.logs["drive"].of(can_id)
        both = min(len(here), len(there))
        assert abs(len(here) - len(there)) <= 1  # one may be on its way when the log ends
        assert [bytes(one.data) for one in here[:both]] == [bytes(one.data) for one in there[:both]]


def test_drives_are_in_operation_enabled_during_the_motion(written: Written) -> None:
    """CiA 402: statusword x01x 0111 in every TPDO2 of the motion, each drive once in ten cycles."""
    for name in ("controller", "golden_controller"):
        for node in range(1, 7):
            messages, _, sync_ms = written.logs[name].since_sync(TPDO2 + node)
            moving = (sync_ms >= written.zero_ms) & (sync_ms < written.zero_ms + MOTION_MS)
            words = written.decoded(messages, "statusword")[moving].astype(int)
            assert len(words) == MOTION_MS // CYCLE_MS // 10
            assert np.all(words & 0x6F == 0x27)
            assert np.all(written.decoded(messages, "error_code")[moving] == 0)


# --- what the controller says --------------------------------------------------------------------------------------


@pytest.mark.parametrize("joint", JOINT_NAMES)
def test_torque_on_the_bus_is_the_command_within_the_clamp(written: Written, joint: str) -> None:
    """0x6071 is the clamped command of its cycle to the nearest per mille of rated torque, with controlword 0x0F."""
    node = JOINT_NAMES.index(joint) + 1
    for run, name in (("golden", "golden_controller"), ("faulted", "controller")):
        messages, _, sync_ms = written.logs[name].since_sync(RPDO1 + node)
        cycle = (sync_ms - written.zero_ms) // CYCLE_MS
        kept = np.flatnonzero((cycle >= 0) & (cycle < MOTION_MS // CYCLE_MS))
        assert np.array_equal(cycle[kept], np.arange(MOTION_MS // CYCLE_MS))
        moving = [messages[k] for k in kept]
        table = pq.read_table(written.folder / f"{run}_commands.parquet")
        assert np.allclose(table["time_s"].to_numpy(), cycle[kept] * CYCLE_MS / 1000, rtol=0, atol=1e-9)
        command = np.clip(table[f"{joint}.tau_command"].to_numpy(), -rated(joint), rated(joint))
        error = np.abs(written.decoded(moving, "target_torque") - command)
        assert np.max(error) <= 0.5e-3 * rated(joint) + 1e-9
        assert np.all(written.decoded(moving, "controlword") == 0x0F)


def test_clamp_acted_in_the_faulted_run_only(written: Written) -> None:
    """The run holds both cases of the test above: commands within the clamp, and beyond it."""
    for run, clamped in (("golden", False), ("faulted", True)):
        command = pq.read_table(written.folder / f"{run}_commands.parquet")["right_knee.tau_command"].to_numpy()
        assert bool(np.max(np.abs(command)) > rated("right_knee")) is clamped
