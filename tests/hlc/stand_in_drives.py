"""The high-level controller on a bus with six stand-in drives."""

import struct

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium, Transmission
from canopen_exo.bus.node import MS, NEVER, SECOND, Node, Out
from canopen_exo.cia402 import DriveStateMachine
from canopen_exo.master import Expected, Master, SlaveConfig
from canopen_exo.plan import BusPlan, JointNode
from hlc.controller import Controller, build_controller, paper_params
from hlc.gait import packaged_recording
from hlc.node import HighLevelController, Phase

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


def status_rows(bench: Bench) -> list[tuple[int, tuple[int, int, int]]]:
    """SYNC index (0 = the first one sent) and content of each status frame."""
    syncs = [row.end_ns for row in bench.rows(SYNC)]
    found = []
    for row in bench.rows(STATUS):
        state, cycle, phase = struct.unpack("<BHH", row.frame.data)
        found.append((sum(end < row.end_ns for end in syncs) - 1, (state, cycle, phase)))
    return found


def whole_motion() -> Bench:
    """A whole motion, to the end and 150 ms beyond."""
    bench = Bench()
    bench.until(Phase.STOPPED)
    bench.loop.run_until(bench.loop.now + 150 * MS)
    return bench
