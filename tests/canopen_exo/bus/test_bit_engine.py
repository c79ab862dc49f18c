"""CAN controllers bit by bit: who sends which flag when, what is counted, who accepts the frame."""

import numpy as np
import pytest

from benchmarks.double_flips import pairs_of, wrong_frame
from canopen_exo.bus.bit_engine import run, split
from canopen_exo.bus.bit_stream import field_positions, wire_bits
from canopen_exo.bus.confinement import (
    RX_DOMINANT_RUN,
    RX_ERROR,
    RX_FIRST_DOMINANT,
    RX_FLAG_BIT,
    RX_SUCCESS,
    TX_DOMINANT_RUN,
    TX_ERROR,
    TX_FLAG_BIT,
    TX_SUCCESS,
)
from canopen_exo.bus.controller import (
    ACK_ERROR,
    BIT_DOMINANT,
    BIT_RECESSIVE,
    CRC_ERROR,
    FORM_ERROR,
    OFF,
    STUFF_ERROR,
    Controller,
)
from canopen_exo.bus.disturbance import ALL, DOMINANT, FLIP, NO_ACK, Disruption
from canopen_exo.bus.frame import FLAG_EXTENDED, Frame

FRAME = Frame(0x181, bytes.fromhex("55AA55AA55AA55AA"))
"""Few stuff bits."""
LENGTH = len(wire_bits(FRAME))
EOF = field_positions(FRAME, "eof")
ACK = field_positions(FRAME, "ack")[0]
SENDER, LOCAL, REST = 1 << 0, 1 << 1, 0b1100
"""Port 0 sends, port 1 is the one that errors are local to, ports 2 and 3 are the others."""


class Outcome:
    """Controllers after an attempt, by port."""

    def __init__(self, disruptions: list[Disruption], tec: int = 0, rec: int = 0, others: int = 3, limit: int = 4096):
        sender = Controller([0], tec, 0)
        sender.send(FRAME)
        receivers = [Controller([1], 0, rec)] if others else []
        if others > 1:
            receivers.append(Controller(list(range(2, others + 1)), 0, 0))
        self.controllers = split([sender, *receivers], disruptions)
        self.bits = run(self.controllers, disruptions, limit)

    def port(self, number: int) -> Controller:
        return next(one for one in self.controllers if number in one.ports)

    def rules(self, number: int) -> list[int]:
        return [one.rule for one in self.port(number).counted]

    def first(self, number: int) -> tuple[int, int]:
        """Bit and kind of the first error it noticed."""
        error = self.port(number).found[0]
        return error.at, error.kind


def flip(at: int, ports: int = ALL) -> Disruption:
    return Disruption(FLIP, at, at + 1, ports)


def plain_bit(value: int) -> int:
    """A data bit of that value which makes no stuff error when inverted."""
    bits = wire_bits(FRAME)
    for at in field_positions(FRAME, "data")[8:]:
        if bits[at] == value and bits[at - 1] != bits[at - 2] and bits[at + 1] != bits[at + 2]:
            return at
    raise AssertionError("no such bit")


# --- undisturbed -------------------------------------------------------------------------------------------------


def test_undisturbed_frame_is_accepted_by_all_and_lasts_its_bits() -> None:
    """The engine and the fast path agree; EOF bit 6 makes the receivers accept, bit 7 the sender."""
    outcome = Outcome([])
    assert outcome.bits == FRAME.measure()
    assert outcome.port(0).sent_at == EOF[6]
    assert [outcome.port(one).accepted_at for one in (1, 2, 3)] == [EOF[5]] * 3
    assert [outcome.rules(one) for one in (0, 1)] == [[TX_SUCCESS], [RX_SUCCESS]]


def test_lower_id_wins_bit_by_bit_and_the_loser_receives() -> None:
    """Lost arbitration is no error."""
    winner, loser = Controller([0], 0, 0), Controller([1], 0, 0)
    winner.send(Frame(0x180, b"\1"))
    loser.send(Frame(0x181, b"\2"))
    run([winner, loser], [], 4096)
    assert winner.sent_at > 0
    assert loser.accepted == Frame(0x180, b"\1")
    assert loser.found == []


