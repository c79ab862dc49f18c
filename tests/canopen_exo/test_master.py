"""The master boots real Devices over an emulated bus, and says precisely what is wrong when one does not come up."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_REMOTE, Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, SECOND, Node, Out
from canopen_exo.device import Application, Device
from canopen_exo.eds import load_eds
from canopen_exo.emcy import Emergency
from canopen_exo.master import POWER_UP_NS, Expected, Master, MasterApplication, MasterState, SlaveConfig, Write
from canopen_exo.nmt import NmtState
from canopen_exo.od import ObjectDictionary
from canopen_exo.plan import BusPlan, JointNode

PATTERN = ObjectDictionary(load_eds())
NAMES = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
CYCLE = 2 * MS
HEARTBEAT_TIMEOUT = 300 * MS
RATED = 50_000


class Recorder(MasterApplication):
    """Writes down what the master tells it: (time, what, details)."""

    def __init__(self) -> None:
        super().__init__()
        self.log: list[tuple[int, str, tuple[object, ...]]] = []

    def operational(self, now: int, out: Out) -> None:
        self.log.append((now, "operational", ()))

    def synchronised(self, now: int, out: Out) -> None:
        self.log.append((now, "sync", ()))

    def process_data(self, now: int, slave: int, pdo: int, data: bytes, out: Out) -> None:
        self.log.append((now, "pdo", (slave, pdo, data)))

    def emergency(self, now: int, slave: int, emergency: Emergency, out: Out) -> None:
        self.log.append((now, "emergency", (slave, emergency.code, emergency.register)))

    def node_lost(self, now: int, slave: int, out: Out) -> None:
        self.log.append((now, "lost", (slave,)))

    def left_operational(self, now: int, slave: int, state: int, out: Out) -> None:
        self.log.append((now, "left", (slave, state)))

    def rebooted(self, now: int, slave: int, out: Out) -> None:
        self.log.append((now, "rebooted", (slave,)))

    def failed(self, now: int, reason: str, out: Out) -> None:
        self.log.append((now, "failed", (reason,)))

    def of(self, what: str) -> list[tuple[int, tuple[object, ...]]]:
        return [(now, details) for now, name, details in self.log if name == what]


class Talker(Node):
    """Sends one frame at a time of our choosing."""

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[tuple[int, Frame]] = []

    def say(self, when: int, frame: Frame) -> None:
        self.frames = sorted([*self.frames, (when, frame)], key=lambda item: item[0])
        self.wake_at = self.frames[0][0]

    def wake(self, now: int, out: Out) -> None:
        while self.frames and self.frames[0][0] <= now:
            out.send(0, self.frames.pop(0)[1])
        self.wake_at = self.frames[0][0] if self.frames else NEVER


class BootOnly(Node):
    """A device that boots and then answers nothing."""

    def __init__(self, node_id: int, when: int) -> None:
        super().__init__()
        self.node_id = node_id
        self.wake_at = when

    def wake(self, now: int, out: Out) -> None:
        out.send(0, Frame(0x700 + self.node_id, b"\0"))
        self.wake_at = NEVER


def plan_of(count: int) -> BusPlan:
    return BusPlan(tuple(JointNode(name, number, RATED, 131_072) for number, name in enumerate(NAMES[:count], 1)))


def slave(name: str, node_id: int, *more: Write) -> SlaveConfig:
    return SlaveConfig(
        name,
        node_id,
        (
            Expected(0x1000, 0, 0x00020192, "device type"),
            Expected(0x1018, 2, 1, "product code"),
            Expected(0x6076, 0, RATED, "rated torque [mN m]"),
        ),
        (Write(0x1006, 0, 2000, 4), Write(0x6072, 0, 900 + node_id, 2), *more),
        HEARTBEAT_TIMEOUT,
    )


class Rig:
    """A master and real devices on one bus."""

    def __init__(
        self,
        count: int = 6,
        missing: tuple[int, ...] = (),
        rated: dict[int, int] | None = None,
        more: dict[int, tuple[Write, ...]] | None = None,
    ) -> None:
        self.plan = plan_of(count)
        self.application = Recorder()
        configs = tuple(
            slave(joint.name, joint.node_id, *(more or {}).get(joint.node_id, ())) for joint in self.plan.joints
        )
        self.master = Master(self.plan, configs, self.application)
        self.talker = Talker()
        self.bus = Medium("bus", 0, 1_000_000)
        self.loop = Loop([self.bus])
        self.loop.connect(self.master, [self.bus])
        self.loop.connect(self.talker, [self.bus])
        self.devices: dict[int, Device] = {}
        for joint in self.plan.joints:
            if joint.node_id not in missing:
                od = PATTERN.copy_for_node(joint.node_id, {0x607600: (rated or {}).get(joint.node_id, RATED)})
                self.devices[joint.node_id] = Device(od, joint.node_id, Application())
                self.loop.connect(self.devices[joint.node_id], [self.bus])

    def run(self, until: int) -> "Rig":
        self.loop.run_until(until)
        return self

    def ends(self, can_id: int) -> list[int]:
        return [row.end_ns for row in self.loop.trace if row.frame.can_id == can_id]

    def frames(self, can_id: int) -> list[bytes]:
        return [row.frame.data for row in self.loop.trace if row.frame.can_id == can_id]


# --- a good start ------------------------------------------------------------------------------------------------


def test_master_boots_configures_and_starts_six_devices() -> None:
    """CiA 302-2: reset communication, boot-up, identity, configuration, start; then SYNC."""
    rig = Rig().run(100 * MS)
    assert (rig.master.state, rig.master.failure) == (MasterState.OPERATIONAL, "")
    for node_id, device in rig.devices.items():
        assert device.nmt.state is NmtState.OPERATIONAL
        assert device.od.value(0x607200) == 900 + node_id
    assert len(rig.application.of("operational")) == 1
    assert rig.application.of("failed") == []
    assert [port.dropped for port in rig.bus.ports] == [0] * 8


def test_start_is_in_the_order_of_the_standard() -> None:
    """Reset; per node: boot-up, device type, product code, rated torque, the writes; one start for all at the end."""
    rig = Rig(2).run(100 * MS)
    ids = [row.frame.can_id for row in rig.loop.trace]
    own = [row for row in rig.loop.trace if row.frame.can_id not in (0x701, 0x702)]
    assert {row.frame.can_id: row.frame.data for row in own[:2]} == {0x77F: b"\0", 0x000: b"\x82\0"}
    assert rig.frames(0x000) == [b"\x82\0", b"\x01\0"]
    reset, start = (at for at, can_id in enumerate(ids) if can_id == 0x000)
    for node_id in (1, 2):
        assert reset < ids.index(0x700 + node_id, reset) < ids.index(0x600 + node_id) < start
        requests = [data[:4].hex() for data in rig.frames(0x600 + node_id)]
        assert requests == ["40001000", "40181002", "40766000", "23061000", "2b726000"]
    assert 0x600 not in [can_id & 0x780 for can_id in ids[start:]]
    assert 0x080 not in ids[:start]


def test_every_device_serves_reset_communication_before_it_is_configured() -> None:
    """CiA 302-2: devices powered up with the master are booted when 0x82 comes: each sends a second boot-up message."""
    rig = Rig()
    rig.run(POWER_UP_NS - 1)
    assert (rig.master.state, rig.frames(0x000)) == (MasterState.RESETTING, [])
    assert {device.nmt.state for device in rig.devices.values()} == {NmtState.PRE_OPERATIONAL}
    for device in rig.devices.values():
        device.od.set(0x100600, 12_345)  # left behind by another master
    rig.run(POWER_UP_NS + MS)
    (reset,) = rig.ends(0x000)
    assert reset > POWER_UP_NS
    assert {device.nmt.state for device in rig.devices.values()} == {NmtState.INITIALISING}
    assert {device.od.value(0x100600) for device in rig.devices.values()} == {0}
    rig.run(100 * MS)
    for node_id in rig.devices:
        assert rig.frames(0x700 + node_id)[:2] == [b"\0", b"\0"]
        first, second = rig.ends(0x700 + node_id)[:2]
        assert first < reset < second < min(rig.ends(0x600 + node_id))
    assert {device.od.value(0x100600) for device in rig.devices.values()} == {2000}


def test_master_needs_no_second_boot_up_of_a_device_that_booted_late() -> None:
    """A device still initialising does not hear the reset; its only boot-up message, within 1 s, is enough."""
    rig = Rig(2, missing=(2,))
    late = Device(PATTERN.copy_for_node(2, {0x607600: RATED}), 2, Application())
    late.boot_at = late.wake_at = 700 * MS
    rig.loop.connect(late, [rig.bus])
    rig.run(800 * MS)
    assert rig.master.state is MasterState.OPERATIONAL
    assert rig.frames(0x702)[0] == b"\0"
    assert rig.frames(0x702).count(b"\0") == 1


def test_sync_lies_on_whole_cycles_and_counts() -> None:
    """SYNC every 2 ms of the loop's time, counter 1..240 and 1 again; the device answers to each."""
    rig = Rig(2).run(1000 * MS)
    sent = [now for now, _ in rig.application.of("sync")]
    assert all(now % CYCLE == 0 for now in sent)
    assert sent == list(range(sent[0], sent[-1] + 1, CYCLE))
    assert sent[-1] > 990 * MS
    counters = [data[0] for data in rig.frames(0x080)]
    assert counters[:241] == [*range(1, 241), 1]
    assert rig.ends(0x080)[0] == sent[0] + Frame(0x080, b"\1").measure() * 1000
    assert len(rig.ends(0x181)) in (len(counters), len(counters) - 1)


