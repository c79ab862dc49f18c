"""The listener on both buses, connected to a rig in lock-step; and the status line made of it."""

import io
import os

import pytest

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_REMOTE, Frame
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState, Out, PortState
from canopen_exo.cia402 import DriveState
from canopen_exo.plan import STATUS_MOTION, STATUS_STOPPED, BusPlan
from testbench.rig import RigParams, build_rig
from testbench.run import drive_through
from testbench.scenario import JOINT_NAMES, default_joints
from testbench.status import StatusLine
from testbench.watch import ASK_EVERY_NS, CONTROLLER_PORT, DRIVE_PORT, Watch, alarms_text, states_text

PLAN = BusPlan(default_joints(), cycle_ns=10 * MS)
SYNC = Frame(0x80, b"\x01")


class Sent(Out):
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, Frame]] = []

    def send(self, port: int, frame: Frame) -> None:
        self.frames.append((port, frame))


def cycle(watch: Watch, now: int, answers: int = 6, commands: int = 6) -> None:
    """One control cycle as heard on the controller bus."""
    watch.receive(now, CONTROLLER_PORT, SYNC, Sent())
    for base, count in ((0x180, answers), (0x200, commands)):
        for node_id in range(1, count + 1):
            watch.receive(now + MS, CONTROLLER_PORT, Frame(base + node_id, bytes(4)), Sent())


# --- in a rig --------------------------------------------------------------------------------------------------------


def test_listener_sees_a_whole_run_as_the_rig_knows_it() -> None:
    """Time 0, phase, states of the drives, cycles on time: all from frames alone."""
    rig = build_rig(RigParams(PLAN, False, 1500 * MS, 500 * MS), [])
    watch = Watch(PLAN)
    rig.loop.connect(watch, [rig.controller_bus, rig.drive_bus])
    rig.loop.run_until(40 * MS)
    assert watch.missing(DRIVE_PORT) == []  # the boot-up messages
    assert watch.master_heard
    rig.loop.run_until(2 * SECOND)
    assert set(watch.states.values()) == {DriveState.OPERATION_ENABLED}
    drive_through(rig, lambda share: None)
    # the instant at which its SYNC was queued, plus the frame time of SYNC with its counter (at least 52 bits)
    assert 52_000 <= watch.time_zero - rig.controller.time_zero <= 70_000
    assert watch.late == 0
    assert watch.cycles > 190
    assert watch.offsets.worst_ns < MS  # the bus may be busy when SYNC is due, for at most one frame
    assert watch.motion == STATUS_STOPPED
    assert watch.alarms == []
    assert set(watch.states.values()) == {DriveState.SWITCH_ON_DISABLED}
    # all that passed, but for what is under way, and what the boot-up messages before time 0 are
    busy = [sum(row.frame.bits for row in rig.loop.trace if row.bus == bus) for bus in (0, 1)]
    assert watch.bits == busy


def test_drives_that_run_already_are_found_by_asking_and_gateway_by_their_answers() -> None:
    """Ready by CAN traffic, not by sleeping: an SDO upload of 0x1000, answered on the bus it is asked on."""
    rig = build_rig(RigParams(PLAN, False, 1500 * MS, 500 * MS), [])
    rig.loop.run_until(3 * SECOND)
    watch = Watch(PLAN)
    rig.loop.connect(watch, [rig.controller_bus, rig.drive_bus])
    for port in (DRIVE_PORT, CONTROLLER_PORT):
        watch.ask(rig.loop.now, port)
        assert len(watch.missing(port)) == 6
        rig.loop.run_until(rig.loop.now + 50 * MS)
        assert watch.missing(port) == []
    rig.loop.run_until(rig.loop.now + 2 * ASK_EVERY_NS)
    assert watch.wake_at == NEVER


# --- alone -----------------------------------------------------------------------------------------------------------


def test_only_those_that_are_missing_are_asked_again() -> None:
    """A question every 100 ms until all have answered."""
    watch, out = Watch(PLAN), Sent()
    watch.ask(5, DRIVE_PORT)
    watch.wake(5, out)
    assert [(port, frame.can_id) for port, frame in out.frames] == [(1, 0x600 + node) for node in range(1, 7)]
    assert all(frame.data.hex() == "4000100000000000" for _, frame in out.frames)
    assert watch.wake_at == 5 + ASK_EVERY_NS
    for node_id in (1, 2, 3, 5, 6):
        watch.receive(7, DRIVE_PORT, Frame(0x580 + node_id, bytes(8)), out)
    assert watch.missing(DRIVE_PORT) == ["right_hip"]
    out.frames.clear()
    watch.wake(watch.wake_at, out)
    assert [frame.can_id for _, frame in out.frames] == [0x604]
    watch.receive(8, DRIVE_PORT, Frame(0x704, b"\x00"), out)
    out.frames.clear()
    watch.wake(watch.wake_at, out)
    assert (out.frames, watch.wake_at) == ([], NEVER)


