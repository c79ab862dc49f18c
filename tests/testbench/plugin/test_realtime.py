"""The words of a test against the clock: what they wait for and exclude, however late frames are read. No processes."""

from collections.abc import Callable
from typing import cast

import pytest

from canopen_exo.bus.channel import Channel
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER
from canopen_exo.plan import HEARTBEAT, HLC_STATUS, STATUS_STOPPED, SYNC
from fi_gateway.control import InjectorRow
from testbench.child import ProcessError
from testbench.cli_rig import DEFAULT_SCENARIO
from testbench.errors import BenchError
from testbench.plugin import realtime
from testbench.plugin.golden import Goldens
from testbench.plugin.realtime import RealTimeExo
from testbench.scenario import parse_scenario
from testbench.supervisor import Supervisor
from testbench.watch import Watch

CYCLE_NS = 10 * MS
WANTED = 0x185


class Rig:
    """A supervisor whose clock and frames are the test's: SYNC on both buses every 10 ms, and what `put` says.

    stall_ns: how long the test process has no turn after the clock has been read `stall_after` times more;
    late_ns: how long after its end a frame comes; lost: frames that are missed once that time has come.
    """

    def __init__(self) -> None:
        self.rows: list[Transmission] = []
        self.buses = ("a", "b")
        self.missed = 0
        self.watch: Watch | None = None
        self.late_ns = 0
        self.lost: list[int] = []
        self.stall_ns = 0
        self.stall_after = 0
        self._now = 0
        self._coming: list[Transmission] = []
        for at in range(0, 1000 * CYCLE_NS, CYCLE_NS):
            for bus in (0, 1):
                self._coming.append(Transmission(at, bus, Frame(SYNC, b"\0"), -1))

    def put(self, end_ns: int, can_id: int, data: bytes = b"", bus: int = 1) -> None:
        """A frame that ends then."""
        self._coming.append(Transmission(end_ns, bus, Frame(can_id, data), -1))
        self._coming.sort(key=lambda row: row.end_ns)

    def now(self) -> int:
        """The clock; a stall comes behind the reading."""
        now = self._now
        if self.stall_ns:
            if self.stall_after == 0:
                self._now += self.stall_ns
                self.stall_ns = 0
            self.stall_after -= 1
        return now

    def sleep(self, span_ns: int) -> None:
        """The test does something else."""
        self._now += span_ns

    def poll(self) -> None:
        """What has come by now."""
        while self._coming and self._coming[0].end_ns + self.late_ns <= self._now:
            self.rows.append(self._coming.pop(0))
        while self.lost and self.lost[0] <= self._now:
            self.lost.pop(0)
            self.missed += 1

    def run(self, until: Callable[[int], bool]) -> None:
        """As the loop of a supervisor: asked before the first turn."""
        while not until(self.now()):
            self._now += MS // 2
            self.poll()


class Sender:
    """The interface of the test's own frames."""

    name = "sender"
    lost = 0

    def receive(self) -> None:
        """Nothing comes."""

    def send(self, frame: Frame) -> bool:
        """It is taken."""
        return True


@pytest.fixture
def rig() -> Rig:
    return Rig()


@pytest.fixture
def exo(rig: Rig) -> RealTimeExo:
    scenario = parse_scenario(DEFAULT_SCENARIO, "test", ["rig.rate=100 Hz"])
    exo = RealTimeExo(scenario, "hub", None, frozenset(), Goldens())
    exo._rig = cast(Supervisor, rig)
    exo._rows = rig.rows
    return exo


@pytest.mark.parametrize(
    ("late", "off_ms", "words"),
    [(0, 0.0, ""), (1, 20.0, ""), (2, 0.0, "2 of 100 cycles late"), (0, 20.1, "SYNC off by at most 20.1 ms")],
)
def test_rig_is_late_beyond_what_its_scenario_allows(
    rig: Rig, exo: RealTimeExo, late: int, off_ms: float, words: str
) -> None:
    """docs/pytest.md: the limits of `realtime:`, by default 1 % of the cycles and 20 ms."""
    watch = rig.watch = Watch(exo.plan)
    watch.cycles, watch.late = 100, late
    watch.offsets.add(round(off_ms * MS))
    assert bool(exo.lateness) == bool(words)
    assert words in exo.lateness