def test_application_is_told_before_the_first_sync() -> None:
    """`operational` comes first, SYNC one to two cycles later, when every device has had the start command."""
    rig = Rig(2).run(100 * MS)
    (operational,) = [now for now, _ in rig.application.of("operational")]
    first_sync = rig.application.of("sync")[0][0]
    assert CYCLE < first_sync - operational <= 2 * CYCLE
    assert rig.ends(0x000)[-1] < first_sync


def test_process_data_is_told_by_slave_and_number() -> None:
    """The place in the plan and the number of the TPDO."""
    rig = Rig().run(200 * MS)
    seen = {details[:2] for _, details in rig.application.of("pdo")}
    assert seen == {(at, number) for at in range(6) for number in (1, 2)}
    assert {len(bytes(details[2])) for _, details in rig.application.of("pdo") if details[1] == 1} == {8}  # type: ignore[call-overload] # data


@pytest.mark.parametrize("when", [1 * MS, POWER_UP_NS, POWER_UP_NS + MS, POWER_UP_NS + 5 * MS])
def test_process_data_before_the_start_is_not_told(when: int) -> None:
    """A device that talks out of turn is not yet configured."""
    rig = Rig(1)
    rig.talker.say(when, Frame(0x181, bytes(8)))
    rig.run(when + MS)
    assert len(rig.ends(0x181)) == 1
    assert rig.master.state in (MasterState.RESETTING, MasterState.BOOTING)
    assert rig.application.of("pdo") == []


