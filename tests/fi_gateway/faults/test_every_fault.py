"""What every fault holds to, whatever it does: no crash on any bytes, no residue, copies that go on identically."""

import copy
import pickle
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

import fi_gateway.faults
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.distributions import Exponential
from fi_gateway.faults import (
    Bias,
    BitFlip,
    BitStuck,
    BurstDrop,
    CorruptDlc,
    Delay,
    Drift,
    Drop,
    Duplicate,
    Fault,
    Gain,
    Insert,
    Masquerade,
    NoiseFault,
    NormalNoise,
    RelativeNoise,
    Replay,
    Resequence,
    StuckAt,
    StuckAtPayload,
    StuckAtValue,
    TimeDelay,
    UniformNoise,
    ValueFault,
)
from tests.fi_gateway.faults.bench import ODD, POSITION, VELOCITY, WORD, Taken, joint, rng

KEEPING: list[Callable[[], Fault]] = [
    lambda: StuckAt(POSITION),
    lambda: StuckAt(None),
    lambda: StuckAtValue(WORD, 7),
    lambda: StuckAtPayload(bytes(8)),
    lambda: TimeDelay(POSITION, 3),
    lambda: Bias(ODD, 100),
    lambda: Gain(ODD, -1.5),
    lambda: Drift(POSITION, 3e8),
    lambda: RelativeNoise(VELOCITY, 0.5),
    lambda: UniformNoise(ODD, 100.0),
    lambda: NormalNoise(POSITION, 3.0),
    lambda: BitFlip(ODD, 2),
    lambda: BitFlip(None, 3, None, True),
    lambda: BitFlip(VELOCITY, 1, (3,)),
    lambda: BitStuck(ODD, (0, 10), 1),
    lambda: BitStuck(None, (5,), 0),
]
"""They change the payload of a frame that goes on at once, and nothing else."""

EVERY: list[Callable[[], Fault]] = [
    *KEEPING,
    lambda: Drop(0.5),
    lambda: BurstDrop(0.3, 0.4, 0.1, 0.9),
    lambda: Delay(2),
    lambda: Delay(1, Exponential(5.0)),
    lambda: Delay(1, Exponential(5.0), True),
    lambda: Resequence(4),
    lambda: Resequence(4, True),
    lambda: Duplicate(2, 1),
    lambda: Replay(2),
    lambda: Replay(2, True),
    lambda: Insert(Frame(0x000, b"\x02\x05"), 2),
    lambda: Insert(Frame(0x000, b"\x02\x05")),
    lambda: Masquerade(0x182),
    lambda: CorruptDlc(),
    lambda: CorruptDlc(3),
]


def test_every_fault_is_in_this_file() -> None:
    """A new one cannot forget these tests."""
    exported = {getattr(fi_gateway.faults, name) for name in fi_gateway.faults.__all__}
    classes = {one for one in exported if isinstance(one, type) and issubclass(one, Fault)}
    assert {type(make()) for make in EVERY} == classes - {Fault, ValueFault, NoiseFault}


Outcome = tuple[list[Frame | str | None], list[tuple[int, Frame, bool]], list[Frame], int]


def activation(fault: Fault, frames: list[Frame], start: int, seed: int) -> Outcome:
    """All that comes of an activation, one frame a ns; the fault's wake-ups are served before the frame."""
    out = Taken()
    left: list[Frame | str | None] = []
    assert fault.begin(start, {0x185: joint(4, 5)}, rng(seed))
    for now, frame in enumerate(frames, start):
        while fault.wake_at <= now:
            fault.wake(fault.wake_at, out)
        left.append(fault.apply(now, frame, out) if fault.fits(frame) else "unfit")
    saturated = fault.saturated
    fault.end()
    return left, [(at - start, one, in_order) for at, one, in_order in out.late], out.inserted, saturated


FRAMES = st.lists(st.binary(max_size=8).map(lambda data: Frame(0x185, data)), max_size=12)


@given(st.sampled_from(EVERY), FRAMES, FRAMES, st.integers(0, 100))
def test_two_activations_equal_two_fresh_ones(
    make: Callable[[], Fault], first: list[Frame], second: list[Frame], seed: int
) -> None:
    """Activation and deactivation leave no residue: the second one is what it would be alone, with the same draws."""
    used = make()
    activation(used, first, 0, seed)
    assert activation(used, second, 1000, seed + 1) == activation(make(), second, 1000, seed + 1)
    assert used.wake_at == NEVER


