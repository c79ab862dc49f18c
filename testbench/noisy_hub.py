"""The buses of `exo-hil hub --errors`: what can go wrong there, and the noise that makes it.

The fault room makes disturbances and the hub knows none, so they meet here.
"""

import zlib

import numpy as np

from canopen_exo.bus.disturbance import Disturbance
from canopen_exo.bus.hub_core import MakeBus, SharedBus
from canopen_exo.bus.hub_errors import ErrorBus
from canopen_exo.bus.node import SECOND
from fi_gateway.wire_faults import BitErrorRate


def bus_maker(rate: float | None, seed: int) -> MakeBus:
    """Makes timed buses with errors. rate: flips per bit, None: no noise; one random stream per bus name."""

    def make(name: str, index: int, bitrate: int, now: int) -> SharedBus:
        disturbances: list[Disturbance] = []
        if rate is not None:
            rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
            noise = BitErrorRate(rate, SECOND // bitrate, rng)
            noise.begin(now)
            disturbances.append(noise)
        return ErrorBus(name, index, bitrate, disturbances)

    return make