def test_master_sends_its_own_heartbeat() -> None:
    """Node 127: boot-up when it starts, then every 100 ms from there, Operational."""
    rig = Rig(1).run(1000 * MS)
    assert rig.frames(0x77F) == [b"\0"] + [b"\5"] * 9
    for number, end in enumerate(rig.ends(0x77F)):
        waits = end - (POWER_UP_NS + number * 100 * MS)
        assert 55_000 <= waits <= CYCLE  # its own length at least; higher priorities before it


def test_emergency_is_told_with_the_slave() -> None:
    """Code and register as the device sent them."""
    rig = Rig(2).run(100 * MS)
    rig.talker.say(101 * MS, Frame(0x082, bytes.fromhex("1023030000000000")))
    rig.talker.say(102 * MS, Frame(0x082, b"\x10\x23"))  # too short to be one
    rig.talker.say(103 * MS, Frame(0x083, bytes.fromhex("1023030000000000")))  # of nobody's
    rig.run(110 * MS)
    assert [details for _, details in rig.application.of("emergency")] == [(1, 0x2310, 0x03)]


def test_master_that_hears_something_first_starts_all_the_same() -> None:
    """On a real bus others may talk before the master's first wake-up."""
    plan = plan_of(1)
    master = Master(plan, (slave("left_hip", 1),), Recorder())

    class Sink(Out):
        def send(self, port: int, frame: Frame) -> None:
            pass

    for now, can_id in enumerate((0x701, 0x081, 0x581, 0x181)):
        master.receive(now, 0, Frame(can_id, b"\0"), Sink())
        assert (master.wake_at, master.state) == (POWER_UP_NS, MasterState.RESETTING)


