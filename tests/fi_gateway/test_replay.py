"""Recorded windows, applied again: same times, same draws of the faults, none of events and effects."""

import copy

import pytest
from numpy.random import Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER, Out
from fi_gateway.activation import Activation
from fi_gateway.effects import ConstantTime, Effect, Once
from fi_gateway.events import At, Event, FailureProbability, Never
from fi_gateway.faults import BitFlip, Drop, Fault
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from fi_gateway.injector import Injector, Target, stream
from fi_gateway.outlet import Outlet
from fi_gateway.replay import RecordedEffect, RecordedEvent, Recording, Window
from fi_gateway.rng_state import state_of
from fi_gateway.trigger import Trigger

ZERO = 1_000_000
CYCLE = 2_000
HERE = Target(True, False, (0x185,))
FRAMES = 4_000


class Sink(Out):
    """What goes out on the controller side."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def send(self, port: int, frame: Frame) -> None:
        self.sent.append(frame.data)


class Moody(Fault):
    """Draws when it begins, and with every frame, as a fault with a state of its own does."""

    def __init__(self) -> None:
        super().__init__(None)
        self.first = 0
        self.rng: Generator | None = None

    def begin(self, now: int, held: dict[int, Frame], rng: Generator) -> bool:
        self.saturated, self.rng, self.first = 0, rng, int(rng.integers(256))
        return True

    def apply(self, now: int, frame: Frame, outlet: Outlet) -> Frame | None:
        assert self.rng is not None
        return Frame(frame.can_id, bytes((self.first, int(self.rng.integers(256)))))


class Drawn(Effect):
    """A length that is drawn for each activation."""

    def __init__(self, rng: Generator) -> None:
        super().__init__(0, True)
        self.rng = rng

    def duration(self) -> int:
        return 1 + int(self.rng.integers(50_000))


def injectors(replay: dict[str, tuple[Window, ...]] | None = None) -> list[Injector]:
    """Three that draw: one by chance, one chained to it, one for a single frame."""
    moody, lossy, once = (stream(7, 0, name) for name in ("moody", "lossy", "once"))
    parts: list[tuple[str, Fault, Event, Effect, Trigger | None, Generator]] = [
        ("moody", Moody(), FailureProbability(0.02, CYCLE, moody), Drawn(moody), None, moody),
        ("lossy", Drop(0.5), Never(), Drawn(lossy), Trigger(("moody",)), lossy),
        ("once", BitFlip(None, 3), At((900_001,)), Once(), None, once),
    ]
    made = []
    for name, fault, event, effect, trigger, rng in parts:
        own = rng.spawn(1)[0]
        if replay is None:
            made.append(Injector(name, HERE, fault, event, effect, trigger, rng, fault_rng=own))
        else:
            recording = Recording(replay.get(name, ()), own)
            again = RecordedEffect(recording, effect.frames)
            made.append(Injector(name, HERE, fault, RecordedEvent(recording), again, None, rng, fault_rng=own))
    return made


def begun(parts: list[Injector]) -> Gateway:
    gateway, sink = Gateway(parts, CYCLE), Sink()
    gateway.receive(ZERO, CONTROLLER_PORT, Frame(0x080, b"\x01"), sink)
    gateway.receive(ZERO, CONTROLLER_PORT, Frame(0x2FF, bytes((2, 0, 0, 0, 0))), sink)
    return gateway


def drive(gateway: Gateway, first: int, last: int) -> list[bytes]:
    """Frames every 500 ns."""
    sink = Sink()
    for k in range(first, last):
        now = ZERO + 500 * k
        while gateway.wake_at < now:
            gateway.wake(gateway.wake_at, sink)
        gateway.receive(now, DRIVE_PORT, Frame(0x185, k.to_bytes(2, "little")), sink)
    return sink.sent


def windows(records: list[Activation]) -> dict[str, tuple[Window, ...]]:
    found: dict[str, tuple[Window, ...]] = {}
    for one in records:
        end_ns = NEVER if one.end_ns >= NEVER else one.end_ns - ZERO
        window = Window(one.start_ns - ZERO, end_ns, one.stream, one.skipped)
        found[one.injector] = (*found.get(one.injector, ()), window)
    return found


@pytest.fixture(scope="module")
def recorded() -> tuple[list[bytes], list[Activation]]:
    gateway = begun(injectors())
    sent = drive(gateway, 0, FRAMES)
    gateway.finish(ZERO + 500 * FRAMES)
    return sent, gateway.records


def summary(records: list[Activation]) -> list[tuple[object, ...]]:
    return sorted(
        (one.injector, one.index, one.start_ns, one.end_ns, one.frames_injected, one.frames_changed, one.stream)
        for one in records
    )


def test_replay_gives_the_same_frames_and_the_same_records(recorded: tuple[list[bytes], list[Activation]]) -> None:
    """Events, effects and a trigger drew in the recorded run; here only the faults draw, from where they stood."""
    sent, records = recorded
    assert {one.injector for one in records} == {"moody", "lossy", "once"}
    assert sum(one.injector == "moody" for one in records) > 5
    gateway = begun(injectors(windows(records)))
    assert drive(gateway, 0, FRAMES) == sent
    gateway.finish(ZERO + 500 * FRAMES)
    assert summary(gateway.records) == summary(records)
    assert {one.cause for one in gateway.records} == {"event"}


def test_replay_of_a_replay_is_the_same(recorded: tuple[list[bytes], list[Activation]]) -> None:
    """What a replay records is enough for the next one."""
    sent, records = recorded
    for _ in range(2):
        gateway = begun(injectors(windows(records)))
        assert drive(gateway, 0, FRAMES) == sent
        gateway.finish(ZERO + 500 * FRAMES)
        records = gateway.records


def moods(replay: dict[str, tuple[Window, ...]]) -> list[tuple[int, int, Frame | None]]:
    """Window and first changed frame of each activation of "moody" in a replay."""
    gateway = begun(injectors(replay))
    drive(gateway, 0, FRAMES)
    gateway.finish(ZERO + 500 * FRAMES)
    return [(one.start_ns, one.end_ns, one.first_after) for one in gateway.records if one.injector == "moody"]


def test_one_activation_less_leaves_the_others_as_they_were(recorded: tuple[list[bytes], list[Activation]]) -> None:
    """A row taken out of the record: what the others do, and draw, stays; without the recorded streams it would not."""
    _, records = recorded
    kept = [one for one in records if not (one.injector == "moody" and one.index == 0)]
    wanted = [(one.start_ns, one.end_ns, one.first_after) for one in kept if one.injector == "moody"]
    assert moods(windows(kept)) == wanted
    bare = {name: tuple(Window(one.start_ns, one.end_ns) for one in found) for name, found in windows(kept).items()}
    assert [one[:2] for one in moods(bare)] == [one[:2] for one in wanted]
    assert moods(bare) != wanted


def test_copy_in_mid_replay_goes_on_as_the_original(recorded: tuple[list[bytes], list[Activation]]) -> None:
    """Snapshots: event, effect and stream of an injector stay one recording."""
    sent, records = recorded
    gateway = begun(injectors(windows(records)))
    head = drive(gateway, 0, 1_000)
    clone = copy.deepcopy(gateway)
    tail = drive(gateway, 1_000, FRAMES)
    assert head + tail == sent
    assert drive(clone, 1_000, FRAMES) == tail


def test_windows_come_in_their_order_and_past_ones_are_left_out() -> None:
    """An injector that is free later than a window ends has missed it; one that is late opens at once."""
    recording = Recording((Window(10, 20), Window(30, 40), Window(50, NEVER)), stream(1, 0, "x"))
    event, effect = RecordedEvent(recording), RecordedEffect(recording, 0)
    assert event.first() == 10
    assert effect.duration() == 10
    assert event.next(20) == 30
    assert event.next(33) == 33
    assert effect.duration() == 7
    assert event.next(40) == 50
    assert effect.duration() == NEVER
    assert event.next(60) == NEVER
    assert RecordedEvent(Recording((Window(10, 20), Window(30, 40)), stream(1, 0, "x"))).next(20) == 30


def test_windows_without_length_are_left_out() -> None:
    """A command can leave some; they met no frame."""
    recording = Recording((Window(10, 10), Window(12, 13), Window(20, 20)), stream(1, 0, "x"))
    assert recording.announce(0) == 12
    assert recording.open() == 1
    assert recording.announce(13) == NEVER


def test_recorded_event_draws_nothing() -> None:
    """Without recorded states the stream stays where it was."""
    rng = stream(1, 0, "x")
    before = state_of(rng)
    recording = Recording((Window(10, 20),), rng)
    RecordedEvent(recording).first()
    RecordedEffect(recording, 0).duration()
    assert state_of(rng) == before


def test_the_recorded_state_is_that_of_the_fault_before_it_began() -> None:
    """Not that of the stream from which event and effect draw."""
    rng, own = stream(1, 0, "x"), stream(2, 0, "x")
    stood = state_of(own)
    one = Injector("x", HERE, Moody(), At((0,)), ConstantTime(5), None, rng, fault_rng=own)
    one.start(0)
    opened = one.open(0, "event")
    assert opened is not None
    assert opened.stream == stood
    assert state_of(own) != stood
