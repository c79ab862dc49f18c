"""A golden run as a trunk from which faulted runs branch off.

Until the first activation of a fault, a faulted run is its golden run: injectors that are not active pass every frame
on, unchanged and at once. So the golden run is made once, with a copy of all that moves (nodes, media, plant, what
waits in queues) every SNAPSHOT_NS, and a faulted run starts from the last copy before its first activation, with a
gateway that has its injectors and has seen what the golden run's gateway saw until then.

The first activation is found with the engine itself: a gateway with the injectors is shown the frames of the golden run
at their times and woken when it asks for it; what it sends goes nowhere. Only frames that it looks at are shown
(`Relay.filters`). Fresh injectors are then brought to the instant of the copy in the same way, so that their random
streams, held values and counters stand exactly where those of a straight run would.
Left out, and made straight: wire faults, which change the bus itself from power-up on; a core that is compiled.
"""

import copy
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from canopen_exo.bus import loop
from canopen_exo.bus.frame import Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import MS, NEVER, PASS_ON, Out
from canopen_exo.bus.trace import TraceHash
from fi_gateway.gateway import Gateway
from fi_gateway.injector import Injector
from hlc.node import Sample
from joint_emulators.rack import TruthRow
from testbench.record import RunRecord
from testbench.rig import Rig, RigParams, build_rig
from testbench.run import chunks, record_of

SNAPSHOT_NS: Final = 200 * MS
"""Distance of the copies: whole multiples of the loop's chunks, so that a branch ends where a straight run does."""

MOST_SNAPSHOTS: Final = 64
"""About as many; 0.7 MB each (measured). In a longer run they lie further apart, in multiples of SNAPSHOT_NS."""