@pytest.mark.parametrize(("off_ms", "is_late"), [(20.0, False), (20.1, True)])
def test_cycles_that_a_fault_may_have_made_late_are_not_judged(
    rig: Rig, exo: RealTimeExo, off_ms: float, is_late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A test that keeps SYNC from the drives is not told that its rig was late; SYNC itself is judged all the same."""
    monkeypatch.setattr(exo._injectors, "listing", lambda: [InjectorRow("drop", "spent", NEVER, 1, 1, 1)])
    watch = rig.watch = Watch(exo.plan)
    watch.cycles, watch.late = 100, 50
    watch.offsets.add(round(off_ms * MS))
    assert bool(exo.lateness) == is_late


def test_frames_from_before_the_call_are_not_the_expected_one(rig: Rig, exo: RealTimeExo) -> None:
    """Read or not: the drive has not answered yet."""
    rig.put(105 * MS, WANTED)
    rig.put(1305 * MS, WANTED)
    exo.run_for("0.1 s")
    rig.sleep(1000 * MS)
    called = exo.time_ns
    row = exo.expect(WANTED, within="0.5 s")
    assert called <= row.end_ns == 1305 * MS
    rig.put(1700 * MS, WANTED)
    rig.sleep(1000 * MS)
    exo.expect_none(WANTED, within="0.1 s")


@pytest.mark.parametrize("after", range(6))
def test_a_test_without_a_turn_judges_what_was_on_the_bus(rig: Rig, exo: RealTimeExo, after: int) -> None:
    """200 ms without a turn at any place of the call: the frame of meanwhile counts, the frame after the limit not."""
    exo.run_for("10 ms")
    rig.put(40 * MS, WANTED)
    rig.put(190 * MS, WANTED + 1)
    for call in (
        lambda: exo.expect(WANTED, within="50 ms"),
        lambda: exo.expect_none(WANTED + 1, within="50 ms"),
    ):
        saved = (rig._now, list(rig._coming), list(rig.rows), exo._heard, exo._seen, list(exo._newest))
        rig.stall_ns, rig.stall_after = 200 * MS, after
        call()
        rig._now, rig._coming, rig.rows[:], exo._heard, exo._seen, exo._newest[:] = saved
    rig.stall_ns, rig.stall_after = 200 * MS, after
    with pytest.raises(AssertionError, match="was not to come within 50 ms"):
        exo.expect_none(WANTED, within="50 ms")


def test_the_answer_to_a_frame_of_the_test_may_be_there_before_the_test_looks(rig: Rig, exo: RealTimeExo) -> None:
    """A stall between `send` and `expect` loses no answer; with the next wait what was sent is past."""
    exo.run_for("100 ms")
    exo._senders[1] = cast(Channel, Sender())
    rig.put(rig.now() - MS, WANTED, b"early")
    exo.send(0x605, b"12345678", bus="drive")
    rig.put(rig.now() + MS, WANTED, b"answer")
    rig.sleep(200 * MS)
    assert exo.expect(WANTED, within="10 ms").frame.data == b"answer"
    rig.put(rig.now() + MS, WANTED)
    rig.sleep(200 * MS)
    with pytest.raises(AssertionError, match="no frame 185"):
        exo.expect(WANTED, within="10 ms")


def test_the_answer_to_a_fault_counts_from_the_gateways_time(
    rig: Rig, exo: RealTimeExo, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not from the return of the call, which may be late, and not before the fault acts."""
    exo._injectors._address = "127.0.0.1:1"
    monkeypatch.setattr(realtime, "ask", lambda address, word, name: {"ok": True, "time_ns": 30 * MS})
    exo.run_for("20 ms")
    rig.put(28 * MS, WANTED, b"early")
    rig.put(35 * MS, WANTED, b"fault")
    exo.gateway.stop()
    rig.sleep(200 * MS)
    assert exo.expect(WANTED, within="10 ms").frame.data == b"fault"


def test_a_frame_that_a_busy_hub_brings_after_the_limit_counts_by_its_time(rig: Rig, exo: RealTimeExo) -> None:
    """Nothing is judged before a later frame has come, or the bus was silent for a while."""
    exo.run_for("10 ms")
    rig.put(59 * MS, WANTED)
    rig.late_ns = 30 * MS
    with pytest.raises(AssertionError, match="was not to come"):
        exo.expect_none(WANTED, within="50 ms")


def test_nothing_can_be_excluded_when_frames_were_lost(rig: Rig, exo: RealTimeExo) -> None:
    """Losses from before the call are none of its business."""
    rig.lost = [5 * MS, 15 * MS, 30 * MS]
    rig.sleep(20 * MS)
    with pytest.raises(BenchError, match="1 frames were not heard within 50 ms"):
        exo.expect_none(WANTED, within="50 ms")
    exo.expect_none(WANTED, within="50 ms")


def test_a_state_that_is_over_before_it_is_read_was_there_all_the_same(rig: Rig, exo: RealTimeExo) -> None:
    """The condition is asked in the time of the frames, up to the limit and no further."""
    knee = next(joint for joint in exo.plan.joints if joint.name == "right_knee")
    drive = exo.drives["right_knee"]
    for at, state in ((5, 5), (30, 4), (40, 5), (90, 127)):
        rig.put(at * MS, HEARTBEAT + knee.node_id, bytes((state,)))
    exo.run_for("10 ms")
    rig.stall_ns, rig.stall_after = 200 * MS, 3
    exo.run_until(lambda: drive.nmt is not None and drive.nmt.value == 4, within="50 ms")
    assert drive.nmt is not None
    assert drive.nmt.value == 4


def test_a_condition_that_held_too_late_has_not_held(rig: Rig, exo: RealTimeExo) -> None:
    """Also when the limit is long over at the first look."""
    knee = next(joint for joint in exo.plan.joints if joint.name == "right_knee")
    drive = exo.drives["right_knee"]
    rig.put(90 * MS, HEARTBEAT + knee.node_id, b"\x05")
    rig.stall_ns, rig.stall_after = 200 * MS, 3
    with pytest.raises(AssertionError, match="did not hold within 50 ms"):
        exo.run_until(lambda: drive.nmt is not None, within="50 ms")
    assert drive.nmt is not None  # what came meanwhile is known afterwards


def test_a_condition_is_asked_about_the_present(rig: Rig, exo: RealTimeExo) -> None:
    """What the frames of meanwhile say is taken in before it is asked."""
    knee = next(joint for joint in exo.plan.joints if joint.name == "right_knee")
    drive = exo.drives["right_knee"]
    rig.put(5 * MS, HEARTBEAT + knee.node_id, b"\x7f")
    rig.put(30 * MS, HEARTBEAT + knee.node_id, b"\x05")
    exo.run_for("10 ms")
    rig.sleep(100 * MS)
    with pytest.raises(AssertionError, match="did not hold"):
        exo.run_until(lambda: drive.nmt is not None and drive.nmt.value == 127, within="50 ms")


def test_a_rig_that_breaks_is_no_failure_of_what_is_tested(
    rig: Rig, exo: RealTimeExo, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The controller says that it is stopped, as others do before their death is found: that is told instead."""
    rig.put(100 * MS, HLC_STATUS, bytes((STATUS_STOPPED, 0, 0, 0, 0)), bus=0)
    with pytest.raises(AssertionError, match="the motion has not begun"):
        exo.run_until_motion()
    run = rig.run

    def break_down(until: Callable[[int], bool]) -> None:
        run(until)
        if rig.now() > 150 * MS:
            raise ProcessError("joints was killed by SIGKILL")

    monkeypatch.setattr(rig, "run", break_down)
    with pytest.raises(ProcessError, match="joints was killed"):
        exo.run_until_motion()
