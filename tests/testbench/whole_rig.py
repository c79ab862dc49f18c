"""The whole rig: built, run to a phase or to its end, and read."""

from canopen_exo.bus.medium import Medium, Transmission
from canopen_exo.bus.node import MS, SECOND
from canopen_exo.plan import BusPlan
from canopen_exo.signal import Signal
from fi_gateway.effects import ConstantTime
from fi_gateway.events import At
from fi_gateway.faults import Drop, Fault
from fi_gateway.injector import Injector, Target, stream
from hlc.node import Phase
from testbench.rig import DRIVE_BUS, Rig, RigParams, build_rig
from testbench.scenario import default_joints

PLAN = BusPlan(default_joints())
NAMES = tuple(joint.name for joint in PLAN.joints)
CYCLE = 2 * MS
STRIDE = 1500 * MS
DURATION = 7 * SECOND
RIGHT_KNEE = NAMES.index("right_knee")
KNEE_POSITION: Signal = next(
    signal for signal in PLAN.signals() if (signal.node, signal.name) == ("right_knee", "position")
)

SYNC_LOST, RPDO_LATE, HEARTBEAT_LOST = 0x8700, 0x8250, 0x8130
STATUSWORD_KEY, ERROR_CODE_KEY = 0x6041 << 8, 0x603F << 8
SWITCH_ON_DISABLED = 0x0250
"""Statusword: Switch on disabled, voltage present, remote."""

Row = tuple[int, int, int, int, int, bytes]


def new_rig(injectors: list[Injector] | None = None, *, stops: bool = False, duration_ns: int = DURATION) -> Rig:
    return build_rig(RigParams(PLAN, stops, STRIDE, duration_ns), injectors if injectors is not None else [])


def run_to(rig: Rig, phase: Phase, limit: int = 12 * SECOND) -> Rig:
    """Run, cycle by cycle, until the controller is in that phase."""
    while rig.controller.phase is not phase:
        assert rig.loop.now < limit, f"still {rig.controller.phase.value} at {limit / 1e9:g} s"
        rig.loop.run_until(rig.loop.now + CYCLE)
    return rig


def finished(rig: Rig) -> Rig:
    """Run to the end, and 50 ms on."""
    run_to(rig, Phase.STOPPED)
    rig.loop.run_until(rig.loop.now + 50 * MS)
    return rig


def injector(fault: Fault, at_ns: int, duration_ns: int, cob_id: int) -> Injector:
    """From the drives to the controller, at a time of the motion."""
    target = Target(True, False, (cob_id,))
    return Injector("x", target, fault, At((at_ns,)), ConstantTime(duration_ns), None, stream(1, 0, "x"), True, False)


def dropped(
    cob_id: int,
    at_ns: int,
    duration_ns: int,
    *,
    to_drives: bool = True,
    name: str = "drop",
    from_power_up: bool = False,
) -> Injector:
    """Loses every frame of an id in one direction for a time."""
    target = Target(not to_drives, to_drives, (cob_id,), "SYNC 0x080" if cob_id == 0x080 else "")
    effect = ConstantTime(duration_ns)
    return Injector(name, target, Drop(), At((at_ns,)), effect, None, stream(1, 0, name), True, from_power_up)


def trace(rows: list[Transmission]) -> list[Row]:
    return [(row.end_ns, row.bus, row.sender, row.frame.can_id, row.frame.flags, row.frame.data) for row in rows]


def statuswords(rig: Rig) -> list[int]:
    return [device.od.values[STATUSWORD_KEY] for device in rig.rack.devices]


def error_codes(rig: Rig) -> list[int]:
    return [device.od.values[ERROR_CODE_KEY] for device in rig.rack.devices]


def torques(rig: Rig) -> list[float]:
    return [drive.torque_nm for drive in rig.rack.drives]


def bus_of(rig: Rig, bus: int) -> Medium:
    return rig.drive_bus if bus == DRIVE_BUS else rig.controller_bus


def cut_after_3_s(bus: int) -> tuple[Rig, int]:
    """A rig in motion whose cable breaks 3 s after time 0; it, and when."""
    rig = run_to(new_rig(), Phase.MOTION)
    cut = rig.controller.time_zero + 3 * SECOND
    rig.loop.run_until(cut)
    bus_of(rig, bus).cut()
    return rig, cut
