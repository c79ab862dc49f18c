"""Fault types: what comes out of the gateway instead of the frame that came in, one small class each.

value: a wrong value computed from the right one; hold: a kept or given one; bits: single bits; loss: lost frames;
passage: the right frames at the wrong time; forgery: frames that nobody sent like this. The classes of message errors
are those of EN 50159:2010. Wire faults (error frames, bus-off) need the emulated medium and are not here.
"""

from fi_gateway.faults.base import Fault, with_payload
from fi_gateway.faults.bits import BitFlip, BitStuck, distinct_bits
from fi_gateway.faults.forgery import CorruptDlc, Insert, Masquerade
from fi_gateway.faults.hold import StuckAt, StuckAtPayload, StuckAtValue, TimeDelay
from fi_gateway.faults.loss import BurstDrop, Drop
from fi_gateway.faults.passage import Delay, Duplicate, Replay, Resequence
from fi_gateway.faults.value import (
    Bias,
    Drift,
    Gain,
    NoiseFault,
    NormalNoise,
    RelativeNoise,
    UniformNoise,
    ValueFault,
)

__all__ = [
    "Bias",
    "BitFlip",
    "BitStuck",
    "BurstDrop",
    "CorruptDlc",
    "Delay",
    "Drift",
    "Drop",
    "Duplicate",
    "Fault",
    "Gain",
    "Insert",
    "Masquerade",
    "NoiseFault",
    "NormalNoise",
    "RelativeNoise",
    "Replay",
    "Resequence",
    "StuckAt",
    "StuckAtPayload",
    "StuckAtValue",
    "TimeDelay",
    "UniformNoise",
    "ValueFault",
    "distinct_bits",
    "with_payload",
]
