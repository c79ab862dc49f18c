"""A run copied in its middle: gateway, injectors, buses and wires go on as the originals would have."""

import copy

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.node import MS
from fi_gateway.effect_specs import EFFECTS
from fi_gateway.event_specs import EVENTS
from fi_gateway.fault_specs import FAULTS
from tests.fi_gateway.two_buses import EFFECT_TEXTS, END, EVENT_TEXTS, FAULT_TEXTS, Bench, text_of


def test_all_types_are_in_these_lists() -> None:
    """None is forgotten."""
    for kinds, texts in (
        (FAULTS, [text for _, text in FAULT_TEXTS]), (EVENTS, EVENT_TEXTS), (EFFECTS, EFFECT_TEXTS)
    ):  # fmt: skip
        assert set(kinds.built_in) == {text.removeprefix("{type: ").split(",")[0].rstrip("}") for text in texts}


@pytest.mark.long
@pytest.mark.parametrize(("target", "fault"), FAULT_TEXTS)
@settings(max_examples=3, deadline=None)
@given(
    event=st.sampled_from(EVENT_TEXTS),
    effect=st.sampled_from(EFFECT_TEXTS),
    instants=st.lists(st.integers(0, END), min_size=1, max_size=3),
    seed=st.integers(0, 1000),
)
def test_a_copy_in_mid_run_goes_on_as_the_original(
    target: str, fault: str, event: str, effect: str, instants: list[int], seed: int
) -> None:
    """Any fault with any event and effect, at any instant; also a copy of a copy; the original is not touched."""
    text = text_of(target, fault, event, effect)
    straight = Bench(text, seed)
    straight.loop.run_until(END)
    bench = Bench(text, seed)
    twins = []
    for instant in sorted(instants):
        bench.loop.run_until(instant)
        twins.append(bench)
        bench = copy.deepcopy(bench)
    twins.append(bench)
    for twin in reversed(twins):
        twin.loop.run_until(END)
        assert twin.state(max(instants)) == straight.state(max(instants))


def test_what_never_changes_is_shared() -> None:
    """Frames, signals, targets, triggers and laws are not copied."""
    bench = Bench(text_of(*FAULT_TEXTS[0], EVENT_TEXTS[5], EFFECT_TEXTS[2]), 1)
    bench.loop.run_until(20 * MS)
    twin = copy.deepcopy(bench)
    for one, other in zip(bench.gateway.injectors, twin.gateway.injectors, strict=True):
        assert other is not one
        assert other.target is one.target
        assert other.trigger is one.trigger
        assert other.held == one.held
        assert all(other.held[key] is frame for key, frame in one.held.items())