@given(st.sampled_from(KEEPING), FRAMES, st.integers(0, 100))
def test_a_changed_payload_keeps_id_flags_length_and_its_place(
    make: Callable[[], Fault], frames: list[Frame], seed: int
) -> None:
    """Bytes from the wire are data, whatever they are; one frame in, one frame out, at once."""
    left, late, inserted, _ = activation(make(), frames, 0, seed)
    assert late == inserted == []
    for one, result in zip(frames, left, strict=True):
        if isinstance(result, Frame):
            assert (result.can_id, result.flags, result.dlc) == (one.can_id, one.flags, one.dlc)
        else:
            assert result == "unfit"


@given(st.sampled_from(EVERY), FRAMES, st.integers(0, 100))
def test_no_fault_raises_or_sends_into_the_past(make: Callable[[], Fault], frames: list[Frame], seed: int) -> None:
    """Whatever comes: classical data frames go on, none before it came."""
    left, late, inserted, _ = activation(make(), frames, 50, seed)
    sent = [one for one in left if isinstance(one, Frame)] + inserted + [one for _, one, _ in late]
    assert all(one.flags == 0 and len(one.data) <= 8 for one in sent)
    assert all(at >= 0 for at, _, _ in late)


@given(st.sampled_from(EVERY), st.integers(0, 100))
def test_what_does_not_fit_any_signal_is_left_alone(make: Callable[[], Fault], seed: int) -> None:
    """An empty frame holds no value: faults on signals and bits say that it does not fit."""
    fault = make()
    fault.begin(0, {0x185: joint(1, 2)}, rng(seed))
    if fault.signal is not None or isinstance(fault, BitFlip | BitStuck):
        assert not fault.fits(Frame(0x185, b""))


@pytest.mark.parametrize(
    ("fault", "shortest"),
    [
        (StuckAtValue(POSITION, 0), 4),
        (Bias(VELOCITY, 1), 8),
        (Gain(POSITION, 1.0), 4),
        (TimeDelay(VELOCITY, 1), 8),
        (StuckAt(ODD), 3),
        (BitFlip(ODD, 1), 3),
        (BitFlip(None, 9), 2),
        (BitFlip(None, 1, (15,)), 2),
        (BitFlip(None, 1, (16,)), 3),
        (BitStuck(ODD, (0,), 1), 3),
        (BitStuck(None, (15,), 0), 2),
        (BitStuck(None, (16,), 0), 3),
        (Drop(), 0),
        (Delay(1), 0),
        (CorruptDlc(), 0),
    ],
)
def test_a_frame_fits_from_the_byte_that_holds_the_last_bit(fault: Fault, shortest: int) -> None:
    """A frame too short passes unchanged: `fits` says which is."""
    fault.begin(0, {}, rng())
    assert [fault.fits(Frame(0x185, bytes(n))) for n in range(9)] == [n >= shortest for n in range(9)]


@pytest.mark.parametrize("make", EVERY)
def test_giving_the_frame_back_means_spared_where_the_fault_says_so(make: Callable[[], Fault]) -> None:
    """faults.md: injected counts frames acted on; those that a loss, a replay or an insertion spares are not."""
    fault: Fault = make()
    periodic = isinstance(fault, Insert) and fault.begin(0, {}, rng()) and fault.wake_at != NEVER
    assert fault.spares == (isinstance(fault, Drop | BurstDrop | Replay) or periodic)
    assert copy.deepcopy(fault).spares == fault.spares


@pytest.mark.parametrize("make", EVERY)
def test_a_copy_in_mid_activation_goes_on_identically(make: Callable[[], Fault]) -> None:
    """Snapshots: deepcopy and pickle keep held values, drawn bits, what is due, and the stream."""
    fault: Fault = make()
    fault.begin(0, {0x185: joint(4, 5)}, rng())
    for n in range(3):
        fault.apply(n, joint(n, n), Taken())
    copies = [copy.deepcopy(fault), pickle.loads(pickle.dumps(fault))]

    def go_on(one: Fault) -> tuple[object, ...]:
        out = Taken()
        left = [one.apply(n, joint(n, -n), out) for n in range(3, 23)]
        if one.wake_at != NEVER:
            one.wake(one.wake_at, out)
        return left, out.late, out.inserted, one.saturated, one.wake_at

    on = go_on(fault)
    for twin in copies:
        assert go_on(twin) == on
