"""The document of a judged pair of runs, as types: what `exo-hil run --json` prints and summary.json holds.

Times are seconds from time 0. `joints` compares plant truth, never frames.
"""

from typing import NotRequired, TypedDict

from canopen_exo.bus.lateness import LatenessDocument


class BusEntry(TypedDict):
    """One bus over the motion of the faulted run; load 0..1."""

    frames: int
    load: float
    queue_overflows: int


class HashEntry(TypedDict):
    """SHA-256 of both traces."""

    golden: str
    faulted: str


class InjectionEntry(TypedDict):
    """One activation.

    due_s: time drawn, given or triggered; start_s: when the window opened, later only when a value had to come first;
    duration_s: as drawn or given, None for no limit; end_s: None when its window had no end; frames: changed, lost,
    delayed or inserted, and each of these, and attempts disturbed; attempts_*: of wire faults, to send a target frame,
    seen and disturbed; frames_injected: that the fault acted on, of frames_seen target frames;
    frames_unfit: too short to act on; saturated: values cut at the signal's range; first_frame_s: when the first of
    `frames` was hit, first_before and first_after: what it was and became, as in a candump log.
    """

    injector: str
    index: int
    due_s: float
    start_s: float
    duration_s: float | None
    end_s: float | None
    frames: int
    frames_changed: int
    frames_lost: int
    frames_delayed: int
    frames_inserted: int
    frames_injected: int
    frames_seen: int
    frames_unfit: int
    attempts_seen: int
    attempts_disturbed: int
    saturated: int
    signal: str
    cause: str
    first_frame_s: float | None
    first_before: str | None
    first_after: str | None


class CountEntry(TypedDict):
    """activated: windows opened; injected: frames, and attempts to send, that were acted on; manifested: `frames`."""

    activated: int
    injected: int
    manifested: int


class JointEntry(TypedDict):
    """Faulted against golden run, and extremes of the faulted run, over the motion.

    held_cycles: control cycles of the faulted run in which no new sample came in time and the last one was used again.
    """

    rmse_position_rad: float
    rmse_velocity_rad_s: float
    rmse_torque_nm: float
    min_angle_deg: float
    max_angle_deg: float
    max_speed_rpm: float
    max_torque_nm: float
    held_cycles: int


class ViolationEntry(TypedDict):
    """A joint beyond a limit; value and limit in the unit of the kind: N m, rpm, deg."""

    joint: str
    kind: str
    time_s: float
    value: float
    limit: float


class GoldenEntry(TypedDict):
    """The golden run by itself."""

    tracking_rmse_rad: dict[str, float]
    errors: list[ViolationEntry]
    failures: list[ViolationEntry]


class ExpectationEntry(TypedDict):
    """One `expect:` line; found in SI."""

    text: str
    found: float
    met: bool


class EventEntry(TypedDict):
    """Something that happened on the rig in the faulted run."""

    time_s: float
    node: str
    kind: str
    text: str


class RealTimeRunEntry(TypedDict):
    """One real-time run. not_judged: what is foreign, in words; lateness: of wake-ups, by process; latency: added by
    the gateway, by the bus it sent on.
    """

    cycles: int
    late_cycles: int
    worst_late_ms: float
    worst: str
    not_judged: list[str]
    lateness: dict[str, LatenessDocument]
    latency: dict[str, LatenessDocument]


class RealTimeLimitsEntry(TypedDict):
    """Beyond these a real-time run is invalid."""

    late_share: float
    late_worst_ms: float


class RealTimeEntry(TypedDict):
    """How well a real-time pair of runs kept time; counts of both runs together, the worst of both."""

    cycles: int
    late_cycles: int
    worst_late_ms: float
    limits: RealTimeLimitsEntry
    golden: RealTimeRunEntry
    faulted: RealTimeRunEntry


class ReplayEntry(TypedDict):
    """Whether a replay gave the recorded frames again. trace_hash: of the recorded faulted run."""

    trace_hash: str
    same: bool


class Summary(TypedDict):
    """The whole document. power_up_s: the first frame, negative; injectors: of the scenario, switched on and in use;
    source: plant, or bus when foreign drives were on it; realtime: of a real-time run only; replay: of a replay only.
    """

    scenario: str
    seed: int
    valid: bool
    invalid_reasons: list[str]
    verdict: str
    outcome: str
    completed: bool
    sim_time_s: float
    wall_time_s: float
    x_realtime: float
    time0_s: float
    power_up_s: float
    duration_s: float
    tolerance_deg: float
    bus: dict[str, BusEntry]
    trace_hash: HashEntry
    injectors: int
    counts: CountEntry
    injections: list[InjectionEntry]
    joints: dict[str, JointEntry]
    golden: GoldenEntry
    errors: list[ViolationEntry]
    failures: list[ViolationEntry]
    failures_at_3deg: list[ViolationEntry]
    expectations: list[ExpectationEntry]
    events: list[EventEntry]
    source: str
    realtime: NotRequired[RealTimeEntry]
    replay: NotRequired[ReplayEntry]
    versions: dict[str, str]
