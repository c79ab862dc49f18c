"""The high-level controller on a bus with six stand-in drives: enabling, cycle, deadline, and every way to stop."""

import math
import struct
from collections.abc import Iterable

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium, Transmission
from canopen_exo.bus.node import MS, NEVER, SECOND, Node, Out
from canopen_exo.cia402 import DriveState, DriveStateMachine
from canopen_exo.master import Expected, Master, MasterState, SlaveConfig
from canopen_exo.plan import BusPlan, JointNode
from hlc.controller import Controller, build_controller, paper_params
from hlc.gait import packaged_recording
from hlc.node import COMMANDS_KEPT, CommandFrames, Event, HighLevelController, Phase

NAMES = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
RATED_MNM = (72_900, 54_900, 128_700, 72_900, 54_900, 128_700)
PLAN = BusPlan(tuple(JointNode(NAMES[k], k + 1, RATED_MNM[k], 131_072) for k in range(6)))
CYCLE = 2 * MS
STRIDE = 206 * MS
"""Shorter than a human one, so that 103 cycles of fade-in bring time 0; no multiple of the 10 between status frames."""
FADE_CYCLES = STRIDE // CYCLE
MOTION_CYCLES = 60
DEADLINE = 1_200_000
"""0.6 of the cycle after SYNC [ns]."""
DEVICE_TYPE = 0x00020192
COUNTS = (1000, -2000, 300, -1500, -2500, -700)
SYNC, STATUS = 0x080, 0x2FF


def legs() -> str:
    """Two suspended legs of three links, without motors."""
    joint = 'axis="0 -1 0" armature="0.1" damping="1"'
    found = ""
    for side, y in (("left", 0.1), ("right", -0.1)):
        found += (
            f'<body pos="0 {y} 0"><joint name="{side}_hip" {joint}/>'
            '<inertial pos="0 0 -0.18" mass="10" diaginertia="0.19 0.19 0.03"/>'
            f'<body pos="0 0 -0.42"><joint name="{side}_knee" {joint}/>'
            '<inertial pos="0 0 -0.18" mass="5.5" diaginertia="0.09 0.09 0.01"/>'
            f'<body pos="0 0 -0.43"><joint name="{side}_ankle" {joint}/>'
            '<inertial pos="0.06 0 -0.04" mass="2.6" diaginertia="0.01 0.01 0.01"/></body></body></body>'
        )
    return f'<mujoco><option timestep="0.001" jacobian="dense"/><worldbody>{found}</worldbody></mujoco>'


MJCF = legs()


def make_controller() -> Controller:
    return build_controller(paper_params(NAMES, CYCLE, STRIDE), NAMES, packaged_recording(), MJCF)


