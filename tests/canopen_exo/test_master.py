"""The master boots real Devices over an emulated bus, and says precisely what is wrong when one does not come up."""

import struct

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, SECOND, Out
from canopen_exo.device import Application, Device
from canopen_exo.master import POWER_UP_NS, Expected, Master, MasterState, SlaveConfig, Write
from canopen_exo.nmt import NmtState
from tests.canopen_exo.master_under_test import (
    CYCLE,
    HEARTBEAT_TIMEOUT,
    PATTERN,
    RATED,
    BootOnly,
    Recorder,
    Rig,
    plan_of,
    slave,
)

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