# --- a start that fails ------------------------------------------------------------------------------------------


def failure_of(rig: Rig) -> tuple[int, str]:
    """When the start failed, and why; the application was told the same, once."""
    assert rig.master.state is MasterState.FAILED
    ((now, (reason,)),) = rig.application.of("failed")
    assert reason == rig.master.failure
    assert rig.application.of("operational") == []
    assert rig.frames(0x080) == []
    assert b"\x01\0" not in rig.frames(0x000)
    return now, str(reason)


def test_wrong_identity_names_node_found_and_expected() -> None:
    """Style: what, where, got, allowed, remedy."""
    _, text = failure_of(Rig(rated={5: 60_000}).run(200 * MS))
    assert text == (
        "right_knee (node 5): rated torque [mN m] (6076:00) is 0x0000ea60, expected 0x0000c350: "
        "another device answers at this node id"
    )


def test_missing_device_is_named_after_one_second() -> None:
    """No boot-up message within 1 s of reset communication, to the nanosecond."""
    rig = Rig(3, missing=(2,)).run(POWER_UP_NS + SECOND - 1)
    assert rig.master.state is MasterState.BOOTING
    now, text = failure_of(rig.run(POWER_UP_NS + SECOND))
    assert now == POWER_UP_NS + SECOND
    assert text == (
        "left_knee (node 2): no boot-up message within 1 s of reset communication; "
        "check power, wiring, bit rate and node id"
    )


def test_boot_up_before_the_reset_does_not_count() -> None:
    """A device that was there, heard 0x82 and did not come back is missing."""
    rig = Rig(2, missing=(2,))
    rig.loop.connect(BootOnly(2, 5 * MS), [rig.bus])
    now, text = failure_of(rig.run(2 * SECOND))
    assert len(rig.ends(0x702)) == 1
    assert now == POWER_UP_NS + SECOND
    assert text.startswith("left_knee (node 2): no boot-up message within 1 s of reset communication")


def test_device_that_does_not_answer_is_named_after_half_a_second() -> None:
    """No SDO answer within 0.5 s of the request, and the transfer is aborted with 05040000."""
    rig = Rig(2, missing=(2,))
    rig.loop.connect(BootOnly(2, POWER_UP_NS + 10 * MS), [rig.bus])
    rig.run(POWER_UP_NS + 20 * MS)
    (booted,) = rig.ends(0x702)
    rig.run(booted + 500 * MS - 1)
    assert rig.master.state is MasterState.BOOTING
    now, text = failure_of(rig.run(booted + 501 * MS))
    assert now == booted + 500 * MS
    assert text == (
        "left_knee (node 2): no SDO answer within 0.5 s while reading device type (1000:00); "
        "check the device and the bus"
    )
    assert rig.frames(0x602)[-1] == struct.pack("<BHBI", 0x80, 0x1000, 0, 0x05040000)


@pytest.mark.parametrize(
    ("write", "doing", "code"),
    [
        (Write(0x2000, 0, 5, 1), "writing 0x5 to 2000:00", "06020000 (object does not exist)"),
        (Write(0x6041, 0, 1, 2), "writing 0x1 to 6041:00", "06010002 (attempt to write a read-only object)"),
        (Write(0x6072, 0, 7, 4), "writing 0x7 to 6072:00", "06070012 (data type does not match: too long)"),
        (Write(0x1019, 0, 240, 1), "writing 0xf0 to 1019:00", "08000022 (data cannot be transferred or stored: "),
    ],
)
def test_abort_names_the_access_and_the_reason(write: Write, doing: str, code: str) -> None:
    """An SDO abort during configuration: node, what was written where, the code and its words."""
    _, text = failure_of(Rig(3, more={3: (write,)}).run(200 * MS))
    assert text.startswith(f"left_ankle (node 3): {doing} ended with SDO abort {code}")


def test_abort_while_reading_names_the_object() -> None:
    """The same for the identity."""
    config = SlaveConfig("left_hip", 1, (Expected(0x5000, 7, 0, "magic number"),), (), HEARTBEAT_TIMEOUT)
    rig = Rig(1)
    application = Recorder()
    loop = Loop([Medium("bus", 0, 1_000_000)])
    loop.connect(Master(rig.plan, (config,), application), loop.media)
    loop.connect(Device(PATTERN.copy_for_node(1, {0x607600: RATED}), 1, Application()), loop.media)
    loop.run_until(100 * MS)
    ((_, (reason,)),) = application.of("failed")
    assert str(reason).startswith("left_hip (node 1): reading magic number (5000:07) ended with SDO abort 06020000")