class Drives(Node):
    """Six drives as the master sees them, on one port: boot, SDO, CiA 402, PDOs, heartbeats. Legs that do not move.

    Sets of joint indexes: silent (no TPDO1), mute (nothing at all), beatless (no heartbeat but the boot-up message),
    deaf_to_controlword (stay in their state), wordless (no TPDO2), tardy (TPDO1 `tardy_ns` after SYNC instead of at
    once). states: NMT states told instead of the true one, by joint.
    """

    def __init__(self) -> None:
        super().__init__()
        self.machines = [DriveStateMachine() for _ in range(6)]
        self.counts = list(COUNTS)
        self.silent: set[int] = set()
        self.mute: set[int] = set()
        self.beatless: set[int] = set()
        self.states: dict[int, int] = {}
        self.deaf_to_controlword: set[int] = set()
        self.wordless: set[int] = set()
        self.tardy: set[int] = set()
        self.tardy_ns = 0
        self.device_type = [DEVICE_TYPE] * 6
        self.syncs = 0
        self.booted = False
        self.operational = False
        self.commands: list[tuple[int, int, int, int]] = []
        """(ns, joint, controlword, torque) of every RPDO1."""
        self._words: list[int | None] = [None] * 6
        self._beat_at = NEVER
        self._tardy_at = NEVER

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        can_id, data = frame.can_id, frame.data
        if can_id == 0:
            self.operational = data[0] == 0x01
            if data[0] == 0x82:
                self._beat_at = now + 5 * MS
        elif 0x601 <= can_id <= 0x606:
            joint = can_id - 0x601
            if joint not in self.mute:
                out.send(0, Frame(0x581 + joint, b"\x43" + data[1:4] + struct.pack("<I", self.device_type[joint])))
        elif 0x201 <= can_id <= 0x206:
            word, torque = struct.unpack("<Hh", data)
            self.commands.append((now, can_id - 0x201, word, torque))
            self._words[can_id - 0x201] = word
        elif can_id == SYNC and self.operational:
            self._sync(now, out)
        self._plan()

    def _sync(self, now: int, out: Out) -> None:
        self.syncs += 1
        for joint, machine in enumerate(self.machines):
            word = self._words[joint]
            if word is not None and joint not in self.deaf_to_controlword:
                machine.controlword(word)
            self._words[joint] = None
            if joint in self.mute:
                continue
            if joint in self.tardy:
                self._tardy_at = now + self.tardy_ns
            elif joint not in self.silent:
                self.sample(joint, out)
            if self.syncs % 10 == joint and joint not in self.wordless:
                self.tell(joint, machine.statusword, out)

    def sample(self, joint: int, out: Out) -> None:
        """TPDO1."""
        out.send(0, Frame(0x181 + joint, struct.pack("<ii", self.counts[joint], 0)))

    def tell(self, joint: int, statusword: int, out: Out) -> None:
        """TPDO2."""
        out.send(0, Frame(0x281 + joint, struct.pack("<HhH", statusword, 0, 0)))

    def wake(self, now: int, out: Out) -> None:
        if now >= self._beat_at:
            state = 0x05 if self.operational else 0x7F
            for joint in range(6):
                if joint not in self.mute and not (self.booted and joint in self.beatless):
                    told = self.states.get(joint, state) if self.booted else 0x00
                    out.send(0, Frame(0x701 + joint, bytes((told,))))
            self.booted = True
            self._beat_at = now + 100 * MS
        if now >= self._tardy_at:
            self._tardy_at = NEVER
            for joint in sorted(self.tardy):
                self.sample(joint, out)
        self._plan()

    def _plan(self) -> None:
        self.wake_at = min(self._beat_at, self._tardy_at)


class Bench:
    """Controller, stand-in drives and one bus."""

    def __init__(self, motion_cycles: int = MOTION_CYCLES) -> None:
        self.hlc = HighLevelController(PLAN, make_controller(), motion_cycles)
        identity = (Expected(0x1000, 0, DEVICE_TYPE, "device type"),)
        slaves = tuple(SlaveConfig(NAMES[k], k + 1, identity, (), 300 * MS) for k in range(6))
        self.master = Master(PLAN, slaves, self.hlc)
        self.drives = Drives()
        self.medium = Medium("bus", 0, 1_000_000)
        self.loop = Loop([self.medium])
        self.loop.connect(self.master, [self.medium])
        self.loop.connect(self.drives, [self.medium])
        self.out = self.loop.outs[1]

    def until(self, phase: Phase, limit: int = 6 * SECOND) -> None:
        """Run cycle by cycle until the controller is in that phase."""
        while self.hlc.phase is not phase:
            assert self.loop.now < limit, f"still {self.hlc.phase.value} at {limit / 1e9:g} s"
            self.loop.run_until(self.loop.now + CYCLE)

    def cycles(self, count: int) -> None:
        self.loop.run_until(self.loop.now + count * CYCLE)

    def in_motion(self) -> "Bench":
        """Some cycles into the motion, half a cycle after a SYNC's frames."""
        self.until(Phase.MOTION)
        self.loop.run_until(self.hlc.time_zero + 5 * CYCLE - 100_000)
        assert not self.hlc.events
        return self

    def rows(self, *can_ids: int) -> list[Transmission]:
        return [row for row in self.loop.trace if row.frame.can_id in can_ids]

    def requested(self, row: Transmission) -> int:
        """When a frame that found the bus idle was sent: its end less its length."""
        return row.end_ns - row.frame.bits * 1000

    def sent_words(self, joint: int) -> list[int]:
        """Controlwords a drive got, repetitions left out."""
        found: list[int] = []
        for _, at, word, _ in self.drives.commands:
            if at == joint and (not found or found[-1] != word):
                found.append(word)
        return found

    def kinds(self) -> list[tuple[str, str]]:
        return [(event.joint, event.kind) for event in self.hlc.events]


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture(scope="module")
def walked() -> Bench:
    """A whole motion, to the end and 150 ms beyond. Not to be changed."""
    bench = Bench()
    bench.until(Phase.STOPPED)
    bench.loop.run_until(bench.loop.now + 150 * MS)
    return bench


