"""Six drives on one plant: when physics runs, what SYNC latches, who hears what."""

import copy
import math
import struct

import pytest

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_REMOTE, Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, Node, Out
from canopen_exo.device import Device
from canopen_exo.eds import load_eds
from canopen_exo.od import ObjectDictionary
from canopen_exo.pdo import key_of
from joint_emulators.drive import Drive
from joint_emulators.models.exoskeleton import JOINT_NAMES, USER_75KG, build_mjcf
from joint_emulators.motor import MOTORS
from joint_emulators.plant import Plant
from joint_emulators.rack import Rack
from joint_emulators.sensors import ENCODER, VELOCITY, VelocityEstimateState, encode, estimate_velocity, to_int32

RATED_MNM = 50_000
NM = RATED_MNM * 1e-6
"""One per mille of the rated torque [N m]."""
ENTRIES = load_eds()
MJCF = build_mjcf(USER_75KG, MOTORS, stops=False)
BENT = [0.4, -0.6, 0.1, -0.2, -0.3, -0.1]


class Sink(Out):
    def __init__(self) -> None:
        self.sent: list[tuple[int, int, Frame]] = []
        self.now = 0

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append((self.now, port, frame))


@pytest.fixture(scope="module")
def pattern() -> Plant:
    return Plant(MJCF, JOINT_NAMES)


class Bench:
    """A rack at power-up with bent legs, called as a loop would call it: wake-ups due before now first."""

    def __init__(self, pattern: Plant) -> None:
        plant = copy.deepcopy(pattern)
        plant.reset(BENT)
        self.reference = copy.deepcopy(plant)
        drives, devices = [], []
        unit = {key_of(0x6076, 0): RATED_MNM, key_of(0x608F, 1): 131_072}
        for port in range(6):
            od = ObjectDictionary(ENTRIES).copy_for_node(port + 1, unit)
            drives.append(Drive(od, ENCODER, VELOCITY))
            devices.append(Device(od, port + 1, drives[-1], port))
        self.rack = Rack(plant, devices, drives)
        self.sink = Sink()
        self.counter = 0

    def run(self, until: int) -> None:
        """Wake-ups up to and including `until`."""
        while self.rack.wake_at <= until:
            self.sink.now = self.rack.wake_at
            self.rack.wake(self.rack.wake_at, self.sink)

    def hear(self, now: int, can_id: int, data: bytes, flags: int = 0) -> list[tuple[int, Frame]]:
        """A frame that ends at `now`; what is sent on it, by port. At the same instant it comes before a wake-up."""
        self.run(now - 1)
        self.sink.now = now
        before = len(self.sink.sent)
        frame = Frame(can_id, b"", flags, len(data)) if flags & FLAG_REMOTE else Frame(can_id, data, flags)
        self.rack.receive(now, 0, frame, self.sink)
        return [(port, frame) for _, port, frame in self.sink.sent[before:]]

    def sync(self, now: int) -> list[tuple[int, Frame]]:
        self.counter = self.counter % 240 + 1
        return self.hear(now, 0x080, bytes((self.counter,)))

    def start(self) -> None:
        """NMT start at 20 ms, when all have booted."""
        self.hear(20 * MS, 0x000, b"\x01\x00")

    def enable(self, torques: tuple[int, ...], nodes: tuple[int, ...] = (1, 2, 3, 4, 5, 6)) -> int:
        """NMT start, then Operation enabled with these torques [per mille], by three SYNCs; time of the last one."""
        self.start()
        now = 20 * MS
        for controlword in (0x06, 0x07, 0x0F):
            for node in nodes:
                self.hear(now + 100_000, 0x200 + node, struct.pack("<Hh", controlword, torques[node - 1]))
            now += 2 * MS
            self.sync(now)
        return now

    def write(self, now: int, node: int, index: int, sub: int, raw: int, size: int) -> None:
        """Expedited SDO download that must succeed."""
        head = bytes((0x23 | (4 - size) << 2,)) + struct.pack("<HB", index, sub)
        answers = self.hear(now, 0x600 + node, head + raw.to_bytes(size, "little").ljust(4, b"\x00"))
        assert [(port, frame.data[0]) for port, frame in answers] == [(node - 1, 0x60)]

    def torques(self) -> list[float]:
        return [drive.torque_nm for drive in self.rack.drives]