def test_heartbeat_on_the_controller_bus_is_no_proof_of_both_directions() -> None:
    """A gateway that passes one way only is not ready."""
    watch = Watch(PLAN)
    watch.receive(0, CONTROLLER_PORT, Frame(0x701, b"\x05"), Sent())
    assert "left_hip" in watch.missing(CONTROLLER_PORT)


@pytest.mark.parametrize(("answers", "commands", "late"), [(6, 6, 0), (5, 6, 1), (6, 5, 1), (0, 0, 1)])
def test_cycle_is_late_when_answers_or_commands_miss_the_next_sync(answers: int, commands: int, late: int) -> None:
    """Design: the drives' answers and the controller's commands must be there before the next SYNC."""
    watch = Watch(PLAN)
    for number in range(10):
        cycle(watch, number * 10 * MS)
    assert (watch.cycles, watch.late) == (8, 0)  # from the first complete one on
    cycle(watch, 100 * MS, answers, commands)
    cycle(watch, 113 * MS)
    cycle(watch, 120 * MS)
    assert (watch.cycles, watch.late, watch.offsets.worst_ns) == (11, late, 3 * MS)


def test_cycles_before_the_rig_runs_are_not_late() -> None:
    """While the drives are enabled not everything is there yet."""
    watch = Watch(PLAN)
    for number in range(10):
        cycle(watch, number * 10 * MS, answers=6, commands=0)
    assert (watch.cycles, watch.late) == (0, 0)


def test_emergencies_and_reboots_are_noticed() -> None:
    """EMCY code and joint; a boot-up message forgets the state."""
    watch = Watch(PLAN)
    watch.receive(3, DRIVE_PORT, Frame(0x282, bytes.fromhex("270200000000")), Sent())
    watch.receive(5, DRIVE_PORT, Frame(0x82, bytes.fromhex("3081110000000000")), Sent())
    assert [(one.time_ns, one.joint, one.code) for one in watch.alarms] == [(5, "left_knee", 0x8130)]
    assert watch.states["left_knee"] is DriveState.OPERATION_ENABLED
    watch.receive(6, DRIVE_PORT, Frame(0x702, b"\x00"), Sent())
    assert watch.states["left_knee"] is None


@pytest.mark.parametrize(
    "frame",
    [
        Frame(0x281, b""),
        Frame(0x81, b"\x30"),
        Frame(0x2FF, b"\x02\x00"),
        Frame(0x701, b""),
        Frame(0x181, b""),
        Frame(0x80, b""),
        Frame(0x000, b""),
        Frame(0x281, b"", FLAG_REMOTE, 6),
        Frame(0x281, b"\x27\x02\x00\x00\x00\x00", FLAG_EXTENDED),
    ],
)
@pytest.mark.parametrize("port", [CONTROLLER_PORT, DRIVE_PORT])
def test_short_and_foreign_frames_do_no_harm(frame: Frame, port: int) -> None:
    """Bad bytes from the wire are data."""
    watch = Watch(PLAN)
    watch.receive(1, port, frame, Sent())
    assert set(watch.states.values()) == {None}
    assert watch.time_zero == NEVER


def test_end_of_the_motion_is_told_with_its_cause_and_lateness() -> None:
    """The first drive that dropped its torque, its code in words; and that the rig was late, when it was."""
    watch = Watch(PLAN)
    cycle(watch, 0)
    for number in range(1, 5):
        cycle(watch, number * PLAN.cycle_ns)
    assert watch.timing_words() == ""
    cycle(watch, 7 * PLAN.cycle_ns, answers=5)
    cycle(watch, 8 * PLAN.cycle_ns)
    worst = f"{2 * PLAN.cycle_ns / 1e6:.1f}"
    late = f"the rig was late: 1 of 5 cycles, SYNC off by at most {worst} ms (50 %: 0.0, 99 %: {worst}); "
    assert watch.timing_words().startswith(late + "this machine is too busy for ")
    for node_id, code in ((2, 0x8700), (1, 0x8250)):
        watch.receive(0, DRIVE_PORT, Frame(0x80 + node_id, code.to_bytes(2, "little") + bytes(6)), Sent())
    watch.receive(0, CONTROLLER_PORT, Frame(0x2FF, bytes((STATUS_STOPPED, 0, 0, 0, 0))), Sent())
    assert watch.ended_by == f"{JOINT_NAMES[1]} dropped its torque: SYNC lost (8700)"
    expected = f"RPDO time-out (8250): {JOINT_NAMES[0]}; SYNC lost (8700): {JOINT_NAMES[1]}"
    assert alarms_text(watch.alarms) == expected


