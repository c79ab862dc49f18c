"""What the plug-in's observer makes of frames, fed by hand."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo import plan as ids
from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_REMOTE, Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.cia402 import DriveState
from canopen_exo.master import MasterState
from canopen_exo.nmt import NmtCommand, NmtState, nmt_frame
from canopen_exo.plan import BusPlan
from testbench.errors import BenchError
from testbench.plugin.observer import CONTROLLER_BUS, DRIVE_BUS, ControllerState, Observer, frame_name
from testbench.scenario import default_joints

PLAN = BusPlan(default_joints())
KNEE = 5


def heard(*frames: Frame, bus: int = DRIVE_BUS, at: int = 0) -> Observer:
    observer = Observer(PLAN)
    for number, frame in enumerate(frames):
        observer.hear(Transmission(at + number * MS, bus, frame, -1))
    return observer


def test_a_quarter_turn_reads_as_such() -> None:
    """17-bit encoder: 32768 counts are pi / 2, and counts/s likewise; torque counts per mille of 54.9 N m."""
    observer = heard(
        Frame(ids.TPDO1 + KNEE, struct.pack("<ii", -32768, 65536)),
        Frame(ids.TPDO2 + KNEE, struct.pack("<HhH", 0x0237, -500, 0x8250)),
    )
    knee = observer.drives["right_knee"]
    assert knee.position_rad == pytest.approx(-1.5707963)
    assert knee.velocity_rad_s == pytest.approx(3.1415927)
    assert knee.torque_nm == pytest.approx(-27.45)
    assert (knee.statusword, knee.error_code, knee.state) == (0x0237, 0x8250, DriveState.OPERATION_ENABLED)


def test_both_buses_are_kept_apart() -> None:
    """The controller sees what the gateway made of a value, the drive bus shows the drive's own."""
    observer = heard(Frame(ids.TPDO1 + KNEE, struct.pack("<ii", 32768, 0)))
    observer.hear(Transmission(1, CONTROLLER_BUS, Frame(ids.TPDO1 + KNEE, bytes(8)), -1))
    assert observer.drives["right_knee"].position_rad == pytest.approx(1.5707963)
    assert observer.controller.drives["right_knee"].position_rad == 0.0


@pytest.mark.parametrize("what", ["position_rad", "velocity_rad_s", "torque_nm", "statusword", "error_code"])
def test_what_no_frame_has_carried_raises(what: str) -> None:
    """No neutral value stands for failure: 0.0 is an angle."""
    with pytest.raises(BenchError, match=r"right_knee: no TPDO[12] was on the drive bus yet"):
        getattr(Observer(PLAN).drives["right_knee"], what)


@pytest.mark.parametrize("frame", [Frame(0x185, bytes(7)), Frame(0x185, b"", FLAG_REMOTE, 8), Frame(0x186, bytes(8))])
def test_short_remote_and_foreign_frames_are_passed_over(frame: Frame) -> None:
    """Only a classical data frame that holds the whole PDO counts."""
    with pytest.raises(BenchError):
        _ = heard(frame).drives["right_knee"].position_rad


def test_a_boot_up_forgets_the_drives_state() -> None:
    """After a reset the last statusword is another life's."""
    knee = heard(
        Frame(ids.TPDO2 + KNEE, struct.pack("<HhH", 0x0237, 0, 0)), Frame(ids.HEARTBEAT + KNEE, b"\x00")
    ).drives["right_knee"]
    assert knee.state is None
    assert knee.nmt is NmtState.INITIALISING


@pytest.mark.parametrize(
    ("data", "state"),
    [
        (b"\x05", NmtState.OPERATIONAL),
        (b"\x85", NmtState.OPERATIONAL),
        (b"\x7f", NmtState.PRE_OPERATIONAL),
        (b"\x06", None),
    ],
)
def test_heartbeats_tell_the_nmt_state(data: bytes, state: NmtState | None) -> None:
    """CiA 301, 7.2.8.3.2.2: the state is in bits 0..6."""
    assert heard(Frame(ids.HEARTBEAT + KNEE, data)).drives["right_knee"].nmt is state