def test_base_frame_wins_against_an_extended_one_with_the_same_first_bits() -> None:
    """Recessive SRR and IDE lose."""
    base, extended = Controller([0], 0, 0), Controller([1], 0, 0)
    base.send(Frame(0x181, b"\1"))
    extended.send(Frame(0x181 << 18, b"\2", FLAG_EXTENDED))
    run([base, extended], [], 4096)
    assert extended.accepted == Frame(0x181, b"\1")
    assert extended.found == []


def test_two_senders_of_one_id_end_in_a_bit_error() -> None:
    """The one that sends recessive in the data sees dominant."""
    first, second = Controller([0], 0, 0), Controller([1], 0, 0)
    first.send(Frame(0x181, b"\x01"))
    second.send(Frame(0x181, b"\x03"))
    run([first, second], [], 4096)
    assert [one.sent_at for one in (first, second)] == [-1, -1]
    assert second.found[0].kind == BIT_RECESSIVE


# --- the counter table, row by row -------------------------------------------------------------------------------


def test_receiver_counts_1_for_an_error_it_detects() -> None:
    """REC +1; the flag follows at the next bit and makes the sender repeat."""
    outcome = Outcome([flip(ACK - 1, LOCAL)])  # CRC delimiter
    assert outcome.first(1) == (ACK - 1, FORM_ERROR)
    assert outcome.rules(1)[0] == RX_ERROR
    assert outcome.port(0).sent_at == -1


def test_receiver_counts_8_for_dominant_after_its_flag() -> None:
    """The flags of the others come after its own: it was the first, and is taken for the cause."""
    outcome = Outcome([flip(plain_bit(1), LOCAL)])
    assert RX_FIRST_DOMINANT in outcome.rules(1)
    assert outcome.port(1).rec == 9
    assert [outcome.rules(one) for one in (2, 3)] == [[RX_ERROR]] * 2


def test_sender_counts_8_for_an_error_flag() -> None:
    """A bit error in the data."""
    outcome = Outcome([flip(plain_bit(1))])
    assert outcome.first(0) == (plain_bit(1), BIT_RECESSIVE)
    assert outcome.rules(0) == [TX_ERROR]
    assert outcome.port(0).tec == 8


def test_sender_sees_a_missing_dominant_bit() -> None:
    """The other kind of bit error."""
    assert Outcome([flip(plain_bit(0))]).first(0) == (plain_bit(0), BIT_DOMINANT)


def test_passive_sender_counts_nothing_for_a_missing_acknowledge() -> None:
    """Exception 1: so a lone node stops at 128."""
    outcome = Outcome([], tec=128, others=0)
    assert outcome.first(0) == (ACK, ACK_ERROR)
    assert outcome.rules(0) == []


def test_passive_sender_counts_8_when_its_flag_meets_a_dominant_bit() -> None:
    """... but not if somebody is there after all."""
    outcome = Outcome([Disruption(NO_ACK, 0, 1), Disruption(DOMINANT, ACK + 3, ACK + 4)], tec=128)
    assert outcome.first(0) == (ACK, ACK_ERROR)
    assert outcome.rules(0) == [TX_ERROR]


def test_active_sender_counts_8_for_a_missing_acknowledge() -> None:
    """Up to 127 the exception does not hold."""
    outcome = Outcome([], tec=120, others=0)
    assert outcome.rules(0) == [TX_ERROR]


def test_sender_counts_nothing_for_a_recessive_stuff_bit_read_dominant_in_arbitration() -> None:
    """Exception 2: it may have been another node's id."""
    frame = Frame(0x001, b"")
    assert wire_bits(frame)[:7] == [0, 0, 0, 0, 0, 1, 0]
    sender, receiver = Controller([0], 0, 0), Controller([1], 0, 0)
    sender.send(frame)
    run([sender, receiver], [flip(5)], 4096)
    assert sender.found[0].kind == STUFF_ERROR
    assert sender.counted == []
    assert receiver.rec == 1