def status_rows(bench: Bench) -> list[tuple[int, tuple[int, int, int]]]:
    """SYNC index (0 = the first one sent) and content of each status frame."""
    syncs = [row.end_ns for row in bench.rows(SYNC)]
    found = []
    for row in bench.rows(STATUS):
        state, cycle, phase = struct.unpack("<BHH", row.frame.data)
        found.append((sum(end < row.end_ns for end in syncs) - 1, (state, cycle, phase)))
    return found


# ---- enabling -----------------------------------------------------------------------------------------------------


def test_command_that_recurs_is_the_same_frame_and_only_so_many_are_kept() -> None:
    """RPDO1 with controlword 0x0F and the torque, int16; what is remembered is bounded."""
    commands = CommandFrames(0x205, PLAN.pdo("RPDO1"))
    for torque in range(-COMMANDS_KEPT, COMMANDS_KEPT):
        frame = commands.known.get(torque) or commands.frame(torque)
        assert frame == Frame(0x205, struct.pack("<Hh", 0x0F, torque))
        assert commands.known[torque] is frame
        assert len(commands.known) <= COMMANDS_KEPT


@pytest.mark.parametrize("joint", range(6))
def test_drives_are_enabled_state_by_state(walked: Bench, joint: int) -> None:
    """CiA 402-2: nothing before the first statusword, then 06, 07, 0F as the statusword shows; at the end 00."""
    assert walked.sent_words(joint) == [0x00, 0x06, 0x07, 0x0F, 0x00]


def test_no_torque_before_all_drives_are_enabled(walked: Bench) -> None:
    """Enabling drives hold zero torque: motion begins for all six at once."""
    enabled = [joint for _, joint, word, _ in walked.drives.commands if word == 0x0F]
    first_motion = min(now for now, _, _, torque in walked.drives.commands if torque)
    for joint in range(6):
        before = [word for now, at, word, _ in walked.drives.commands if at == joint and now < first_motion]
        assert 0x0F in before
    assert set(enabled) == set(range(6))


def test_a_drive_in_fault_is_reset_by_an_edge(bench: Bench) -> None:
    """Fault reset acts on the 0 -> 1 edge of bit 7: 80 and 00 in turn until the statusword shows the way on."""
    bench.drives.machines[4].fault()
    bench.until(Phase.STARTING)
    words = bench.sent_words(4)
    assert words[:3] == [0x00, 0x80, 0x00]
    assert words[-3:] == [0x06, 0x07, 0x0F]
    assert bench.sent_words(3) == [0x00, 0x06, 0x07, 0x0F]


def test_a_drive_that_is_already_enabled_is_taken_over(bench: Bench) -> None:
    """A drive in Operation enabled from before gets 00 until its statusword is known, and is then enabled anew."""
    for word in (0x06, 0x07, 0x0F):
        bench.drives.machines[2].controlword(word)
    bench.until(Phase.STARTING)
    assert bench.drives.machines[2].state is DriveState.OPERATION_ENABLED
    assert bench.sent_words(2) == [0x00, 0x06, 0x07, 0x0F]


# ---- time 0 and the status frame ----------------------------------------------------------------------------------


def test_time_zero_is_the_sync_at_which_the_fade_in_is_complete(walked: Bench) -> None:
    """Design: s reaches 1 after one stride; time 0 lies on the cycle grid and is that SYNC's request."""
    time_zero = walked.hlc.time_zero
    began = min(now for now, _, _, torque in walked.drives.commands if torque) // CYCLE * CYCLE
    assert time_zero == began + FADE_CYCLES * CYCLE
    motion = [index for index, (state, _, _) in status_rows(walked) if state == 2]
    assert walked.requested(walked.rows(SYNC)[motion[0]]) == time_zero


