"""What one interface lost, and where: in the queue before it, at the interface, or before we read.

Plain numbers; who counts them is the real-time loop (`realtime`) and its channels.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Losses:
    """Frames, since the start.

    queue_full: the queue of 64 before the interface had no place; discarded: waited, or could not be sent at once,
    while the interface was bus-off or down; not_taken: the interface (or the hub behind it) did not take them;
    overruns: dropped by kernel or hub before they were read; malformed: read, and no frame.
    """

    queue_full: int = 0
    discarded: int = 0
    not_taken: int = 0
    overruns: int = 0
    malformed: int = 0