def test_emergencies_are_kept_and_reach_the_controllers_events() -> None:
    """CiA 301, 7.2.7: code, register; 0000 means that the errors are gone."""
    observer = heard(
        Frame(ids.EMCY + KNEE, struct.pack("<HB5x", 0x8250, 0x11)),
        Frame(ids.EMCY + KNEE, struct.pack("<HB5x", 0, 0)),
        Frame(ids.EMCY + KNEE, b"\x50"),
        bus=CONTROLLER_BUS,
        at=3,
    )
    events = observer.controller.events
    assert [one.code for one in observer.controller.drives["right_knee"].emergencies] == [0x8250, 0]
    assert [(one.time_ns, one.joint, one.text) for one in events[:2]] == [
        (3, "right_knee", "error 8250"),
        (3 + MS, "right_knee", "errors gone"),
    ]
    assert observer.drives["right_knee"].emergencies == []


def test_a_malformed_emergency_adds_no_event() -> None:
    """Bad bytes are data: passed over here."""
    good = Frame(ids.EMCY + KNEE, struct.pack("<HB5x", 0x8250, 1))
    observer = heard(good, Frame(ids.EMCY + KNEE, b"\x50"), bus=CONTROLLER_BUS)
    assert len(observer.controller.events) == 1


def test_nmt_commands_tell_the_masters_state() -> None:
    """CiA 301, 7.2.8.3.1; a command for one node alone is not about the start of all."""
    observer = Observer(PLAN)
    states = []
    for command, node in (
        (NmtCommand.RESET_COMMUNICATION, 0),
        (NmtCommand.START, 3),
        (NmtCommand.START, 0),
        (NmtCommand.ENTER_PRE_OPERATIONAL, 0),
        (NmtCommand.RESET_NODE, 0),
    ):
        observer.hear(Transmission(0, CONTROLLER_BUS, nmt_frame(command, node), -1))
        states.append(observer.master.state)
    assert states == [
        MasterState.BOOTING,
        MasterState.BOOTING,
        MasterState.OPERATIONAL,
        MasterState.STOPPED,
        MasterState.BOOTING,
    ]


def status(state: int, cycle: int, phase: int) -> Frame:
    return Frame(ids.HLC_STATUS, struct.pack("<BHH", state, cycle, phase))


def test_time_zero_is_the_sync_of_the_first_status_in_motion_less_its_cycles() -> None:
    """plan, HLC_STATUS: cycle counts the SYNCs since time 0; later status frames do not move it."""
    sync = Frame(ids.SYNC, b"\x01")
    observer = heard(status(2, 10, 0), sync, status(1, 0, 0x8000), bus=CONTROLLER_BUS, at=500 * MS)
    assert observer.time_zero_ns == NEVER  # motion without a SYNC before it, then no motion
    assert observer.controller.state is ControllerState.STARTING
    assert observer.controller.phase == 0.5
    for frame in (status(2, 10, 0x4000), sync, status(2, 12, 0)):
        observer.hear(Transmission(502 * MS, CONTROLLER_BUS, frame, -1))
    assert observer.time_zero_ns == 501 * MS - 10 * PLAN.cycle_ns
    assert (observer.controller.state, observer.controller.cycle) == (ControllerState.MOTION, 12)


@pytest.mark.parametrize(
    ("can_id", "name"),
    [
        (0x000, "NMT"),
        (0x080, "SYNC"),
        (0x085, "EMCY right_knee"),
        (0x185, "TPDO1 right_knee"),
        (0x206, "RPDO1 right_ankle"),
        (0x2FF, "controller status"),
        (0x581, "SDO answer left_hip"),
        (0x605, "SDO request right_knee"),
        (0x701, "heartbeat left_hip"),
        (0x77F, "heartbeat of the controller"),
        (0x187, ""),
        (0x405, ""),
        (0x7E5, ""),
    ],
)
def test_frames_are_named_as_in_the_bus_plan(can_id: int, name: str) -> None:
    """Failure reports say what an id means."""
    assert frame_name(PLAN, can_id) == name


@given(
    st.lists(
        st.tuples(
            st.sampled_from((CONTROLLER_BUS, DRIVE_BUS)),
            st.one_of(st.integers(0, 0x7FF), st.sampled_from((0, 0x80, 0x85, 0x185, 0x285, 0x2FF, 0x705))),
            st.binary(max_size=8),
            st.booleans(),
        ),
        max_size=20,
    )
)
def test_no_frame_can_raise(rows: list[tuple[int, int, bytes, bool]]) -> None:
    """Bad bytes from the wire are data."""
    observer = Observer(PLAN)
    for bus, can_id, data, extended in rows:
        observer.hear(Transmission(0, bus, Frame(can_id, data, FLAG_EXTENDED if extended else 0), -1))