def test_failed_master_leaves_the_bus_alone() -> None:
    """After a failure only its heartbeat goes on."""
    rig = Rig(2, missing=(2,)).run(3 * SECOND)
    late = {row.frame.can_id for row in rig.loop.trace if row.end_ns > POWER_UP_NS + SECOND + MS}
    assert late == {0x77F, 0x701}
    assert len(rig.application.of("failed")) == 1


# --- restarts ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [1, 2, 3, 4])
def test_further_boot_up_starts_the_sequence_of_that_device_over(steps: int) -> None:
    """A device that resets during its configuration has forgotten all of it: from the first step again."""
    rig = Rig(6)
    rig.talker.say(Rig(6).run(100 * MS).ends(0x602)[steps - 1], Frame(0x000, b"\x81\x02"))
    rig.run(100 * MS)
    assert rig.master.state is MasterState.OPERATIONAL
    assert rig.frames(0x702) == [b"\0", b"\0", b"\0"]  # power-up, reset communication, reset node
    requests = [data[:4].hex() for data in rig.frames(0x602)]
    whole = ["40001000", "40181002", "40766000", "23061000", "2b726000"]
    assert requests[-5:] == whole
    assert requests[:-5] in (whole[:steps], whole[: steps + 1])  # the answer may have been on its way already
    assert rig.devices[2].od.value(0x607200) == 902
    assert rig.devices[2].nmt.state is NmtState.OPERATIONAL


def test_device_that_resets_after_its_last_answer_is_told_to_have_rebooted() -> None:
    """Then the start command passes it by; its boot-up message tells, and the application decides."""
    rig = Rig(6)
    rig.talker.say(Rig(6).run(100 * MS).ends(0x582)[4], Frame(0x000, b"\x81\x02"))
    rig.run(100 * MS)
    assert len(rig.frames(0x602)) == 5
    assert [details for _, details in rig.application.of("rebooted")] == [(1,)]


def test_boot_up_in_operation_is_told() -> None:
    """A device that restarts by itself is no longer configured: the application decides."""
    rig = Rig(3).run(100 * MS)
    rig.talker.say(101 * MS, Frame(0x000, b"\x81\x03"))
    rig.run(200 * MS)
    assert [details for _, details in rig.application.of("rebooted")] == [(2,)]
    assert rig.master.state is MasterState.OPERATIONAL
    assert len(rig.frames(0x603)) == 5  # no SDO in operation unless asked for


# --- supervision -------------------------------------------------------------------------------------------------


def test_heartbeat_loss_is_told_exactly_after_the_time_out() -> None:
    """The time-out counts from the end of the last heartbeat; the others are not lost."""
    rig = Rig(3).run(350 * MS)
    rig.devices[2].heartbeat.start(rig.loop.now, 0)
    rig.run(SECOND)
    last = rig.ends(0x702)[-1]
    assert rig.application.of("lost") == [(last + HEARTBEAT_TIMEOUT, (1,))]


def test_heartbeat_that_comes_back_is_watched_again() -> None:
    """Lost is told once per silence."""
    rig = Rig(2).run(350 * MS)
    rig.devices[2].heartbeat.start(rig.loop.now, 0)
    rig.run(SECOND)
    rig.talker.say(SECOND + MS, Frame(0x702, b"\5"))
    rig.run(3 * SECOND)
    back = rig.ends(0x702)[-1]
    assert [now for now, _ in rig.application.of("lost")][1:] == [back + HEARTBEAT_TIMEOUT]


@pytest.mark.parametrize("silent", [1, 2, 3])
def test_device_that_never_sends_a_heartbeat_is_missed_from_the_start_command_on(silent: int) -> None:
    """CiA 301, 0x1016 begins with the first heartbeat; the master does not wait for one after the start."""
    rig = Rig(3, more={silent: (Write(0x1017, 0, 0, 2),)}).run(SECOND)
    (operational,) = [now for now, _ in rig.application.of("operational")]
    assert rig.frames(0x700 + silent) == [b"\0", b"\0"]
    assert rig.application.of("lost") == [(operational + HEARTBEAT_TIMEOUT, (silent - 1,))]


