"""The firmware of one joint controller: CiA 402 state machine, cyclic synchronous torque, torque limit, sensors.

Source: CiA 402-2 / IEC 61800-7-201: objects 0x6007, 0x603F, 0x6040, 0x6041, 0x6060, 0x6061, 0x6064, 0x606C, 0x6071,
0x6072, 0x6074, 0x6077; option codes 605A, 605B, 605C, 605E have their only value 0: disable the drive function at once.
Leaves out: every mode but CST, following error, position limits, temperature, supply; no mode has a ramp.
"""

from math import floor
from typing import Final, final

from canopen_exo.cia402 import FAULT_RESET_BIT, INTERNAL_LIMIT, DriveCommand, DriveState, DriveStateMachine
from canopen_exo.device import Application
from canopen_exo.od import ABORT_VALUE, ObjectDictionary
from canopen_exo.pdo import key_of
from joint_emulators.sensors import (
    EncoderParams,
    JointSensor,
    VelocityEstimateParams,
    to_int32,
)

CYCLIC_SYNCHRONOUS_TORQUE: Final = 10
NO_MODE: Final = 0

ERROR_REGISTER: Final = key_of(0x1001, 0)
ABORT_CONNECTION: Final = key_of(0x6007, 0)
ERROR_CODE: Final = key_of(0x603F, 0)
CONTROLWORD: Final = key_of(0x6040, 0)
STATUSWORD: Final = key_of(0x6041, 0)
MODE: Final = key_of(0x6060, 0)
MODE_DISPLAY: Final = key_of(0x6061, 0)
POSITION: Final = key_of(0x6064, 0)
VELOCITY: Final = key_of(0x606C, 0)
TARGET_TORQUE: Final = key_of(0x6071, 0)
MAX_TORQUE: Final = key_of(0x6072, 0)
TORQUE_DEMAND: Final = key_of(0x6074, 0)
RATED_TORQUE: Final = key_of(0x6076, 0)
TORQUE: Final = key_of(0x6077, 0)

_DROP_TORQUE: Final = 2
_FAULT_SIGNAL: Final = 1
_QUICK_STOP: Final = 3


@final
class Drive(Application):
    """One joint's drive. torque_nm: joint torque it asks of its motor [N m]; 0 unless Operation enabled in CST.

    `sensor` samples the truth after every step of the plant; everything else comes over the bus.
    """

    def __init__(self, od: ObjectDictionary, encoder: EncoderParams, velocity: VelocityEstimateParams) -> None:
        self.od: Final[ObjectDictionary] = od
        self.sensor: Final[JointSensor] = JointSensor(encoder, velocity)
        self.machine: DriveStateMachine = DriveStateMachine()
        self.torque_nm: float = 0.0
        self._nm_per_raw: float = od.values[RATED_TORQUE] / 1_000_000
        self._driving: bool = False
        self._limited: bool = False

    # --- Application ---------------------------------------------------------------------------------------------

    def reset(self, now: int) -> None:
        """Power-up or NMT reset node: Switch on disabled, no torque."""
        self.machine = DriveStateMachine()
        self._update()

    def applied(self, now: int) -> None:
        """New process data: controlword and target torque."""
        values = self.od.values
        controlword = values[CONTROLWORD]
        machine = self.machine
        if controlword == machine.last and values[MODE] == values[MODE_DISPLAY]:  # as nearly always
            self._command_torque()
            return
        if controlword & FAULT_RESET_BIT and not machine.last & FAULT_RESET_BIT and values[ERROR_REGISTER]:
            controlword &= ~FAULT_RESET_BIT  # no reset while the cause lasts; a bit that is held acts when it is gone
        if controlword != machine.last:
            if machine.controlword(controlword):
                if machine.state is DriveState.QUICK_STOP_ACTIVE:
                    machine.command(DriveCommand.DISABLE_VOLTAGE)  # 605A = 0
                elif machine.state is DriveState.SWITCH_ON_DISABLED and controlword & FAULT_RESET_BIT:
                    self.od.set(ERROR_CODE, 0)
            self._update()
        elif values[MODE] != values[MODE_DISPLAY]:  # a mapped 0x6060
            self._update()
        else:
            self._command_torque()

    def latch(self, now: int) -> None:
        """The last finished samples become the actual values."""
        values, sensor = self.od.values, self.sensor
        values[POSITION] = sensor.counts
        values[VELOCITY] = to_int32(sensor.speed)
        raw = floor(sensor.torque_nm / self._nm_per_raw + 0.5)
        values[TORQUE] = raw if -32768 <= raw <= 32767 else (32767 if raw > 0 else -32768)

    def left_operational(self, now: int) -> None:
        """No process data any more: as a lost connection."""
        self._abort_connection()

    def communication_lost(self, now: int, code: int) -> None:
        """Heartbeat, SYNC or RPDO lost: react as object 0x6007 says."""
        self.od.set(ERROR_CODE, code)
        self._abort_connection()

    def errors_gone(self) -> None:
        """Object 0x603F keeps the code of a fault until the fault is reset, and of nothing else."""
        if self.machine.state is not DriveState.FAULT:
            self.od.set(ERROR_CODE, 0)

    def check(self, key: int, raw: int) -> int:
        """SDO writes: only the modes there are."""
        if key == MODE and raw not in (NO_MODE, CYCLIC_SYNCHRONOUS_TORQUE):
            return ABORT_VALUE
        return 0

    def written(self, key: int, raw: int) -> None:
        """An SDO write acts like process data."""
        if key == CONTROLWORD:
            self.applied(0)
        elif key in (MODE, TARGET_TORQUE, MAX_TORQUE):
            self._update()

    # --- reactions -----------------------------------------------------------------------------------------------

    def _abort_connection(self) -> None:
        option = self.od.values[ABORT_CONNECTION]
        machine = self.machine
        machine.last &= FAULT_RESET_BIT  # the next controlword counts, even when it is the same again
        if option == _FAULT_SIGNAL:
            if machine.state is not DriveState.SWITCH_ON_DISABLED:
                machine.fault()
        elif option in (_DROP_TORQUE, _QUICK_STOP):  # 605A = 0: a quick stop disables as well
            machine.command(DriveCommand.DISABLE_VOLTAGE)
        self._update()

    def _update(self) -> None:
        """Torque, statusword and mode display from state, mode and limits."""
        values, machine = self.od.values, self.machine
        self._driving = machine.state is DriveState.OPERATION_ENABLED and values[MODE] == CYCLIC_SYNCHRONOUS_TORQUE
        values[MODE_DISPLAY] = values[MODE]
        values[STATUSWORD] = machine.statusword
        self._limited = False
        self._command_torque()

    def _command_torque(self) -> None:
        """The torque asked for, within the limit; the statusword tells when the limit acts."""
        values = self.od.values
        raw = 0
        limited = False
        if self._driving:
            raw = values[TARGET_TORQUE]
            limit = values[MAX_TORQUE]
            if raw > limit:
                raw, limited = limit, True
            elif raw < -limit:
                raw, limited = -limit, True
        if limited != self._limited:
            self._limited = limited
            values[STATUSWORD] ^= INTERNAL_LIMIT
        self.torque_nm = raw * self._nm_per_raw
        values[TORQUE_DEMAND] = raw
