"""The high-level controller on a bus with six stand-in drives: every way to stop, and a start that fails."""

import struct

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.cia402 import DriveState
from canopen_exo.master import MasterState
from hlc.node import Event, Phase
from tests.hlc.stand_in_drives import CYCLE, MOTION_CYCLES, NAMES, STATUS, SYNC, Bench, whole_motion


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture(scope="module")
def walked() -> Bench:
    """Not to be changed."""
    return whole_motion()


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