@pytest.mark.parametrize(("command", "state"), [(0x80, 127), (0x02, 4)])
def test_device_that_leaves_operational_is_told_by_its_heartbeat_once(command: int, state: int) -> None:
    """CiA 301, 7.2.8.3.2.2: the state byte; told with the first heartbeat that has it, for that device alone."""
    rig = Rig(3).run(250 * MS)
    assert rig.application.of("left") == []
    rig.talker.say(251 * MS, Frame(0x000, bytes((command, 2))))
    rig.run(SECOND)
    first = next(
        row.end_ns for row in rig.loop.trace if row.frame.can_id == 0x702 and row.frame.data == bytes((state,))
    )
    assert rig.application.of("left") == [(first, (1, state))]
    assert 251 * MS < first <= 251 * MS + 100 * MS + CYCLE
    assert len(rig.frames(0x702)) > 8
    assert rig.application.of("lost") == []


def test_device_that_leaves_operational_again_is_told_again() -> None:
    """Back in Operational by somebody's command, and out of it: an event of its own."""
    rig = Rig(2).run(250 * MS)
    for when, command in ((251, 0x80), (451, 0x01), (651, 0x02)):
        rig.talker.say(when * MS, Frame(0x000, bytes((command, 2))))
    rig.run(SECOND)
    assert [details for _, details in rig.application.of("left")] == [(1, 127), (1, 4)]


def test_states_before_the_start_are_nothing_to_tell() -> None:
    """Devices beat Pre-operational while they are configured: they have left nothing."""
    rig = Rig(2, missing=(2,)).run(900 * MS)  # waits for node 2 until 1.02 s
    assert rig.master.state is MasterState.BOOTING
    assert b"\x7f" in rig.frames(0x701)
    assert rig.application.of("left") == []


def test_cut_bus_loses_every_device() -> None:
    """All heartbeats end; the master goes on and does not hang."""
    rig = Rig(3).run(200 * MS)
    rig.bus.cut()
    rig.run(2 * SECOND)
    assert sorted(details for _, details in rig.application.of("lost")) == [(0,), (1,), (2,)]


def test_finished_application_ends_sync_and_operation() -> None:
    """Leave: NMT Pre-operational for all goes instead of the next SYNC, at its time, and no SYNC follows."""
    rig = Rig(2).run(100 * MS + 300_000)
    rig.application.finished = True
    syncs = len(rig.application.of("sync"))
    rig.run(SECOND)
    assert rig.master.state is MasterState.STOPPED
    leave = rig.ends(0x000)[-1]
    assert rig.frames(0x000)[-1] == b"\x80\0"
    assert leave == 102 * MS + Frame(0x000, b"\x80\0").measure() * 1000  # on a bus that is idle then
    assert 100 * MS < rig.ends(0x080)[-1] < leave
    assert len(rig.application.of("sync")) == syncs
    assert {device.nmt.state for device in rig.devices.values()} == {NmtState.PRE_OPERATIONAL}
    assert rig.ends(0x181)[-1] < 105 * MS


@pytest.mark.parametrize("delay", [1, 20_000, 60_000])
def test_no_sync_follows_the_end_however_soon_another_timer_is_due(delay: int) -> None:
    """An application that finishes with a SYNC still queued: NMT (id 0) must not overtake it at some other wake-up."""

    class Leaver(Recorder):
        def synchronised(self, now: int, out: Out) -> None:
            super().synchronised(now, out)
            if now >= 60 * MS:
                self.finished = True
                self.wake_at = now + delay

        def wake(self, now: int, out: Out) -> None:
            self.wake_at = NEVER

    master = Master(plan_of(1), (slave("left_hip", 1),), Leaver())
    loop = Loop([Medium("bus", 0, 1_000_000)])
    talker = Talker()
    for node in (master, talker, Device(PATTERN.copy_for_node(1, {0x607600: RATED}), 1, Application())):
        loop.connect(node, loop.media)
    talker.say(60 * MS - 1, Frame(0x7F0, bytes(8)))  # on the bus when SYNC is queued
    loop.run_until(200 * MS)
    assert master.state is MasterState.STOPPED
    ids = [row.frame.can_id for row in loop.trace]
    leave = max(at for at, can_id in enumerate(ids) if can_id == 0x000)
    assert 0x080 in ids
    assert 0x080 not in ids[leave:]