# --- status line -----------------------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def test_status_line_has_load_lateness_drive_states_and_active_faults() -> None:
    """Design: bus load, cycle lateness, drive states, active faults."""
    watch = Watch(PLAN)
    line = StatusLine(watch, Terminal(), lambda: ["freeze_position"])
    line.text(0)
    for number in range(50):
        cycle(watch, number * 10 * MS)
    watch.receive(0, DRIVE_PORT, Frame(0x281, bytes.fromhex("270200000000")), Sent())
    watch.receive(490 * MS, CONTROLLER_PORT, Frame(0x2FF, bytes([STATUS_MOTION, 10, 0, 0, 128])), Sent())
    watch.port_changed(0, PortState(1, ErrorState.BUS_OFF, 256, 0, "no acknowledge"), Sent())
    text = line.text(500 * MS)
    assert watch.time_zero == 390 * MS
    share = 100 * watch.bits[0] / 500_000
    assert text == (
        "walking 0.1 s | drive bus bus off | 1 enabled, 5 no status | "
        f"load {share:.0f}, 0 % | late 0/48, 0.0 ms | 1 fault: freeze_position"
    )


@pytest.mark.parametrize("columns", [0, 1, 2, 20, 80, 500])
def test_status_line_never_wraps(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """What wraps could not be rewritten in place. A terminal that does not tell its width (0) gets all of it."""
    terminal = Terminal()
    monkeypatch.setattr(terminal, "fileno", lambda: 2)
    monkeypatch.setattr(os, "get_terminal_size", lambda fd: os.terminal_size((columns, 25)))
    line = StatusLine(Watch(PLAN), terminal, lambda: ["freeze_position"])
    whole = line.text(0)
    line.show(0)
    shown = terminal.getvalue().removeprefix("\r\x1b[K")
    assert len(shown) < columns or shown == whole
    assert (shown == whole) == (columns in (0, 500))
    assert whole.startswith(shown.rstrip("."))


def test_status_line_of_80_columns_has_load_and_lateness_also_while_faults_act(monkeypatch: pytest.MonkeyPatch) -> None:
    """They count most then; it is the names of faults that are cut."""
    terminal = Terminal()
    monkeypatch.setattr(terminal, "fileno", lambda: 2)
    monkeypatch.setattr(os, "get_terminal_size", lambda fd: os.terminal_size((80, 25)))
    watch = Watch(PLAN)
    watch.states.update(dict.fromkeys(JOINT_NAMES, DriveState.OPERATION_ENABLED))
    watch.motion, watch.time_zero = STATUS_MOTION, 0
    watch.cycles, watch.late = 41_400, 99
    watch.offsets.add(15_300_000)
    StatusLine(watch, terminal, lambda: ["freeze_position", "zero_velocity"]).show(123 * SECOND)
    shown = terminal.getvalue().removeprefix("\r\x1b[K")
    assert shown.startswith("walking 123.0 s | 6 enabled | load 0, 0 % | late 99/41400, 15.3 ms | 2 fault")
    assert shown.endswith("...")


def test_status_line_is_rewritten_in_place_and_only_on_a_terminal() -> None:
    """stderr into a file gets no control characters."""
    watch = Watch(PLAN)
    terminal, file = Terminal(), io.StringIO()
    for stream in (terminal, file):
        line = StatusLine(watch, stream, list)
        for now in range(0, 500 * MS, MS):
            line.show(now)
        line.clear()
    assert file.getvalue() == ""
    assert terminal.getvalue().count("\r\x1b[K") == 3  # two lines in half a second, one clearing
    assert "\n" not in terminal.getvalue()


def test_equal_states_are_told_together() -> None:
    """One glance."""
    states = [DriveState.OPERATION_ENABLED] * 5 + [DriveState.FAULT]
    assert states_text(states) == "5 operation enabled, 1 fault"
    assert len(JOINT_NAMES) == 6