def test_sender_counts_8_for_a_stuff_bit_read_wrong_after_arbitration() -> None:
    """... in the data it is a bit error like any other."""
    frame = Frame(0x555, b"\x00")
    bits = wire_bits(frame)
    stuff_at = next(at for at in range(19, len(bits)) if bits[at] == 1 and bits[at - 5 : at] == [0] * 5)
    sender, receiver = Controller([0], 0, 0), Controller([1], 0, 0)
    sender.send(frame)
    run([sender, receiver], [flip(stuff_at)], 4096)
    assert sender.found[0].kind == BIT_RECESSIVE
    assert sender.tec == 8


@pytest.mark.parametrize(("port", "rule"), [(0, TX_FLAG_BIT), (1, RX_FLAG_BIT)])
def test_bit_error_in_an_active_flag_counts_8(port: int, rule: int) -> None:
    """TEC or REC; a receiver counts no 1 for it."""
    at = ACK - 1  # CRC delimiter: all notice at once
    outcome = Outcome([flip(at), flip(at + 1 + 2, 1 << port)])
    assert outcome.rules(port)[:2] == [TX_ERROR if port == 0 else RX_ERROR, rule]


@pytest.mark.parametrize(("port", "rule"), [(0, TX_FLAG_BIT), (1, RX_FLAG_BIT)])
def test_bit_error_in_an_overload_flag_counts_8(port: int, rule: int) -> None:
    """The same."""
    outcome = Outcome([flip(EOF[6] + 1), flip(EOF[6] + 4, 1 << port)])
    assert outcome.rules(port)[1] == rule


@pytest.mark.parametrize(("dominant", "counts"), [(13, 0), (14, 1), (21, 1), (22, 2), (30, 3)])
def test_14th_dominant_bit_from_the_start_of_an_active_flag_counts_8_and_each_further_8(
    dominant: int, counts: int
) -> None:
    """Counted from the first bit of the flag."""
    at = ACK - 1
    outcome = Outcome([flip(at), Disruption(DOMINANT, at + 1, at + 1 + dominant)])
    assert outcome.rules(0).count(TX_DOMINANT_RUN) == counts
    assert outcome.rules(1).count(RX_DOMINANT_RUN) == counts


@pytest.mark.parametrize(("dominant", "counts"), [(13, 0), (14, 1), (22, 2)])
def test_8th_dominant_bit_after_a_passive_flag_counts_8(dominant: int, counts: int) -> None:
    """A passive flag is over after 6 equal bits, here 6 dominant ones."""
    at = plain_bit(1)
    outcome = Outcome([flip(at), Disruption(DOMINANT, at + 1, at + 1 + dominant)], tec=128)
    assert outcome.rules(0).count(TX_DOMINANT_RUN) == counts


def test_14th_dominant_bit_counts_in_an_overload_flag_too() -> None:
    """No 8 for the first dominant bit after an overload flag, though."""
    outcome = Outcome([Disruption(DOMINANT, EOF[6] + 1, EOF[6] + 2 + 14)])
    assert outcome.rules(1) == [RX_SUCCESS, RX_DOMINANT_RUN]
    assert outcome.rules(0) == [TX_SUCCESS, TX_DOMINANT_RUN]


def test_controller_at_256_falls_silent_at_once() -> None:
    """Bus-off has no influence on the bus."""
    outcome = Outcome([flip(plain_bit(1))], tec=248)
    assert (outcome.port(0).state, outcome.port(0).tec) == (OFF, 256)


# --- flags, delimiters, end of frame ------------------------------------------------------------------------------


def test_active_error_frame_lasts_flag_delimiter_and_intermission() -> None:
    """All see the error at once: 6 + 8 + 3 bits after the bit that was wrong."""
    outcome = Outcome([flip(ACK + 1)])
    assert outcome.bits == ACK + 2 + 6 + 8 + 3


def test_superposed_flags_last_up_to_12_bits() -> None:
    """One receiver begins; where five dominant bits follow, the others notice only at the sixth."""
    frame = Frame(0x555, bytes(8))
    bits = wire_bits(frame)
    stuff_at = next(at for at in range(19, len(bits)) if bits[at - 5 : at] == [0] * 5)
    sender, receivers = Controller([0], 0, 0), Controller([1, 2], 0, 0)
    sender.send(frame)
    flips = [flip(stuff_at, LOCAL)]
    assert run(split([sender, receivers], flips), flips, 4096) == stuff_at + 1 + 12 + 8 + 3
    at = field_positions(FRAME, "eof")[1]
    assert Outcome([flip(at, LOCAL)]).bits == at + 1 + 7 + 8 + 3  # here the first bit of its flag is a form error