@pytest.fixture
def bench(pattern: Plant) -> Bench:
    return Bench(pattern)


def samples(frames: list[tuple[int, Frame]]) -> dict[int, tuple[int, int]]:
    """Position and velocity in the TPDO1s, by node."""
    found = {}
    for port, frame in frames:
        if 0x181 <= frame.can_id <= 0x186:
            assert port == frame.can_id - 0x181
            position, velocity = struct.unpack("<ii", frame.data)
            found[frame.can_id - 0x180] = position, velocity
    return found


# ---- physics on its own clock -------------------------------------------------------------------------------------


def test_physics_runs_every_millisecond_without_any_bus(bench: Bench) -> None:
    """Physics does not hang on SYNC: a stopped bus leaves the plant falling, step by step the bare plant's fall."""
    bench.run(300 * MS)
    assert [row.time_ns for row in bench.rack.truth] == [k * MS for k in range(1, 301)]
    for row in bench.rack.truth:
        bench.reference.step([0.0] * 6)
        assert (row.q, row.dq, row.tau) == (bench.reference.q, bench.reference.dq, bench.reference.tau)
    assert max(abs(q - start) for q, start in zip(bench.rack.truth[-1].q, BENT, strict=True)) > 0.1  # it did fall


def test_physics_is_never_stepped_off_the_grid(bench: Bench) -> None:
    """Timers of devices and frames between two milliseconds do not move the plant."""
    bench.enable((0,) * 6)
    for node in range(1, 7):
        bench.write(40 * MS + node * 7919, node, 0x1017, 0, 3, 2)  # heartbeats off the grid from here
    wakes = len(bench.sink.sent)
    bench.run(100 * MS)
    assert [row.time_ns for row in bench.rack.truth] == [k * MS for k in range(1, 101)]
    assert any(now % MS for now, _, _ in bench.sink.sent[wakes:])


def test_a_frame_does_not_step_the_plant(bench: Bench) -> None:
    """SYNC latches; only the rack's own wake-ups integrate."""
    bench.enable((0,) * 6)
    rows, q = len(bench.rack.truth), bench.rack.plant.q
    for k in range(5):
        bench.sync(26 * MS + 1 + k)
    assert (len(bench.rack.truth), bench.rack.plant.q) == (rows + 1, bench.rack.truth[-1].q)
    assert bench.rack.truth[-1].time_ns == 26 * MS
    assert bench.rack.plant.q is not q


def test_torque_is_held_when_the_bus_stops(bench: Bench) -> None:
    """Nothing watched, nothing heard: the last set-points act on every step, exactly as on a bare plant."""
    torques = (200, -100, 50, -200, 300, 0)
    last = bench.enable(torques)
    bench.run(last + 200 * MS)
    held = [raw * NM for raw in torques]
    assert bench.torques() == pytest.approx(held)
    for row in bench.rack.truth:
        bench.reference.step(bench.torques() if row.time_ns >= last else [0.0] * 6)
        assert row.q == bench.reference.q


