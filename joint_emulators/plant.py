"""The body in the machine: MuJoCo steps it by 1 ms under joint torques; only this module of the package knows mujoco.

Input is the joint torque each driver is asked for; the motors' current lag and limits are the model's `dcmotor`
actuators (joint_emulators.motor says what they do). Output is the truth: angles, speeds, torques after the gear.
Left out: sensors (joint_emulators.sensors), drive firmware, contacts (the model decides).
"""

import copy
import ctypes
import struct
from dataclasses import dataclass
from typing import Final, final

import mujoco

from joint_emulators.errors import JointEmulatorError

STEP_NS: Final = 1_000_000
"""One step of the plant [ns]."""


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where the joints lie in the model. qpos_at, dof_at: first index; gears: shaft turns per joint turn."""

    joint_names: tuple[str, ...]
    qpos_at: int
    dof_at: int
    gears: list[float]


def rest_stopwatch() -> None:
    """MuJoCo takes no times of its own stages any more, in all of this process; nothing here reads them.

    It looks at the clock 24 times a step: a sixth of the step, and 0.6 of its 1 ms where the clock is a system call
    and system calls are dear (User Mode Linux). Its clock becomes a C function that costs nothing and means nothing;
    where the C library has none of that type (Windows), all stays as it is.
    """
    if hasattr(ctypes.pythonapi, "drand48"):
        mujoco.set_mjcb_time(ctypes.CFUNCTYPE(ctypes.c_double)(("drand48", ctypes.pythonapi)))


@final
class Plant:
    """A model with its state. mjcf: MJCF text with a 1 ms time step and one actuator a joint.

    joint_names: the hinges to drive and read, in the order of the model, with neighbouring degrees of freedom; every
    list below has this order and length. q: angles [rad], dq: speeds [rad/s], both at the end of the last step; tau:
    torque of the motors after the gear that acted during the last step [N m]. The three lists are replaced by each
    step, never changed.

    Raises JointEmulatorError for a model that does not fit. MuJoCo's silent reset of a diverged state is switched off.
    """

    def __init__(self, mjcf: str, joint_names: tuple[str, ...]) -> None:
        model = mujoco.MjModel.from_xml_string(mjcf)
        if model.opt.timestep != STEP_NS * 1e-9:
            raise JointEmulatorError(f"plant: the model's timestep is {model.opt.timestep} s, needed is 0.001 s")
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._bind(_layout(model, joint_names), model, mujoco.MjData(model))
        self.reset([0.0] * len(joint_names))

    def _bind(self, layout: _Layout, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Take model and state, with lasting views on what every step writes and reads."""
        n, qpos_at, dof_at = len(layout.joint_names), layout.qpos_at, layout.dof_at
        self._layout = layout
        self._gears = layout.gears
        self._model = model
        self._data = data
        self._command: list[float] = []
        self._ctrl = memoryview(data.ctrl).cast("B")
        self._pack = struct.Struct(f"{n}d").pack_into
        self._qpos = data.qpos[qpos_at : qpos_at + n]
        self._qvel = data.qvel[dof_at : dof_at + n]
        self._torque = data.qfrc_actuator[dof_at : dof_at + n]

    @property
    def model(self) -> mujoco.MjModel:
        """The model; nothing may write to it during a run."""
        return self._model

    @property
    def data(self) -> mujoco.MjData:
        """The state in MuJoCo's terms."""
        return self._data

    def reset(self, q: list[float]) -> None:
        """Time 0 at the joint angles q [rad], at rest, without current in the motors."""
        names = self._layout.joint_names
        if len(q) != len(names):
            raise JointEmulatorError(f"plant: {len(q)} angles given to reset, needed one for each of {names}")
        mujoco.mj_resetData(self._model, self._data)
        self._command = []
        self._qpos[:] = q
        mujoco.mj_forward(self._model, self._data)
        self._read()

    def step(self, tau_command: list[float]) -> None:
        """Advance by 1 ms with the joint torques asked of the drivers [N m], held over the step; 0 when disabled.

        Raises JointEmulatorError when a command or the state after the step is not finite.
        """
        if tau_command != self._command:  # the drives change it with SYNC only
            self._ask(tau_command)
        mujoco.mj_step(self._model, self._data)
        self._read()

    def _ask(self, tau_command: list[float]) -> None:
        """Write the command into the model's inputs, which a step leaves as they are."""
        shafts: list[float] = []
        total = 0.0
        for tau, gear in zip(tau_command, self._gears, strict=True):
            shaft = tau / gear
            shafts.append(shaft)
            total += shaft
        self._pack(self._ctrl, 0, *shafts)
        if total - total != 0.0:  # infinite or NaN; MuJoCo would silently command zero to all motors
            raise self._not_finite("torque command", tau_command)
        self._command = list(tau_command)

    def _read(self) -> None:
        self.q: list[float] = self._qpos.tolist()
        self.dq: list[float] = self._qvel.tolist()
        self.tau: list[float] = self._torque.tolist()
        total = sum(self.q) + sum(self.dq)
        if total - total != 0.0:
            raise self._not_finite("angle or speed", [q + dq for q, dq in zip(self.q, self.dq, strict=True)])

    def _not_finite(self, what: str, values: list[float]) -> JointEmulatorError:
        bad = [name for name, value in zip(self._layout.joint_names, values, strict=True) if value - value != 0.0]
        return JointEmulatorError(
            f"plant: {what} of {', '.join(bad) or 'all joints together'} is not finite at {self._data.time:.3f} s; "
            "the run cannot go on: look for a command or a parameter that drives the model apart"
        )

    def __deepcopy__(self, memo: dict[int, object]) -> "Plant":
        """A plant with its own state and the same model."""
        twin = Plant.__new__(Plant)
        memo[id(self)] = twin
        twin._bind(self._layout, self._model, copy.copy(self._data))
        twin._command = list(self._command)
        twin.q, twin.dq, twin.tau = self.q, self.dq, self.tau
        return twin


def _layout(model: mujoco.MjModel, joint_names: tuple[str, ...]) -> _Layout:
    """Find the joints and their actuators; raises JointEmulatorError when joints and model do not fit."""
    there = [model.joint(i).name for i in range(model.njnt)]
    missing = [name for name in joint_names if name not in there]
    if missing or not joint_names:
        raise JointEmulatorError(f"plant: joints {missing or 'none'} given, the model has {', '.join(there)}")
    first = there.index(joint_names[0])
    if there[first : first + len(joint_names)] != list(joint_names):
        raise JointEmulatorError(f"plant: joints {joint_names} given, the model's order is {', '.join(there)}")
    ids = list(range(first, first + len(joint_names)))
    if any(model.jnt_type[i] != mujoco.mjtJoint.mjJNT_HINGE for i in ids):
        raise JointEmulatorError(f"plant: joints {joint_names} given, allowed are hinges")
    driven = model.actuator_trnid[:, 0].tolist()
    if driven != ids or model.nu != len(ids):
        names = ", ".join(there[i] for i in driven) or "nothing"
        raise JointEmulatorError(f"plant: actuators drive {names}; needed is one for each of {joint_names}, in order")
    qpos_at, dof_at = int(model.jnt_qposadr[first]), int(model.jnt_dofadr[first])
    return _Layout(joint_names, qpos_at, dof_at, model.actuator_gear[:, 0].tolist())