def test_application_has_a_timer_of_its_own() -> None:
    """`MasterApplication.wake_at` as a Node's: served at its time, between two SYNCs as well."""

    class Clock(Recorder):
        def synchronised(self, now: int, out: Out) -> None:
            super().synchronised(now, out)
            self.wake_at = now + 1_200_000

        def wake(self, now: int, out: Out) -> None:
            self.wake_at = NEVER
            self.log.append((now, "wake", ()))

    plan, clock = plan_of(1), Clock()
    loop = Loop([Medium("bus", 0, 1_000_000)])
    loop.connect(Master(plan, (slave("left_hip", 1),), clock), loop.media)
    loop.connect(Device(PATTERN.copy_for_node(1, {0x607600: RATED}), 1, Application()), loop.media)
    loop.run_until(100 * MS)
    assert [now for now, _ in clock.of("wake")][:20] == [now + 1_200_000 for now, _ in clock.of("sync")][:20]
    assert len(clock.of("wake")) > 20


def test_two_runs_give_the_same_trace() -> None:
    """Style: same everything, same trace."""

    def rows() -> list[tuple[int, int, int, bytes]]:
        rig = Rig(6).run(200 * MS)
        return [(row.end_ns, row.sender, row.frame.can_id, row.frame.data) for row in rig.loop.trace]

    assert rows() == rows()


# --- any bytes ---------------------------------------------------------------------------------------------------

IDS = [0x000, 0x080, 0x081, 0x181, 0x281, 0x381, 0x581, 0x581, 0x581, 0x601, 0x701, 0x701, 0x77F, 0x7FF]

NOISE = st.one_of(
    st.tuples(st.sampled_from(IDS), st.binary(max_size=8), st.just(0)),
    st.tuples(st.sampled_from([0x701, 0x702]), st.sampled_from([b"\0", b"\x7f", b"\5"]), st.just(0)),
    st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8), st.just(0)),
    st.tuples(st.just(0x581), st.binary(min_size=8, max_size=8), st.just(0)),
    st.tuples(st.sampled_from(IDS), st.just(b""), st.sampled_from([FLAG_REMOTE, FLAG_EXTENDED])),
)


class Sink(Out):
    def send(self, port: int, frame: Frame) -> None:
        assert port == 0


@settings(max_examples=200)
@given(
    noise=st.lists(st.tuples(st.sampled_from([0, 1, 100_000, CYCLE, 400 * MS]), NOISE), max_size=30),
    begin=st.sampled_from([0, POWER_UP_NS]),
)
def test_no_frames_make_the_master_raise(noise: list[tuple[int, tuple[int, bytes, int]]], begin: int) -> None:
    """Any bytes on any id while waiting or booting: no exception, and wake_at always moves on."""
    application, out = Recorder(), Sink()
    master = Master(plan_of(2), (slave("left_hip", 1), slave("left_knee", 2)), application)

    def serve(until: int) -> None:
        while master.wake_at <= until:
            now = master.wake_at
            master.wake(now, out)
            assert master.wake_at > now

    now = begin
    serve(now)
    for gap, (can_id, data, flags) in noise:
        now += gap
        serve(now - 1 if gap else now)
        master.receive(now, 0, Frame(can_id, data, flags), out)
    serve(now + 2 * SECOND)
    assert master.state in (MasterState.FAILED, MasterState.OPERATIONAL)


@settings(max_examples=60)
@given(noise=st.lists(NOISE, max_size=30), first=st.integers(50, 60))
def test_no_frames_stop_a_master_in_operation(noise: list[tuple[int, bytes, int]], first: int) -> None:
    """Any bytes on any id in operation: SYNC goes on in its time."""
    rig = Rig(2)
    for at, (can_id, data, flags) in enumerate(noise):
        rig.talker.say(first * MS + at * 300_000, Frame(can_id, data, flags))
    rig.run(100 * MS)
    sent = [now for now, _ in rig.application.of("sync")]
    assert rig.master.state is MasterState.OPERATIONAL
    assert sent == list(range(sent[0], 100 * MS + 1, CYCLE))