def test_crc_error_flag_begins_after_the_ack_delimiter() -> None:
    """A receiver with a CRC error does not acknowledge, and waits with its flag."""
    bits = wire_bits(FRAME)
    for at in field_positions(FRAME, "crc"):
        if len({*bits[at - 2 : at + 3]}) == 2 and bits[at - 1] != bits[at - 2] and bits[at + 1] != bits[at + 2]:
            outcome = Outcome([flip(at, LOCAL)])
            assert outcome.first(1) == (ACK + 1, CRC_ERROR)
            assert outcome.first(0) == (EOF[0], BIT_RECESSIVE)
            return
    raise AssertionError("no such bit")


@pytest.mark.parametrize("bit", range(6))
def test_error_in_eof_bits_1_to_6_at_one_receiver_makes_the_sender_repeat(bit: int) -> None:
    """Bits 1 to 5 spare nobody; at bit 6 the others have the frame, and get it twice."""
    outcome = Outcome([flip(EOF[bit], LOCAL)])
    assert outcome.port(0).sent_at == -1
    assert outcome.port(1).accepted is None
    assert (outcome.port(2).accepted == FRAME) is (bit == 5)


def test_error_in_the_last_bit_of_eof_at_the_sender_makes_it_repeat_what_all_have() -> None:
    """The sender accepts with bit 7, the receivers with bit 6: a duplicate."""
    outcome = Outcome([flip(EOF[6], SENDER)])
    assert outcome.port(0).sent_at == -1
    assert outcome.rules(0) == [TX_ERROR]
    assert [outcome.port(one).accepted for one in (1, 2, 3)] == [FRAME] * 3


def test_dominant_last_bit_of_eof_at_a_receiver_is_an_overload_not_an_error() -> None:
    """It has accepted the frame; the next one is delayed by an overload frame."""
    outcome = Outcome([flip(EOF[6], LOCAL)])
    assert outcome.port(0).sent_at == EOF[6]
    assert [outcome.port(one).accepted for one in (1, 2, 3)] == [FRAME] * 3
    assert outcome.rules(1) == [RX_SUCCESS]
    assert outcome.bits == EOF[6] + 1 + 7 + 8 + 3


@pytest.mark.parametrize("bit", [1, 2])
def test_dominant_in_intermission_bits_1_and_2_makes_an_overload_frame(bit: int) -> None:
    """No counter changes."""
    outcome = Outcome([flip(EOF[6] + bit)])
    assert outcome.rules(0) == [TX_SUCCESS]
    assert outcome.rules(1) == [RX_SUCCESS]
    assert outcome.bits == EOF[6] + bit + 1 + 6 + 8 + 3


def test_third_overload_in_a_row_is_an_error() -> None:
    """At most two overload frames delay the next frame."""
    first = EOF[6] + 1
    second = first + 6 + 8 + 1
    third = second + 6 + 8 + 1
    two = Outcome([flip(first), flip(second)])
    assert two.rules(1) == [RX_SUCCESS]
    three = Outcome([flip(first), flip(second), flip(third)])
    assert three.rules(1) == [RX_SUCCESS, RX_ERROR]
    assert three.first(1) == (third, FORM_ERROR)


def test_dominant_in_intermission_bit_3_is_a_start_of_frame() -> None:
    """Who sees it receives; nobody sends, so it is a stuff error six bits later."""
    outcome = Outcome([flip(EOF[6] + 3, LOCAL)])
    assert outcome.bits == FRAME.measure()
    waiting = outcome.port(1)
    assert waiting.may_join
    for at in range(6):
        waiting.step(1000 + at, 1)
    assert waiting.found[-1].kind == STUFF_ERROR


