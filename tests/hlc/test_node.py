"""The high-level controller on a bus with six stand-in drives: enabling, time 0, the cycle, its deadline."""

import math
import struct
from collections.abc import Iterable

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.cia402 import DriveState
from hlc.node import COMMANDS_KEPT, CommandFrames, Phase
from tests.hlc.stand_in_drives import (
    COUNTS,
    CYCLE,
    DEADLINE,
    FADE_CYCLES,
    MOTION_CYCLES,
    PLAN,
    RATED_MNM,
    SYNC,
    Bench,
    make_controller,
    status_rows,
    whole_motion,
)


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture(scope="module")
def walked() -> Bench:
    """Not to be changed."""
    return whole_motion()


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
