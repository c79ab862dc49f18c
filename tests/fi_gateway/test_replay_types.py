"""Every type of fault, recorded on two buses and replayed, gives the same trace."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canopen_exo.bus.node import NEVER
from fi_gateway.replay import Window
from tests.fi_gateway.two_buses import EFFECT_TEXTS, END, EVENT_TEXTS, FAULT_TEXTS, FIRST, Bench, text_of


def ran(bench: Bench) -> Bench:
    bench.loop.run_until(END)
    bench.gateway.finish(bench.loop.now)
    return bench


def windows_of(bench: Bench) -> dict[str, tuple[Window, ...]]:
    """As `injections.csv` has them, from what the times of each injector count from."""
    found: dict[str, tuple[Window, ...]] = {}
    for one in bench.gateway.records:
        base_ns = FIRST if one.injector == "starter" else bench.gateway.time_zero
        end_ns = NEVER if one.end_ns >= NEVER else one.end_ns - base_ns
        window = Window(one.start_ns - base_ns, end_ns, one.stream, one.skipped)
        found[one.injector] = (*found.get(one.injector, ()), window)
    return found


@pytest.mark.long
@pytest.mark.parametrize(("target", "fault"), FAULT_TEXTS)
@settings(max_examples=4, deadline=None)
@given(event=st.sampled_from(EVENT_TEXTS), effect=st.sampled_from(EFFECT_TEXTS), seed=st.integers(0, 1000))
def test_a_replay_of_any_fault_gives_the_same_trace(
    target: str, fault: str, event: str, effect: str, seed: int
) -> None:
    """results.md: the frames are the same again, also with errors on the buses, whatever started and ended windows."""
    text = text_of(target, fault, event, effect)
    first = ran(Bench(text, seed))
    again = ran(Bench(text, seed, windows_of(first)))
    assert rows(again) == rows(first)
    assert counts(again) == counts(first)


def rows(bench: Bench) -> list[tuple[object, ...]]:
    return [(row.end_ns, row.bus, row.sender, row.frame) for row in bench.loop.trace]


def counts(bench: Bench) -> list[tuple[object, ...]]:
    """What the windows did that met something, or could have."""
    return sorted(
        (one.injector, one.start_ns, one.end_ns, one.frames_injected, one.manifested, one.first_ns, one.attempts_seen)
        for one in bench.gateway.records
        if one.end_ns > one.start_ns
    )