def test_node_with_a_frame_takes_that_start_for_its_own() -> None:
    """It goes on with the first bit of its id."""
    waiting = Outcome([flip(EOF[6] + 3, LOCAL)]).port(1)
    waiting.send(FRAME)
    sent = []
    for at, bit in enumerate(wire_bits(FRAME)[1:]):
        sent.append(waiting.out)
        waiting.step(at, bit)
    assert sent == wire_bits(FRAME)[1:]


def test_dominant_eighth_bit_of_a_delimiter_is_an_overload() -> None:
    """Earlier ones are form errors."""
    at = ACK + 1
    delimiter = at + 1 + 6
    assert Outcome([flip(at), flip(delimiter + 7)]).rules(1) == [RX_ERROR]
    assert Outcome([flip(at), flip(delimiter + 6)]).rules(1)[:2] == [RX_ERROR, RX_ERROR]


def test_passive_receiver_disturbs_nobody() -> None:
    """Its flag is recessive: the frame passes, it alone does not have it."""
    outcome = Outcome([flip(plain_bit(1), LOCAL)], rec=128)
    assert outcome.port(0).sent_at == EOF[6]
    assert outcome.port(1).accepted is None
    assert outcome.port(2).accepted == FRAME
    assert outcome.port(1).idle_in > 0  # not at rest yet when the others may go on


def test_dominant_seen_during_a_passive_flag_is_no_bit_error() -> None:
    """The flags of the others."""
    outcome = Outcome([flip(plain_bit(1))], tec=128)
    assert outcome.rules(0) == [TX_ERROR]


# --- what gets through --------------------------------------------------------------------------------------------


FLIPS = [
    (Frame(0x280, bytes.fromhex("E016C19493A4765C")), (43, 96), "E016C5CA49D23B2E"),
    (Frame(0x490, bytes.fromhex("3DBA5F2D1E90B86D")), (25, 90), "34DD2F968F485C36"),
    (Frame(0x78C, bytes.fromhex("43ABB74C3E0476FB")), (57, 84), "43ABB74C3A023B7F"),
    (Frame(0x1CE, bytes.fromhex("82C8D12E6A209D81")), (58, 79), "82C8D12E68013B45"),
]
"""Found by `python -m benchmarks.double_flips --frames 2500`."""


@pytest.mark.parametrize(("frame", "pair", "wrong"), FLIPS)
def test_double_flip_at_one_receiver_can_pass_with_wrong_data(frame: Frame, pair: tuple[int, int], wrong: str) -> None:
    """Stuffing shifts what the CRC covers; the sender is acknowledged and knows nothing."""
    assert wrong_frame(frame, pair) == Frame(frame.can_id, bytes.fromhex(wrong))


def test_enumeration_of_a_frame_finds_its_pair_and_no_other() -> None:
    """All pairs of bits of one frame."""
    frame, pair, _ = FLIPS[0]
    bits = len(wire_bits(frame))
    assert pairs_of(frame) == (bits * (bits - 1) // 2, [pair])


@pytest.mark.parametrize(("frame", "pair", "wrong"), FLIPS)
def test_double_flip_that_all_see_is_caught_by_the_sender(frame: Frame, pair: tuple[int, int], wrong: str) -> None:
    """It costs time, not data."""
    sender, receivers = Controller([0], 0, 0), Controller([1, 2], 0, 0)
    sender.send(frame)
    run([sender, receivers], [flip(at) for at in pair], 4096)
    assert sender.sent_at == -1
    assert receivers.accepted is None


@pytest.mark.long
def test_single_flips_at_one_receiver_are_all_caught() -> None:
    """100,000 random flips SOF..CRC of random 8-byte frames: no other frame is ever accepted."""
    rng = np.random.default_rng(20)
    wrong = 0
    for _ in range(1000):  # a receiver stops at its first error, so this takes a few seconds
        frame = Frame(int(rng.integers(0x800)), rng.bytes(8))
        bits = [*wire_bits(frame), 1, 0, 1, *[1] * 7]
        for flipped in rng.integers(0, len(bits) - 10, 100).tolist():
            receiver = Controller([1], 0, 0)
            for at, bit in enumerate(bits):
                receiver.step(at, 1 - bit if at == flipped else bit)
                if receiver.found:
                    break
            wrong += receiver.accepted is not None and receiver.accepted != frame
    assert wrong == 0
