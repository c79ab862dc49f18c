"""The NMT master: restarts, supervision, any bytes."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.frame import FLAG_EXTENDED, FLAG_REMOTE, Frame
from canopen_exo.bus.loop import Loop
from canopen_exo.bus.medium import Medium
from canopen_exo.bus.node import MS, NEVER, SECOND, Out
from canopen_exo.device import Application, Device
from canopen_exo.master import POWER_UP_NS, Master, MasterState, Write
from canopen_exo.nmt import NmtState
from tests.canopen_exo.master_under_test import (
    CYCLE,
    HEARTBEAT_TIMEOUT,
    PATTERN,
    RATED,
    Recorder,
    Rig,
    Sink,
    Talker,
    plan_of,
    slave,
)

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


@pytest.mark.long
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


@pytest.mark.long
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