def test_status_goes_with_every_tenth_sync(walked: Bench) -> None:
    """0x2FF at time 0 and with every 10th SYNC: state u8, cycle u16, phase u16 (1/65536 stride); 3 once at the end."""
    rows = status_rows(walked)
    zero = next(index for index, (state, _, _) in rows if state == 2)
    expected = []
    for cycle in range(-FADE_CYCLES // 10 * 10 + 10, MOTION_CYCLES, 10):
        phase = math.floor((cycle % FADE_CYCLES) / FADE_CYCLES * 65536)  # a stride has FADE_CYCLES cycles
        expected.append((zero + cycle, (2, cycle, phase) if cycle >= 0 else (1, 0, phase)))
    assert rows == [*expected, (zero + MOTION_CYCLES, (3, 0, 0))]


def test_a_whole_motion_is_recorded_cycle_by_cycle(walked: Bench) -> None:
    """completed; one sample a cycle; nothing late; nothing noticed."""
    hlc = walked.hlc
    assert hlc.completed
    assert [sample.cycle for sample in hlc.samples] == list(range(MOTION_CYCLES))
    assert (hlc.late, hlc.events) == ([0] * 6, [])


# ---- the cycle and its deadline -----------------------------------------------------------------------------------


def cycles_of(bench: Bench, first: int, count: int) -> Iterable[list[Transmission]]:
    """The frames of motion cycles, each from its SYNC to the next."""
    for cycle in range(first, first + count):
        begin = bench.hlc.time_zero + cycle * CYCLE
        yield [row for row in bench.loop.trace if begin < row.end_ns <= begin + CYCLE]


def test_commands_go_out_when_the_last_sample_is_in(walked: Bench) -> None:
    """Never before the cycle's TPDO1s, and then at once: the first RPDO starts at the end of the last TPDO1."""
    for rows in cycles_of(walked, 0, MOTION_CYCLES):
        samples = [row.end_ns for row in rows if 0x181 <= row.frame.can_id <= 0x186]
        commands = [row for row in rows if 0x201 <= row.frame.can_id <= 0x206]
        assert len(samples) == 6
        assert [row.frame.can_id for row in commands] == [0x201 + joint for joint in range(6)]
        assert walked.requested(commands[0]) == max(samples)


def test_commands_are_the_controllers_torques_in_per_mille(walked: Bench) -> None:
    """q, dq -> tau [N m] -> 0x6071 [per mille of rated], nearest; controlword 0F."""
    law = make_controller()
    q = [counts * 2 * math.pi / 131_072 for counts in COUNTS]
    for cycle in range(FADE_CYCLES + MOTION_CYCLES):
        tau = law.step(cycle, q, [0.0] * 6)
        begin = walked.hlc.time_zero + (cycle - FADE_CYCLES) * CYCLE
        heard = [command for command in walked.drives.commands if begin < command[0] <= begin + CYCLE]
        assert [(joint, word) for _, joint, word, _ in heard] == [(joint, 0x0F) for joint in range(6)]
        for (_, joint, _, torque), nm in zip(heard, tau, strict=True):
            assert abs(torque - nm / RATED_MNM[joint] * 1e6) <= 0.5 + 1e-9  # rounding; 1e-9 for the division here


@pytest.mark.parametrize("silent", [{0}, {4}, {5}, {0, 1, 2, 3, 4, 5}])
def test_a_missing_sample_is_waited_for_until_the_deadline(bench: Bench, silent: set[int]) -> None:
    """Deadline 0.6 x cycle from the SYNC request, to the nanosecond; each missing value is counted, in the motion."""
    bench.in_motion().drives.silent = silent
    bench.cycles(7)
    bench.drives.silent = set()
    bench.cycles(3)
    for cycle, rows in enumerate(cycles_of(bench, 5, 7), 5):
        at = next(k for k, row in enumerate(rows) if row.frame.can_id == 0x201)
        deadline = bench.hlc.time_zero + cycle * CYCLE + DEADLINE
        assert bench.requested(rows[at]) == max(deadline, rows[at - 1].end_ns)  # a frame may be on the bus then
    assert bench.hlc.late == [7 if joint in silent else 0 for joint in range(6)]
    assert bench.hlc.phase is Phase.MOTION


def test_late_samples_are_not_counted_before_time_zero(bench: Bench) -> None:
    """`late` is a figure of the motion."""
    bench.until(Phase.STARTING)
    bench.drives.silent = {1}
    bench.cycles(5)
    assert bench.hlc.late == [0] * 6


@pytest.mark.parametrize("tardy_ns", [900_000, 1_060_000])
def test_a_sample_just_before_the_deadline_is_in_time(bench: Bench, tardy_ns: int) -> None:
    """Commands follow it at once, and nothing is counted (SYNC 57 us + wait + TPDO1 at most 135 us)."""
    bench.in_motion()
    bench.drives.tardy, bench.drives.tardy_ns = {3}, tardy_ns - 100_000
    bench.cycles(4)
    for rows in cycles_of(bench, 5, 4):
        (sample,) = [row for row in rows if row.frame.can_id == 0x184]
        assert bench.requested(next(row for row in rows if row.frame.can_id == 0x201)) == sample.end_ns
    assert bench.hlc.late == [0] * 6


def test_a_sample_after_the_deadline_counts_as_late_and_serves_the_next_cycle(bench: Bench) -> None:
    """Hold policy: the newest value there is; a cycle's commands are sent once."""
    bench.in_motion()
    bench.drives.tardy, bench.drives.tardy_ns = {3}, 1_300_000
    bench.cycles(4)
    assert bench.hlc.late == [0, 0, 0, 4, 0, 0]
    for rows in cycles_of(bench, 5, 4):
        assert [row.frame.can_id for row in rows if 0x201 <= row.frame.can_id <= 0x206] == list(range(0x201, 0x207))


def test_a_missing_value_is_held(bench: Bench) -> None:
    """The torque is that of the last value: the knee has moved on, the controller does not know."""
    law = make_controller()
    q = [counts * 2 * math.pi / 131_072 for counts in COUNTS]
    bench.in_motion()
    bench.drives.silent = {4}
    bench.drives.counts[4] += 5000
    bench.cycles(3)
    held = [law.step(cycle, q, [0.0] * 6) for cycle in range(FADE_CYCLES + 8)][-1]
    moved = list(q)
    moved[4] += 5000 * 2 * math.pi / 131_072
    bench.drives.silent = set()
    bench.cycles(1)
    fresh = law.step(FADE_CYCLES + 8, moved, [0.0] * 6)
    last, newest = bench.drives.commands[-12:-6], bench.drives.commands[-6:]
    for commands, tau in ((last, held), (newest, fresh)):
        assert [torque for _, _, _, torque in commands] == [
            math.floor(nm / RATED_MNM[joint] * 1e6 + 0.5) for joint, nm in enumerate(tau)
        ]


def test_a_tpdo1_that_is_too_short_is_no_sample(bench: Bench) -> None:
    """Bad bytes are data: not used, not raised, counted as late; a longer one is read as far as it is known."""
    bench.in_motion()
    bench.drives.silent = {0, 1}
    bench.loop.run_until(bench.hlc.time_zero + 5 * CYCLE + 100_000)
    bench.out.send(0, Frame(0x181, struct.pack("<i3x", 99_999)))
    bench.out.send(0, Frame(0x182, struct.pack("<ii", 1, 2)))
    bench.loop.run_until(bench.hlc.time_zero + 6 * CYCLE - 1)
    assert bench.hlc.late == [1, 0, 0, 0, 0, 0]


# ---- stopping -----------------------------------------------------------------------------------------------------


def test_the_end_leaves_the_drives_disabled_and_the_network_quiet(walked: Bench) -> None:
    """All drives out of Operation enabled, then NMT Pre-operational; no SYNC and no command after it."""
    assert [machine.state for machine in walked.drives.machines] == [DriveState.SWITCH_ON_DISABLED] * 6
    assert walked.master.state is MasterState.STOPPED
    (leave,) = [row for row in walked.rows(0x000) if row.frame.data == b"\x80\x00"]
    after = {row.frame.can_id for row in walked.loop.trace if row.end_ns > leave.end_ns + CYCLE}
    assert after <= {0x77F, *range(0x701, 0x707)}
    assert 0x701 in after
    assert not walked.drives.operational


def test_no_sync_follows_the_message_that_ends_the_network(walked: Bench) -> None:
    """The end: NMT Pre-operational goes where the next SYNC would, and is the last the master says but heartbeats."""
    (leave,) = [row for row in walked.rows(0x000) if row.frame.data == b"\x80\x00"]
    syncs = [walked.requested(row) for row in walked.rows(SYNC)]
    assert walked.requested(leave) == syncs[-1] + CYCLE
    after = [row.frame.can_id for row in walked.loop.trace if row.end_ns > leave.end_ns and row.sender == 0]
    assert set(after) == {0x77F}


def test_the_last_sync_belongs_to_a_cycle_that_commands_zero(walked: Bench) -> None:
    """From the end of the motion on every command is 00 with zero torque."""
    end = walked.hlc.time_zero + MOTION_CYCLES * CYCLE
    commands = [(word, torque) for now, _, word, torque in walked.drives.commands if now > end]
    assert commands
    assert set(commands) == {(0x00, 0)}


@pytest.mark.parametrize(
    ("statusword", "words"),
    [
        (0x0250, "switch on disabled"),
        (0x0231, "ready to switch on"),
        (0x0233, "switched on"),
        (0x0217, "quick stop active"),
        (0x0208, "fault"),
        (0x020F, "fault reaction active"),
        (0x0000, "not ready to switch on"),
        (0x0001, "undefined"),
    ],
)
@pytest.mark.parametrize("phase", [Phase.STARTING, Phase.MOTION])
def test_a_drive_that_leaves_operation_enabled_stops_all(
    bench: Bench, statusword: int, words: str, phase: Phase
) -> None:
    """Stop rule: the event names the joint and its state; from the next commands on all six get 00."""
    bench.until(phase)
    bench.drives.wordless = {4}
    bench.loop.run_until(bench.loop.now + CYCLE - bench.loop.now % CYCLE + 1_900_000)
    bench.drives.tell(4, statusword, bench.out)
    bench.cycles(1)
    (event,) = bench.hlc.events
    assert (event.joint, event.kind) == ("right_knee", "drive_stopped")
    assert words in event.text
    assert f"{statusword:04X}" in event.text
    assert [(joint, word, torque) for _, joint, word, torque in bench.drives.commands[-6:]] == [
        (joint, 0x00, 0) for joint in range(6)
    ]
    bench.drives.wordless = set()
    bench.until(Phase.STOPPED)
    assert not bench.hlc.completed
    assert struct.unpack("<BHH", bench.rows(STATUS)[-1].frame.data) == (3, 0, 0)


@pytest.mark.parametrize("statusword", [0x0237, 0x0A37, 0x02B7, 0xFFB7])
def test_other_statusword_bits_do_not_stop_the_motion(bench: Bench, statusword: int) -> None:
    """Limit active, warning, manufacturer bits: still Operation enabled."""
    bench.in_motion()
    bench.drives.wordless = {4}
    for _ in range(5):
        bench.drives.tell(4, statusword, bench.out)
        bench.cycles(1)
    assert bench.hlc.phase is Phase.MOTION


def test_a_silent_drive_is_noticed_by_its_heartbeat(bench: Bench) -> None:
    """Heartbeat consumer 300 ms: exactly so long after the last heartbeat the motion ends for all."""
    bench = Bench(motion_cycles=1000).in_motion()
    bench.drives.mute = {2}
    last = bench.rows(0x703)[-1].end_ns
    bench.loop.run_until(last + 300 * MS - 1)
    assert (bench.hlc.phase, bench.kinds()) == (Phase.MOTION, [])
    bench.loop.run_until(last + 300 * MS)
    assert bench.kinds() == [("left_ankle", "heartbeat_lost")]
    assert [event.time_ns for event in bench.hlc.events] == [last + 300 * MS]
    bench.until(Phase.STOPPED)
    others = [machine.state for joint, machine in enumerate(bench.drives.machines) if joint != 2]
    assert others == [DriveState.SWITCH_ON_DISABLED] * 5
    assert bench.kinds() == [("left_ankle", "heartbeat_lost"), ("left_ankle", "still_enabled")]


@pytest.mark.parametrize("joint", [0, 4])
def test_a_drive_that_never_sends_a_heartbeat_is_missed_too(joint: int) -> None:
    """Watched from the start command on: 300 ms after it the motion (or what leads to it) ends for all."""
    bench = Bench(motion_cycles=1000)
    bench.drives.beatless = {joint}
    bench.until(Phase.ENABLING)
    (start,) = [row for row in bench.rows(0x000) if row.frame.data == b"\x01\x00"]
    sent = bench.requested(start)
    bench.loop.run_until(sent + 300 * MS - 1)
    assert (bench.hlc.phase, bench.kinds()) == (Phase.MOTION, [])
    bench.loop.run_until(sent + 300 * MS)
    assert bench.kinds() == [(NAMES[joint], "heartbeat_lost")]
    bench.until(Phase.STOPPED)
    assert not bench.hlc.completed
    assert {machine.state for machine in bench.drives.machines} == {DriveState.SWITCH_ON_DISABLED}


@pytest.mark.parametrize("state", [0x04, 0x7F])
def test_a_drive_whose_heartbeat_tells_another_state_than_operational_ends_the_motion(state: int) -> None:
    """Stopped or Pre-operational: it takes no commands and tells no statusword; its next heartbeat ends it for all."""
    bench = Bench(motion_cycles=1000).in_motion()
    bench.loop.run_until(bench.rows(0x704)[-1].end_ns + 100 * MS + CYCLE)  # its heartbeats in Operational are in
    bench.drives.states = {3: state}
    before = len(bench.rows(0x704))
    while len(bench.rows(0x704)) == before:
        assert (bench.hlc.phase, bench.kinds()) == (Phase.MOTION, [])
        bench.cycles(1)
    (event,) = bench.hlc.events
    assert (event.joint, event.kind, event.time_ns) == ("right_hip", "nmt_state", bench.rows(0x704)[-1].end_ns)
    assert f"NMT state {state}" in event.text
    bench.until(Phase.STOPPED)
    assert not bench.hlc.completed
    assert bench.kinds() == [("right_hip", "nmt_state")]  # told once, by however many heartbeats
    assert {machine.state for machine in bench.drives.machines} == {DriveState.SWITCH_ON_DISABLED}


def test_a_drive_that_leaves_operational_while_enabling_ends_the_start() -> None:
    """As a lost one does: no torque ever."""
    bench = Bench()
    bench.drives.deaf_to_controlword = {0}
    bench.until(Phase.ENABLING)
    bench.loop.run_until(bench.loop.now + 150 * MS)
    bench.drives.states = {2: 0x7F}
    bench.until(Phase.STOPPED, bench.loop.now + 200 * MS)
    assert bench.kinds() == [("left_ankle", "nmt_state")]
    assert {torque for _, _, _, torque in bench.drives.commands} == {0}


def test_a_drive_that_boots_again_ends_the_motion(bench: Bench) -> None:
    """An unexpected boot-up message: that drive is no longer configured."""
    bench.in_motion()
    bench.out.send(0, Frame(0x705, b"\x00"))
    bench.cycles(1)
    assert bench.kinds() == [("right_knee", "reboot")]
    bench.until(Phase.STOPPED)
    assert not bench.hlc.completed


@pytest.mark.parametrize("code", [0x8210, 0x8220, 0x8240, 0x812F, 0x8100, 0x8131, 0x8251, 0x86FF, 0x8701, 0x4310])
def test_an_emcy_is_noted_and_does_not_stop_the_motion(bench: Bench, code: int) -> None:
    """What follows from most errors is the statusword's to say; 0000 tells that all is well again."""
    bench.in_motion()
    for sent, register in ((code, 0x11), (0x0000, 0x00)):
        bench.out.send(0, Frame(0x085, struct.pack("<HB5x", sent, register)))
        bench.cycles(1)
    first, second = bench.hlc.events
    assert [(event.joint, event.kind) for event in (first, second)] == [("right_knee", "emcy")] * 2
    assert f"{code:04X}" in first.text
    assert "gone" in second.text
    assert bench.hlc.phase is Phase.MOTION


STOPPING = [0x8110, 0x8120, 0x8130, 0x8140, 0x8250, 0x8700]
"""Overrun, error passive, heartbeat lost, bus-off left, RPDO deadline, SYNC lost: with them a drive drops its torque
(0x6007 = 2)."""


@pytest.mark.parametrize("phase", [Phase.STARTING, Phase.MOTION])
@pytest.mark.parametrize("code", STOPPING)
def test_an_emcy_with_which_a_drive_drops_its_torque_ends_the_motion(
    bench: Bench, code: int, phase: Phase
) -> None:
    """Stop rule: at the end of that frame, without waiting for a statusword; the next commands are 00 for all six."""
    bench.until(phase)
    bench.drives.wordless = set(range(6))
    bench.loop.run_until(bench.loop.now + CYCLE - bench.loop.now % CYCLE + 1_500_000)
    bench.out.send(0, Frame(0x082, struct.pack("<HB5x", code, 0x11)))
    bench.loop.run_until(bench.loop.now + 400_000)
    assert bench.hlc.phase is Phase.STOPPING
    (event,) = bench.hlc.events
    assert (event.joint, event.kind, event.time_ns) == ("left_knee", "emcy", bench.rows(0x082)[-1].end_ns)
    assert f"{code:04X}" in event.text
    assert struct.unpack("<BHH", bench.rows(STATUS)[-1].frame.data) == (3, 0, 0)  # it was sent at once
    bench.cycles(1)
    assert [(joint, word, torque) for _, joint, word, torque in bench.drives.commands[-6:]] == [
        (joint, 0x00, 0) for joint in range(6)
    ]
    bench.drives.wordless = set()
    bench.until(Phase.STOPPED)
    assert not bench.hlc.completed


@pytest.mark.parametrize("code", STOPPING)
def test_an_emcy_while_enabling_does_not_end_the_start(bench: Bench, code: int) -> None:
    """There is no torque to drop yet: the drive is enabled step by step as its statusword says."""
    bench.until(Phase.ENABLING)
    bench.cycles(3)
    bench.out.send(0, Frame(0x082, struct.pack("<HB5x", code, 0x11)))
    bench.until(Phase.MOTION)
    assert bench.kinds() == [("left_knee", "emcy")]


@pytest.mark.parametrize("size", range(8))
def test_an_emcy_of_another_length_is_none(bench: Bench, size: int) -> None:
    """CiA 301, 7.2.7.3.1: eight bytes; bad bytes from the wire end no motion."""
    bench.in_motion()
    bench.out.send(0, Frame(0x085, struct.pack("<HB5x", 0x8700, 0x11)[:size]))
    bench.cycles(1)
    assert (bench.hlc.phase, bench.hlc.events) == (Phase.MOTION, [])


def test_drives_that_never_report_disabled_are_named_and_left(bench: Bench) -> None:
    """200 ms, then SYNC ends all the same; the events say which drives."""
    bench.in_motion()
    bench.drives.deaf_to_controlword = {1, 5}
    bench.until(Phase.STOPPING)
    stopped = bench.loop.now
    bench.until(Phase.STOPPED)
    assert 200 * MS <= bench.loop.now - stopped <= 200 * MS + 2 * CYCLE
    assert bench.kinds() == [("left_knee", "still_enabled"), ("right_ankle", "still_enabled")]
    bench.cycles(1)
    assert bench.master.state is MasterState.STOPPED
    syncs = len(bench.rows(SYNC))
    bench.cycles(50)
    assert len(bench.rows(SYNC)) == syncs


# ---- a start that fails -------------------------------------------------------------------------------------------


def failed(bench: Bench) -> Event:
    bench.until(Phase.FAILED)
    assert bench.master.state is MasterState.FAILED
    bench.loop.run_until(bench.loop.now + 500 * MS)
    (event,) = bench.hlc.events
    assert event.kind == "start_failed"
    assert event.text == bench.master.failure
    assert not bench.rows(SYNC, *range(0x201, 0x207))  # no SYNC, no command to anyone
    return event


def test_a_drive_that_does_not_boot_is_named(bench: Bench) -> None:
    """What, where, limit, remedy: 1 s without boot-up."""
    bench.drives.mute = {3}
    text = failed(bench).text
    for part in ("right_hip", "node 4", "boot-up", "1 s", "check"):
        assert part in text


def test_a_drive_that_is_another_device_is_named(bench: Bench) -> None:
    """Identity: found and expected in the text."""
    bench.drives.device_type[1] = 0x00040192
    text = failed(bench).text
    for part in ("left_knee", "node 2", "device type", "1000", "0x00040192", "0x00020192"):
        assert part in text


@pytest.mark.parametrize("wordless", [True, False])
def test_a_drive_that_cannot_be_enabled_is_named_after_2_s(bench: Bench, wordless: bool) -> None:
    """The others are disabled again; the text tells the state, or that none was heard."""
    (bench.drives.wordless if wordless else bench.drives.deaf_to_controlword).add(5)
    bench.until(Phase.ENABLING)
    began = bench.loop.now
    bench.until(Phase.STOPPING)
    assert 2000 * MS - CYCLE <= bench.loop.now - began <= 2000 * MS + 2 * CYCLE
    (event,) = bench.hlc.events
    assert (event.joint, event.kind) == ("right_ankle", "start_failed")
    for part in ("2 s", "Operation enabled", "TPDO2" if wordless else "switch on disabled"):
        assert part in event.text
    bench.until(Phase.STOPPED)
    assert {machine.state for machine in bench.drives.machines} == {DriveState.SWITCH_ON_DISABLED}
    assert bench.hlc.time_zero == NEVER
    assert not bench.hlc.completed
    assert {torque for _, _, _, torque in bench.drives.commands} == {0}


def test_a_drive_lost_while_enabling_ends_the_start() -> None:
    """Heartbeat loss stops in every phase with drives in hand."""
    bench = Bench()
    bench.drives.deaf_to_controlword = {0}
    bench.until(Phase.ENABLING)
    bench.loop.run_until(bench.loop.now + 150 * MS)
    bench.drives.mute = {0}
    last = bench.rows(0x701)[-1].end_ns
    bench.loop.run_until(last + 300 * MS - 1)
    assert (bench.hlc.phase, bench.kinds()) == (Phase.ENABLING, [])
    bench.until(Phase.STOPPING, last + 300 * MS + CYCLE)
    assert bench.kinds() == [("left_hip", "heartbeat_lost")]
    bench.until(Phase.STOPPED)
    assert [struct.unpack("<BHH", row.frame.data) for row in bench.rows(STATUS)] == [(3, 0, 0)]
    assert not bench.hlc.completed
