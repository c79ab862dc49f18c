"""The distribution of delays."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.lateness import Lateness, LatenessDocument
from canopen_exo.errors import CanopenExoError

DELAYS = st.lists(st.integers(min_value=0, max_value=1 << 40), min_size=1, max_size=50)


def filled(values: list[int]) -> Lateness:
    lateness = Lateness()
    for value in values:
        lateness.add(value)
    return lateness


@given(DELAYS, st.sampled_from([0.0, 0.5, 0.9, 0.99, 0.999, 1.0]))
def test_percentile_is_exact_to_one_bin_of_an_eighth_octave(values: list[int], share: float) -> None:
    """The nearest-rank percentile lies at most 12.5 % below what is reported, never above it."""
    rank = max(math.ceil(share * len(values)), 1)
    exact = sorted(values)[rank - 1]
    got = filled(values).percentile(share)
    assert exact <= got <= exact + exact // 8


@given(DELAYS)
def test_count_and_worst_are_exact(values: list[int]) -> None:
    """A run is judged by its worst delay: that one is not binned."""
    lateness = filled(values)
    assert (lateness.count, lateness.worst_ns) == (len(values), max(values))
    assert lateness.percentile(1.0) == max(values)


@given(DELAYS, DELAYS)
def test_merging_equals_one_distribution_of_all_values(first: list[int], second: list[int]) -> None:
    """Every process writes its own part; the supervisor adds them up."""
    merged = filled(first)
    merged.merge(filled(second))
    assert merged.document() == filled(first + second).document()


@given(DELAYS)
def test_document_survives_json(values: list[int]) -> None:
    """What one process wrote another reads without loss."""
    document = filled(values).document()
    assert Lateness.from_document(json.loads(json.dumps(document))).document() == document


def test_empty_distribution_has_zeros() -> None:
    """No wake-up yet is no error."""
    document = Lateness().document()
    assert document["bins"] == []
    assert (document["count"], document["worst_ns"], document["p99_ns"]) == (0, 0, 0)


def test_early_counts_as_not_late() -> None:
    """A delay below 0 is none."""
    assert filled([-5]).document() == filled([0]).document()


@pytest.mark.parametrize("share", [-0.1, 1.1, 99.0])
def test_percentile_outside_0_to_1_is_refused(share: float) -> None:
    """99 is meant as 0.99; a guess would be wrong by a factor of 100."""
    with pytest.raises(CanopenExoError, match=r"0\.\.1"):
        Lateness().percentile(share)


GOOD = filled([1, 100, 100, 5000]).document()


@pytest.mark.parametrize(
    "change",
    [
        {"bins": [[1, 2, 3]]},
        {"bins": [[1, -2]]},
        {"bins": [["1", 2]]},
        {"bins": [[-1, 2]]},
        {"bins": 5},
        {"count": 3},
        {"worst_ns": None},
        {"worst_ns": "late"},
    ],
)
def test_document_that_is_none_is_refused(change: dict[str, object]) -> None:
    """A damaged part of a result must not become numbers."""
    document: LatenessDocument = {**GOOD, **change}  # type: ignore[typeddict-item]
    with pytest.raises(CanopenExoError, match="no distribution"):
        Lateness.from_document(document)


def test_document_without_bins_is_refused() -> None:
    """As above, for a missing key."""
    with pytest.raises(CanopenExoError, match="no distribution"):
        Lateness.from_document({"count": 0, "worst_ns": 0})  # type: ignore[typeddict-item]


def test_words_are_in_milliseconds() -> None:
    """For the message of a run that was late."""
    lateness = filled([1_000_000] * 99 + [50_000_000])
    assert lateness.words() == "100, 50 % within 1.0 ms, 90 % within 1.0 ms, 99 % within 1.0 ms, the latest 50.0 ms"
