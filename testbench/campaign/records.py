"""What a campaign is made of, as plain data: points, runs that are wanted, runs to be made, runs that were made.

A campaign asks its Plan what is wanted, given what is known, until nothing is: a grid wants everything at once, a
sequential rule and a search look at what came out so far. A plan is a pure function of the finished runs, so that a
campaign resumes by asking again, and comes out the same on one process and on many.
Everything here can be pickled: runs are made in other processes, and on other machines.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from mypy_extensions import mypyc_attr


class Outcome(Enum):
    """What came out of one run, worst last; each run has one.

    not_activated: no fault began; not_manifested: none changed a frame; masked: frames were changed, no limit was
    exceeded; error: a torque or speed beyond its limit; detected_safe: drive or master reacted (EMCY, quick stop,
    heartbeat) and ended the motion before any failure; failure_detected, failure_silent: a joint left its range of
    travel, and by then somebody had reacted to the fault, or nobody had (a reaction after that prevents nothing;
    `RunRow.detected_s` has it all the same); failure: it did, and nobody was there who could have said whether it was
    noticed (foreign parts). No statement about the system: hang: the run did not end in its time;
    invalid: it proves nothing (lost or late frames, a golden run that fails); crashed: its process died.
    """

    NOT_ACTIVATED = "not_activated"
    NOT_MANIFESTED = "not_manifested"
    MASKED = "masked"
    ERROR = "error"
    DETECTED_SAFE = "detected_safe"
    FAILURE_DETECTED = "failure_detected"
    FAILURE_SILENT = "failure_silent"
    FAILURE = "failure"
    HANG = "hang"
    INVALID = "invalid"
    CRASHED = "crashed"


FAILURES: Final = frozenset({Outcome.FAILURE, Outcome.FAILURE_DETECTED, Outcome.FAILURE_SILENT})
"""What `failure` means where a rule, a filter or a share names it."""

NO_STATEMENT: Final = frozenset({Outcome.HANG, Outcome.INVALID, Outcome.CRASHED})
"""Counted apart, never among the runs of which a share is taken."""


UNITS: Final = (("_rad_s", "rad/s"), ("_rad", "rad"), ("_nm", "N m"), ("_deg", "deg"), ("_rpm", "rpm"), ("_s", "s"))
"""How the name of a number ends, and the unit it then has."""

IN_REAL_TIME: Final = "in real time"
"""In the code version of runs that were made against the clock: no run in virtual time stands for one of them."""


@dataclass(frozen=True, slots=True)
class Point:
    """A place on the grid. parameters: (axis, value as the scenario file would say it), in the order of the axes."""

    parameters: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Wanted:
    """Run number `number` (0, 1, ...) of a point."""

    point: Point
    number: int


@dataclass(frozen=True, slots=True)
class RunSpec:
    """One run to be made; it needs no file.

    identity: SHA-256 in hex over scenario, seed, code version and `stop_on`/`grace_s`: the same identity gives the same
    row (but for times). scenario: resolved YAML, seed included. stop_on: outcome that ends a run early ("failure"),
    None for never; grace_s: how much longer it then goes on. keep_traces: whether to write a result folder, "never",
    "failures" or "always"; folder: where. time_limit_s: wall time after which the run counts as hung.
    """

    identity: str
    wanted: Wanted
    seed: int
    scenario: str
    code_version: str
    stop_on: str | None
    grace_s: float
    keep_traces: str
    folder: str
    time_limit_s: float
    fork: bool


@dataclass(frozen=True, slots=True)
class InjectionRow:
    """One activation; times in s from time 0, as in the document of a single run."""

    injector: str
    index: int
    start_s: float
    end_s: float | None
    duration_s: float | None
    frames: int
    signal: str
    cause: str


@dataclass(frozen=True, slots=True)
class RunRow:
    """One run that was made, or given up: hang, invalid, crashed; then metrics are missing and `reason` says why.

    metrics: name -> number, such as "right_knee.rmse_position_rad" (every number of `joints` in the document of a
    single run), without those that could not be measured. first_start_s: first activation; first_phase: gait phase
    there, 0..1 of a stride. activated, injected, manifested: the counts of the document. detected_s: first reaction of
    drive or master at or after first_start_s; detection_latency_s: from first_start_s to it; failure_s: the first
    failure, before detected_s where the reaction came too late. beyond_deg, beyond_s: most that any joint went beyond
    its range of travel (no tolerance), and how long any joint was beyond it, 0 for not at all; beyond_joint: the worst
    one. ended_s: end of the motion that was judged, shorter than it was to be after an early stop.
    errors, failures, failures_at_3deg: number of entries. golden_hash, trace_hash: SHA-256. attempts: how often it was
    tried; started: UTC, ISO 8601; wall_s, cpu_s: of the try that counts; forked_s: simulated time taken over from the
    golden run; machine, versions: where and with what.
    """

    identity: str
    point: Point
    number: int
    seed: int
    outcome: Outcome
    reason: str = ""
    metrics: Mapping[str, float] = field(default_factory=dict)
    first_start_s: float | None = None
    first_phase: float | None = None
    activated: int = 0
    injected: int = 0
    manifested: int = 0
    detected_s: float | None = None
    detection_latency_s: float | None = None
    failure_s: float | None = None
    beyond_deg: float = 0.0
    beyond_s: float = 0.0
    beyond_joint: str = ""
    ended_s: float | None = None
    errors: int = 0
    failures: int = 0
    failures_at_3deg: int = 0
    golden_hash: str = ""
    trace_hash: str = ""
    injections: tuple[InjectionRow, ...] = ()
    attempts: int = 1
    started: str = ""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    forked_s: float = 0.0
    machine: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)


Known = Mapping[Point, Sequence[RunRow]]
"""The finished runs of each point, by rising number; numbers may be missing, points without a run are missing."""


@mypyc_attr(allow_interpreted_subclasses=True)
class Plan:
    """Says which runs a campaign wants."""

    def wanted(self, known: Known) -> list[Wanted]:
        """All runs wanted so far, finished ones included, most urgent first.

        The campaign is over when all of them are known. Must be a function of `known` alone, and judge a batch only
        when all of its runs are known, so that the order in which runs finish changes nothing.
        """
        raise NotImplementedError