@pytest.mark.parametrize(
    ("sync_at", "first_step"),
    [
        (40 * MS - 1, 40 * MS),
        (40 * MS, 40 * MS),  # the frame comes before the wake-up at the same instant
        (40 * MS + 1, 41 * MS),
        (40 * MS + 57_000, 41 * MS),
        (41 * MS - 1, 41 * MS),
    ],
)
def test_step_at_k_ms_uses_the_set_points_held_at_that_wake_up(
    bench: Bench, sync_at: int, first_step: int
) -> None:
    """The wake-up at k ms integrates (k-1, k] ms with the set-points held at that wake-up."""
    bench.enable((0,) * 6)
    bench.hear(30 * MS, 0x201, struct.pack("<Hh", 0x0F, 500))
    bench.sync(sync_at)
    bench.run(50 * MS)
    for row in bench.rack.truth:
        bench.reference.step([500 * NM if row.time_ns >= first_step else 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        assert row.q == bench.reference.q


# ---- what SYNC latches --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sync_at", "step"),
    [
        (40 * MS - 1, 39),
        (40 * MS, 39),  # the frame comes before the wake-up that ends step 40
        (40 * MS + 1, 40),
        (40 * MS + 500_000, 40),
        (41 * MS - 1, 40),
    ],
)
def test_sync_latches_the_last_finished_step(bench: Bench, sync_at: int, step: int) -> None:
    """TPDO1 is the encoder and the velocity estimate of the newest finished step, for all six drives."""
    bench.enable((0,) * 6)
    found = samples(bench.sync(sync_at))
    bench.run(sync_at + MS)
    for joint in range(6):
        state = VelocityEstimateState()
        estimate_velocity(VELOCITY, state, encode(BENT[joint], ENCODER))
        for row in bench.rack.truth[:step]:
            estimate_velocity(VELOCITY, state, encode(row.q[joint], ENCODER))
        assert found[joint + 1] == (encode(bench.rack.truth[step - 1].q[joint], ENCODER), to_int32(state.filtered))


class SyncAt(Node):
    """Sends one SYNC so that it ends at a given instant of an idle bus."""

    def __init__(self, end: int) -> None:
        super().__init__()
        self.frame = Frame(0x080, b"\x01")
        self.starts = [20 * MS, end - self.frame.measure() * 1000]
        self.answers: list[Frame] = []
        self.wake_at = self.starts[0]

    def wake(self, now: int, out: Out) -> None:
        out.send(0, Frame(0x000, b"\x01\x00") if now == self.starts[0] else self.frame)
        self.wake_at = self.starts[1] if now == self.starts[0] else NEVER

    def receive(self, now: int, port: int, frame: Frame, out: Out) -> None:
        if 0x181 <= frame.can_id <= 0x186:
            self.answers.append(frame)


@pytest.mark.parametrize(("sync_at", "step"), [(30 * MS - 1000, 29), (30 * MS, 29), (30 * MS + 1000, 30)])
@pytest.mark.parametrize("rack_first", [True, False])
def test_the_loop_serves_sync_before_the_step_of_the_same_instant(
    bench: Bench, sync_at: int, step: int, rack_first: bool
) -> None:
    """Order at the same ns: frame before wake-up, whoever was connected first."""
    medium, sender = Medium("drive", 0, 1_000_000), SyncAt(sync_at)
    loop = Loop([medium])
    for node in (bench.rack, sender) if rack_first else (sender, bench.rack):
        loop.connect(node, [medium] * (6 if node is bench.rack else 1))
    loop.run_until(32 * MS)
    assert [row.end_ns for row in loop.trace if row.frame.can_id == 0x080] == [sync_at]
    found = [struct.unpack("<i", frame.data[:4])[0] for frame in sender.answers]
    assert found == [encode(q, ENCODER) for q in bench.rack.truth[step - 1].q]


def test_one_sync_makes_every_operational_drive_answer_on_its_own_port(bench: Bench) -> None:
    """One rack call per SYNC: six TPDO1, in node order, drive k on port k - 1."""
    bench.start()
    answers = [(port, frame.can_id) for port, frame in bench.sync(30 * MS) if frame.can_id < 0x200]
    assert answers == [(port, 0x181 + port) for port in range(6)]
    bench.hear(31 * MS, 0x000, b"\x80\x04")
    assert sorted(samples(bench.sync(32 * MS))) == [1, 2, 3, 5, 6]


def test_at_power_up_the_sensors_show_the_starting_posture(bench: Bench) -> None:
    """Before the first step the encoders have sampled the plant once."""
    for drive, q in zip(bench.rack.drives, BENT, strict=True):
        assert drive.sensor.counts == math.floor(q / (2 * math.pi) * 131_072 + 0.5)


# ---- who hears what -----------------------------------------------------------------------------------------------


def test_boot_up_messages_come_on_the_drives_own_ports(bench: Bench) -> None:
    """A port per drive, so that one can go bus-off alone."""
    bench.run(10 * MS)
    assert [(port, frame) for _, port, frame in bench.sink.sent] == [
        (port, Frame(0x701 + port, b"\x00")) for port in range(6)
    ]


@pytest.mark.parametrize("command", [0x81, 0x82])
def test_reset_of_one_drive_leaves_the_others_driving(bench: Bench, command: int) -> None:
    """Six devices: NMT to node 3 is node 3's; it boots again, without torque, and the plant goes on."""
    torques = (100, 200, 300, -100, -200, -300)
    last = bench.enable(torques)
    bench.hear(last + 100_000, 0x000, bytes((command, 3)))
    expected = [raw * NM for raw in torques]
    expected[2] = 0.0
    assert bench.torques() == pytest.approx(expected)
    bench.run(last + 20 * MS)
    boots = [(port, frame) for now, port, frame in bench.sink.sent if now > last and frame.data == b"\x00"]
    assert boots == [(2, Frame(0x703, b"\x00"))]
    assert sorted(samples(bench.sync(last + 22 * MS))) == [1, 2, 4, 5, 6]
    assert bench.torques() == pytest.approx(expected)
    assert len(bench.rack.truth) == (last + 21 * MS) // MS


def test_drives_hear_only_their_own_rpdo(bench: Bench) -> None:
    """RPDO1 of node 5 moves joint 5."""
    bench.enable((0,) * 6)
    bench.hear(30 * MS, 0x205, struct.pack("<Hh", 0x0F, 400))
    bench.sync(31 * MS)
    assert bench.torques() == pytest.approx([0, 0, 0, 0, 400 * NM, 0])


def test_remapped_cob_id_is_heard_and_the_old_one_is_not(bench: Bench) -> None:
    """Routing by id follows what the master writes to 0x1400:1, and what a reset restores."""
    bench.start()
    bench.write(21 * MS, 2, 0x1400, 1, 1 << 31 | 0x202, 4)
    bench.write(22 * MS, 2, 0x1400, 1, 0x321, 4)
    states = []
    for now, can_id in ((30 * MS, 0x202), (40 * MS, 0x321)):
        bench.hear(now, can_id, struct.pack("<Hh", 0x06, 0))
        bench.sync(now + MS)
        states.append(bench.rack.devices[1].od.values[key_of(0x6041, 0)] & 0x6F)
    assert states == [0x40, 0x21]  # Switch on disabled; Ready to switch on
    bench.hear(50 * MS, 0x000, b"\x82\x02")
    bench.hear(60 * MS, 0x000, b"\x01\x02")
    for now, can_id in ((70 * MS, 0x321), (80 * MS, 0x202)):
        bench.hear(now, can_id, struct.pack("<Hh", 0x06, 0))
        bench.sync(now + MS)
        states.append(bench.rack.devices[1].od.values[key_of(0x6041, 0)] & 0x6F)
    assert states[2:] == [0x40, 0x21]


def test_two_drives_may_share_an_rpdo(bench: Bench) -> None:
    """Nothing in CiA 301 forbids it: both consumers of one COB-ID get the frame."""
    bench.start()
    for node in (1, 4):
        bench.write(21 * MS + node, node, 0x1400, 1, 0x333, 4)
    now = 30 * MS
    for controlword in (0x06, 0x0F):
        bench.hear(now, 0x333, struct.pack("<Hh", controlword, 100))
        bench.sync(now + MS)
        now += 2 * MS
    assert bench.torques() == pytest.approx([100 * NM, 0, 0, 100 * NM, 0, 0])


def test_heartbeat_of_the_master_reaches_the_drives_that_watch_it(bench: Bench) -> None:
    """0x1016 written by SDO opens the route for 0x77F: silence of it is noticed, by that drive alone."""
    bench.start()
    bench.write(21 * MS, 6, 0x1016, 1, 127 << 16 | 50, 4)
    bench.hear(22 * MS, 0x77F, b"\x05")
    bench.run(72 * MS - 1)
    assert not [frame for _, _, frame in bench.sink.sent if 0x081 <= frame.can_id <= 0x086]
    bench.run(72 * MS)
    errors = [(port, frame) for _, port, frame in bench.sink.sent if 0x081 <= frame.can_id <= 0x086]
    assert errors == [(5, Frame(0x086, struct.pack("<HB5x", 0x8130, 0x11)))]


def test_error_of_one_drive_is_its_own_and_ends_with_its_cause(bench: Bench) -> None:
    """EMCY, 0x603F and the torque that drops are node 6's; the heartbeat that is back ends the error there."""
    torques = (100, 200, 300, -100, -200, -300)
    bench.start()
    bench.write(20 * MS + 1, 6, 0x1016, 1, 127 << 16 | 50, 4)
    last = bench.enable(torques)
    bench.hear(last, 0x77F, b"\x05")
    bench.run(last + 50 * MS)
    assert bench.torques() == pytest.approx([*[raw * NM for raw in torques[:5]], 0.0])
    codes = [device.od.values[key_of(0x603F, 0)] for device in bench.rack.devices]
    assert codes == [0, 0, 0, 0, 0, 0x8130]
    answers = bench.hear(last + 60 * MS, 0x77F, b"\x05")
    assert answers == [(5, Frame(0x086, bytes(8)))]
    assert [device.od.values[key_of(0x603F, 0)] for device in bench.rack.devices] == [0] * 6
    assert bench.torques() == pytest.approx([*[raw * NM for raw in torques[:5]], 0.0])  # not by itself


@pytest.mark.parametrize(
    ("can_id", "flags"), [(0x201, FLAG_EXTENDED), (0x201 << 18, FLAG_EXTENDED), (0x201, FLAG_REMOTE)]
)
def test_extended_and_remote_frames_are_not_rpdos(bench: Bench, can_id: int, flags: int) -> None:
    """CiA 301 default: 11-bit data frames only; 29-bit ids with the same low or high bits mean nothing here."""
    bench.enable((0,) * 6)
    bench.hear(30 * MS, can_id, struct.pack("<Hh", 0x0F, 500), flags)
    bench.sync(31 * MS)
    assert bench.torques() == [0.0] * 6


@pytest.mark.parametrize("can_id", [0x001, 0x07F, 0x100, 0x207, 0x2FF, 0x300, 0x57F, 0x607, 0x7FF])
def test_ids_nobody_listens_to_are_passed_over(bench: Bench, can_id: int) -> None:
    """No answer, no change, no exception."""
    bench.enable((50,) * 6)
    assert bench.hear(30 * MS, can_id, bytes(8)) == []
    assert bench.torques() == pytest.approx([50 * NM] * 6)


# ---- the truth ----------------------------------------------------------------------------------------------------


def test_truth_rows_keep_what_was(bench: Bench) -> None:
    """One row a step: its own lists, never changed by later steps; the last one is the plant's present state."""
    bench.enable((300,) * 6)
    early = [(row.time_ns, list(row.q), list(row.dq), list(row.tau)) for row in bench.rack.truth]
    bench.run(100 * MS)
    assert [(row.time_ns, row.q, row.dq, row.tau) for row in bench.rack.truth[: len(early)]] == early
    last, plant = bench.rack.truth[-1], bench.rack.plant
    assert (last.q, last.dq, last.tau) == (plant.q, plant.dq, plant.tau)
    assert [len(values) for values in (last.q, last.dq, last.tau)] == [6, 6, 6]


def test_truth_torque_is_the_joints_after_the_gear(bench: Bench) -> None:
    """tau follows the command by the motor's lag (2.8 ms): after 50 ms, e^-17 of the step is missing."""
    bench.enable((100, 200, 300, -100, -200, -300))
    bench.run(76 * MS)
    assert bench.rack.truth[-1].tau == pytest.approx(bench.torques(), rel=1e-6)


def test_a_copied_rack_goes_on_alone(bench: Bench) -> None:
    """Snapshot: the copy and the original run on to the same states and do not touch each other."""
    bench.enable((100, -200, 30, 40, -50, 60))
    twin = copy.deepcopy(bench)
    twin.hear(30 * MS, 0x000, b"\x81\x00")
    twin.run(60 * MS)
    assert twin.torques() == [0.0] * 6
    again = copy.deepcopy(bench)
    for run in (again, bench):
        run.run(60 * MS)
    assert [row.q for row in again.rack.truth] == [row.q for row in bench.rack.truth]
    assert bench.rack.truth[-1].q != twin.rack.truth[-1].q
