"""Looks for pairs of flipped bits that a CAN receiver takes for a valid frame with wrong data.

CRC-15 finds all double errors in the bits it covers, but a flip can make or unmake a stuff bit: then the bits between
the two flips arrive shifted by one, which is an error of many bits. All pairs of bits of random 8-byte frames are tried
(SOF to the last CRC bit), all pairs of a frame at once. What is found is confirmed by the bit engine: the sender is
acknowledged, the receiver has other data. Prints frames and pairs, and their share of all pairs that were tried with
its 95 % interval (Clopper and Pearson; pairs of one frame are taken for independent).

    python -m benchmarks.double_flips [--seed N] [--frames N]
"""

import argparse
import sys
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import stats

from canopen_exo.bus.bit_engine import run, split
from canopen_exo.bus.bit_stream import BASE_HEADER, CRC_BITS, STUFF_AFTER, wire_bits
from canopen_exo.bus.bits import CRC_POLYNOMIAL
from canopen_exo.bus.controller import Controller
from canopen_exo.bus.disturbance import FLIP, Disruption
from canopen_exo.bus.frame import Frame

Bits = npt.NDArray[np.int64]

_UNKNOWN: Final = 1 << 20
_LIMIT: Final = 4096


def accepted(rows: Bits) -> npt.NDArray[np.bool_]:
    """Which rows of bits, each SOF..CRC of a base frame as seen, end exactly there with a right CRC and stuffing."""
    count, length = rows.shape
    last, run_length = np.ones(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    taken, head, crc = (np.zeros(count, dtype=np.int64) for _ in range(3))
    total = np.full(count, _UNKNOWN, dtype=np.int64)
    alive = np.ones(count, dtype=np.bool_)
    for at in range(length):
        seen = rows[:, at]
        is_stuff = run_length == STUFF_AFTER
        alive &= np.where(is_stuff, seen != last, taken < total)
        run_length = np.where(~is_stuff & (seen == last), run_length + 1, 1)
        last = seen
        shifted = (crc << 1 & 0x7FFF) ^ np.where(crc >> 14 != seen, CRC_POLYNOMIAL, 0)
        crc = np.where(is_stuff, crc, shifted)
        head = np.where(is_stuff, head, head << 1 | seen) & 0x7FFFF
        taken += ~is_stuff
        begins = (taken == BASE_HEADER) & ~is_stuff
        if begins.any():
            alive &= ~begins | (head >> 5 & 1 == 0)  # IDE: it would be an extended frame
            size = np.where(head >> 6 & 1, 0, np.minimum(head & 15, 8))
            total = np.where(begins, BASE_HEADER + 8 * size + CRC_BITS, total)
    right: npt.NDArray[np.bool_] = alive & (taken == total) & (run_length < STUFF_AFTER) & (crc == 0)
    return right


def pairs_of(frame: Frame) -> tuple[int, list[tuple[int, int]]]:
    """How many pairs there are, and those that a receiver accepts with other content."""
    bits = np.array(wire_bits(frame), dtype=np.int64)
    first, second = np.triu_indices(len(bits), 1)
    rows = np.tile(bits, (len(first), 1))
    at = np.arange(len(first))
    rows[at, first] ^= 1
    rows[at, second] ^= 1
    found = [(int(first[k]), int(second[k])) for k in np.flatnonzero(accepted(rows))]
    return len(first), [pair for pair in found if wrong_frame(frame, pair) is not None]


def wrong_frame(frame: Frame, pair: tuple[int, int]) -> Frame | None:
    """What one of two receivers accepts when it alone sees this pair of bits flipped; None when nothing wrong."""
    sender = Controller([0], 0, 0)
    sender.send(frame)
    flips = [Disruption(FLIP, at, at + 1, 1 << 1) for at in pair]
    controllers = split([sender, Controller([1, 2], 0, 0)], flips)
    run(controllers, flips, _LIMIT)
    if sender.sent_at < 0:
        return None
    for controller in controllers:
        if controller.ports == [1] and controller.accepted is not None and controller.accepted != frame:
            return controller.accepted
    return None


def main() -> int:
    """Search and print; 0 whatever was found."""
    parser = argparse.ArgumentParser(description="double bit flips that CAN's checks do not catch")
    parser.add_argument("--seed", type=int, default=1, help="of the random frames (default 1)")
    parser.add_argument("--frames", type=int, default=2000, help="random 8-byte frames to try (default 2000)")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    tried = hits = 0
    for _ in range(arguments.frames):
        frame = Frame(int(rng.integers(0x800)), rng.bytes(8))
        count, found = pairs_of(frame)
        tried += count
        hits += len(found)
        for pair in found:
            print(f"{frame!r} bits {pair[0]} and {pair[1]}: accepted as {wrong_frame(frame, pair)!r}")
    low, high = stats.binomtest(hits, tried).proportion_ci(0.95, method="exact")
    print(f"{hits} of {tried} pairs: {hits / tried:.2g} ({low:.2g} to {high:.2g})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
