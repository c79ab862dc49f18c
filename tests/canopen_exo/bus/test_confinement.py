"""Error counters: every row of the table, and the states they make."""

import pytest

from canopen_exo.bus.confinement import (
    RULES,
    RX_DOMINANT_RUN,
    RX_ERROR,
    RX_FIRST_DOMINANT,
    RX_FLAG_BIT,
    RX_SUCCESS,
    TX_DOMINANT_RUN,
    TX_ERROR,
    TX_FLAG_BIT,
    TX_SUCCESS,
    count,
    state_of,
)
from canopen_exo.bus.node import ErrorState


@pytest.mark.parametrize(
    ("rule", "tec", "rec"),
    [
        (RX_ERROR, 10, 21),
        (RX_FIRST_DOMINANT, 10, 28),
        (TX_ERROR, 18, 20),
        (TX_FLAG_BIT, 18, 20),
        (RX_FLAG_BIT, 10, 28),
        (TX_DOMINANT_RUN, 18, 20),
        (RX_DOMINANT_RUN, 10, 28),
        (TX_SUCCESS, 9, 20),
        (RX_SUCCESS, 10, 19),
    ],
)
def test_rule_changes_one_counter_as_the_standard_says(rule: int, tec: int, rec: int) -> None:
    """ISO 11898-1, fault confinement: +1, +8, -1."""
    assert count(rule, 10, 20) == (tec, rec)


def test_table_has_a_row_for_every_rule() -> None:
    """The constants number the rows."""
    assert sorted((RX_ERROR, RX_FIRST_DOMINANT, TX_ERROR, TX_FLAG_BIT, RX_FLAG_BIT, TX_DOMINANT_RUN, RX_DOMINANT_RUN,
                   TX_SUCCESS, RX_SUCCESS)) == list(range(len(RULES)))  # fmt: skip


@pytest.mark.parametrize(("before", "after"), [(0, 0), (1, 0), (127, 126), (128, 120), (200, 120), (255, 120)])
def test_reception_brings_a_high_rec_back_below_passive(before: int, after: int) -> None:
    """If REC > 127 then a value of 119..127; never below 0."""
    assert count(RX_SUCCESS, 0, before) == (0, after)


def test_counters_stay_within_their_registers() -> None:
    """TEC never below 0; REC saturates."""
    assert count(TX_SUCCESS, 0, 0) == (0, 0)
    assert count(RX_FIRST_DOMINANT, 0, 250) == (0, 255)


@pytest.mark.parametrize(
    ("tec", "rec", "state"),
    [
        (0, 0, ErrorState.ERROR_ACTIVE),
        (95, 95, ErrorState.ERROR_ACTIVE),
        (96, 0, ErrorState.WARNING),
        (0, 96, ErrorState.WARNING),
        (127, 127, ErrorState.WARNING),
        (128, 0, ErrorState.ERROR_PASSIVE),
        (0, 128, ErrorState.ERROR_PASSIVE),
        (255, 255, ErrorState.ERROR_PASSIVE),
        (256, 0, ErrorState.BUS_OFF),
        (263, 255, ErrorState.BUS_OFF),
    ],
)
def test_states_begin_at_96_128_and_256(tec: int, rec: int, state: ErrorState) -> None:
    """Warning from 96, passive from 128 of either counter, bus-off from TEC 256."""
    assert state_of(tec, rec) is state