CAN_COPY: Final = (loop.__file__ or "").endswith(".py")
"""A core compiled by mypyc cannot be copied yet: its classes cannot be made without their arguments."""

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The rig at `now`, everything up to and including it done, with empty traces.

    frames: that its gateway had received, by port; rows, truth, samples: how many of each the golden run had then;
    digest: of those rows.
    """

    now: int
    rig: Rig
    frames: tuple[int, int]
    rows: int
    truth: int
    samples: int
    digest: TraceHash


class Trunk:
    """A finished golden run. record: of it; end_ns: when it was over, loop's clock; trace_hash: of both buses.

    has_snapshots: whether they were wanted; snapshots: in time order, none where the core is compiled.
    Raises NotStartedError when the motion never began.
    """

    def __init__(self, params: RigParams, with_snapshots: bool) -> None:
        rig = build_rig(params, [])
        digest = TraceHash()
        self.has_snapshots: bool = with_snapshots
        self.snapshots: list[Snapshot] = []
        distance_ns = snapshot_distance(params)
        for now in chunks(rig):
            if with_snapshots and CAN_COPY and now % distance_ns == 0:
                self.snapshots.append(_snapshot(rig, digest, self.snapshots[-1].rows if self.snapshots else 0))
        rig.gateway.finish(rig.loop.now)
        self.record: RunRecord = record_of(rig)
        self.end_ns: int = rig.loop.now
        self._rows: list[Transmission] = self.record.rows
        self._truth: list[TruthRow] = rig.rack.truth
        self._samples: list[Sample] = rig.controller.samples
        self._ends: Indices = np.array([row.end_ns for row in self._rows], dtype=np.int64)
        self._seen: dict[tuple[int, int], Indices] = _seen(rig, self._rows)
        digest.update(self._rows[self.snapshots[-1].rows if self.snapshots else 0 :])
        self.trace_hash: str = digest.hexdigest()

    def first_activation(self, injectors: list[Injector], cycle_ns: int) -> int:
        """When the first window of these injectors opens [ns, loop's clock], NEVER for never; they are used up."""
        return self._show(Gateway(injectors, cycle_ns), self.end_ns, until_active=True)

    def before(self, now: int) -> Snapshot | None:
        """The last snapshot before `now`; None when there is none."""
        at = bisect_left(self.snapshots, now, key=lambda snapshot: snapshot.now)
        return self.snapshots[at - 1] if at else None

    def branch(self, snapshot: Snapshot, injectors: list[Injector]) -> Rig:
        """A rig with these injectors, fresh ones that are not active before, as it is at the snapshot; ready to run."""
        trunk = snapshot.rig
        gateway = Gateway(injectors, trunk.params.plan.cycle_ns)
        self._show(gateway, snapshot.now, until_active=False)
        gateway.frames[:] = snapshot.frames
        rig = copy.deepcopy(trunk, {**_shared(trunk), id(trunk.gateway): gateway})
        for medium in rig.loop.media:
            gateway.join(medium)
        rig.loop.resume(self._rows[: snapshot.rows])
        rig.rack.truth.extend(self._truth[: snapshot.truth])
        rig.controller.samples.extend(self._samples[: snapshot.samples])
        return rig

    def _show(self, gateway: Gateway, end_ns: int, until_active: bool) -> int:
        """Let a gateway see what the golden one saw up to and including `end_ns`; as `first_activation`.

        As in the loop: at one instant the frames come first, then the wake-up.
        """
        now = 0
        for index in self._looked_at(gateway, end_ns):
            row = self._rows[index]
            if row.end_ns > now:
                if gateway.wake_at < row.end_ns:
                    _wake(gateway, now, row.end_ns - 1, until_active)
                now = row.end_ns
            if until_active and gateway.records:
                break
            gateway.receive(now, row.bus, row.frame, _NOWHERE)
        if not (until_active and gateway.records):
            _wake(gateway, now, end_ns, until_active)
        return min((one.start_ns for one in gateway.records), default=NEVER)

    def _looked_at(self, gateway: Gateway, end_ns: int) -> Iterator[int]:
        """The rows up to and including `end_ns` that a gateway does more with than pass them on.

        Which these are is known from the first frame on, which may be power-up for some injectors.
        """
        first = min(int(at[0]) for at in self._seen.values())
        if self._ends[first] <= end_ns:
            yield first
        wanted = [at for (port, can_id), at in self._seen.items() if gateway.filters[port][can_id] != PASS_ON]
        indices = np.sort(np.concatenate(wanted))
        yield from indices[(indices > first) & (self._ends[indices] <= end_ns)].tolist()


def _wake(gateway: Gateway, now: int, until: int, until_active: bool) -> None:
    """Wake it as often as it asks for, up to and including `until`, or to its first activation. now: the time it is."""
    while gateway.wake_at <= until and not (until_active and gateway.records):
        now = max(now, gateway.wake_at)
        gateway.wake(now, _NOWHERE)


def snapshot_distance(params: RigParams) -> int:
    """How far apart the copies of such a golden run lie [ns]."""
    return max(1, -(-(params.stride_ns + params.duration_ns) // (MOST_SNAPSHOTS * SNAPSHOT_NS))) * SNAPSHOT_NS


class _Nowhere(Out):
    """Where the frames of a replay go."""

    def send(self, port: int, frame: Frame) -> None:
        """Nobody hears it."""


_NOWHERE: Final = _Nowhere()


def _snapshot(rig: Rig, digest: TraceHash, hashed: int) -> Snapshot:
    """A copy of the rig as it is. digest: of the first `hashed` rows; brought up to date."""
    rows = rig.loop.trace
    digest.update(rows[hashed:])
    truth, samples = rig.rack.truth, rig.controller.samples
    left: dict[int, object] = {id(truth): [], id(samples): [], id(rig.gateway): rig.gateway}
    twin = copy.deepcopy(rig, {**_shared(rig), **left})
    twin.loop.forget()
    to_drives, to_controller = rig.gateway.frames
    return Snapshot(
        rig.loop.now, twin, (to_drives, to_controller), len(rows), len(truth), len(samples), digest.copy()
    )


def _shared(rig: Rig) -> dict[int, object]:
    """What copies share, as `copy.deepcopy` wants it said: what nobody changes."""
    return {id(rig.params): rig.params, id(rig.params.plan): rig.params.plan}


def _seen(rig: Rig, rows: list[Transmission]) -> dict[tuple[int, int], Indices]:
    """Which rows the gateway has received, of classical 11-bit data frames: by port and CAN id."""
    found: dict[tuple[int, int], list[int]] = {}
    own = [_own_number(rig, bus) for bus in range(2)]
    for index, row in enumerate(rows):
        frame = row.frame
        if frame.flags == 0 and row.sender != own[row.bus]:
            found.setdefault((row.bus, frame.can_id), []).append(index)
    return {key: np.array(indices, dtype=np.int64) for key, indices in found.items()}


def _own_number(rig: Rig, bus: int) -> int:
    """The number of the gateway's port on a bus. Its port k is on bus k (`rig.build_rig`)."""
    ports = (rig.controller_bus, rig.drive_bus)[bus].ports
    return next(port.number for port in ports if port.node is rig.gateway)
