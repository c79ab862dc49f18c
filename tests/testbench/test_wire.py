"""Errors on the buses of the whole rig: what drives and controller make of them."""

import numpy as np
import pytest

from canopen_exo.bus.bit_stream import FIELDS
from canopen_exo.bus.disturbance import Disturbance
from canopen_exo.bus.frame import FLAG_ERROR
from canopen_exo.bus.node import MS, NEVER, SECOND, ErrorState
from canopen_exo.bus.trace import trace_hash
from canopen_exo.bus.wire import Wire
from canopen_exo.plan import BusPlan
from fi_gateway.wire_faults import BitError, BitErrorRate, mask_of
from hlc.node import Phase
from testbench.rig import CONTROLLER_BUS, DRIVE_BUS, Rig, RigParams, build_rig
from testbench.run import drive_through
from testbench.scenario import default_joints

pytestmark = pytest.mark.run

PLAN = BusPlan(default_joints())
NAMES = [joint.name for joint in PLAN.joints]
KNEE = NAMES.index("left_knee")
KNEE_PORT = 1 + KNEE
"""On the drive bus: the gateway is port 0, then the drives."""


def rig_of(duration_ns: int = 2 * SECOND) -> Rig:
    return build_rig(RigParams(PLAN, False, 1500 * MS, duration_ns), [])


def wired(rig: Rig, bus: int, *disturbances: Disturbance) -> Wire:
    wire = Wire(rig.loop.media[bus], list(disturbances))
    rig.loop.install(wire, rig.loop.media[bus])
    return wire


def walking(rig: Rig) -> Rig:
    """Half a second into the motion."""
    while rig.controller.phase is not Phase.MOTION:
        rig.loop.run_until(rig.loop.now + 2 * MS)
    rig.loop.run_until(rig.loop.now + 500 * MS)
    return rig


def test_run_without_errors_has_the_same_trace_whether_errors_are_possible_or_not() -> None:
    """Clean frames keep their times."""
    hashes = []
    for with_wire in (False, True):
        rig = rig_of()
        if with_wire:
            wired(rig, CONTROLLER_BUS)
            wired(rig, DRIVE_BUS)
        drive_through(rig, lambda share: None)
        hashes.append(trace_hash(rig.loop.trace))
    assert hashes[0] == hashes[1]


def test_noise_on_both_buses_is_survived() -> None:
    """1e-5: some dozens of error frames, no state but error-active, and the walk goes to its end."""
    rig = rig_of()
    for bus in (CONTROLLER_BUS, DRIVE_BUS):
        noise = BitErrorRate(1e-5, 1000, np.random.default_rng(bus))
        noise.begin(0)
        wired(rig, bus, noise)
    drive_through(rig, lambda share: None)
    assert rig.controller.completed
    assert sum(row.frame.flags == FLAG_ERROR for row in rig.loop.trace) > 20
    for medium in rig.loop.media:
        assert medium.errors > 10
        assert {port.state for port in medium.ports} == {ErrorState.ERROR_ACTIVE}


def test_drive_that_goes_bus_off_drops_its_torque_at_once_and_tells_8140_when_it_is_back() -> None:
    """6007 at bus-off; the controller ends the motion with the EMCY."""
    rig = rig_of()
    wire = wired(rig, DRIVE_BUS)
    walking(rig)
    port = rig.drive_bus.ports[KNEE_PORT]
    port.restart_ns = 50 * MS
    now = rig.loop.now
    assert rig.rack.drives[KNEE].torque_nm != 0
    wire.switch_off(now, port)
    assert rig.rack.drives[KNEE].torque_nm == 0
    assert all(drive.torque_nm != 0 for drive in rig.rack.drives if drive is not rig.rack.drives[KNEE])
    rig.loop.run_until(now + 60 * MS)
    (event,) = [one for one in rig.controller.events if "8140" in one.text]
    assert event.joint == "left_knee"
    assert now + 50 * MS + 1408_000 < event.time_ns < now + 54 * MS
    drive_through(rig, lambda share: None)
    assert not rig.controller.completed


def test_drive_that_stays_bus_off_hears_nothing_and_is_lost_by_its_heartbeat() -> None:
    """Master: 300 ms after the last heartbeat; drive: SYNC loss after five cycles; the other drives go on."""
    rig = rig_of()
    wire = wired(rig, DRIVE_BUS)
    walking(rig)
    port = rig.drive_bus.ports[KNEE_PORT]
    port.restart_ns = NEVER
    now = rig.loop.now
    rows = len(rig.loop.trace)
    wire.switch_off(now, port)
    rig.loop.run_until(now + 300 * MS)
    assert rig.rack.devices[KNEE].emcy.active.keys() >= {0x8700}
    assert not any(0x8700 in device.emcy.active for device in rig.rack.devices if device.port != KNEE)
    lost = [event for event in rig.controller.events if event.kind == "heartbeat_lost"]
    assert [event.joint for event in lost] == ["left_knee"]
    sent = [row for row in rig.loop.trace[rows:] if row.bus == DRIVE_BUS and not row.frame.flags]
    assert KNEE_PORT not in {row.sender for row in sent[1:]}  # one may have been under way
    assert port.lost > 0


def test_drive_whose_frames_always_fail_becomes_passive_then_bus_off() -> None:
    """EMCY 8120 gets through, since its id is lower, and brings the TEC back by 1; then bus-off, and 8140."""
    rig = rig_of()
    fault = BitError("crc", 2, cob_ids=(0x182,))
    assert fault.field in FIELDS
    wired(rig, DRIVE_BUS, fault)
    walking(rig)
    states: list[ErrorState] = []
    fault.begin(rig.loop.now)
    port = rig.drive_bus.ports[KNEE_PORT]
    for _ in range(2000):
        rig.loop.run_until(rig.loop.now + 20_000)
        if not states or states[-1] is not port.state:
            states.append(port.state)
    assert states[:3] == [ErrorState.ERROR_ACTIVE, ErrorState.WARNING, ErrorState.ERROR_PASSIVE]
    assert states[-1] is ErrorState.BUS_OFF
    fault.end(rig.loop.now)
    codes = [event.text for event in rig.controller.events if event.joint == "left_knee"]
    assert any("8120" in text for text in codes)
    rig.loop.run_until(rig.loop.now + 200 * MS)
    assert any("8140" in event.text for event in rig.controller.events)


def test_error_at_one_passive_drive_keeps_the_frame_from_it_alone() -> None:
    """Its flag is recessive: the others have the frame, it does not."""
    rig = rig_of()
    fault = BitError("crc", 2, mask_of([KNEE_PORT]), (0x080,))
    wire = wired(rig, DRIVE_BUS, fault)
    walking(rig)
    port = rig.drive_bus.ports[KNEE_PORT]
    port.tec, port.state = 200, ErrorState.ERROR_PASSIVE
    wire.reconsider()
    fault.begin(rig.loop.now)
    rig.loop.run_until(rig.loop.now + 13 * MS)
    assert 0x8700 in rig.rack.devices[KNEE].emcy.active
    assert not any(0x8700 in device.emcy.active for device in rig.rack.devices if device.port != KNEE)
