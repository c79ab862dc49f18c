"""Outcome, detection and severity from hand-made runs."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from canopen_exo.bus.error_frame import write_error_frame
from canopen_exo.bus.frame import FLAG_ERROR, Frame
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.node import ErrorState, PortState
from canopen_exo.bus.realtime import RECEIVED
from fi_gateway.activation import Activation
from hlc.limits import limits_of
from testbench.campaign.making.outcomes import first_reaction, outcome_of, phase_at, severity
from testbench.campaign.records import Outcome
from testbench.record import RigEvent, RunRecord, Truth
from testbench.verdict import Judgement, judge

RunMaker = Callable[..., RunRecord]
ActivationMaker = Callable[..., Activation]

START_S = 3.0
DRIVES_PORT = 5
GATEWAYS_PORT = 0
EMCY_KNEE = 0x85
SYNC_LOST = bytes.fromhex("0087 11 0000000000")
ERROR_GONE = bytes(8)


def row(record: RunRecord, time_s: float, frame: Frame, sender: int = DRIVES_PORT, bus: int = 1) -> Transmission:
    return Transmission(record.time0_ns + round(time_s * 1e9), bus, frame, sender)


def quiet(record: RunRecord, rows: Sequence[Transmission] = (), notes: Sequence[RigEvent] = ()) -> RunRecord:
    """The run with nothing noticed but these."""
    return dataclasses.replace(record, rows=[*record.rows, *rows], notes=list(notes))


def judged(joints: tuple[str, ...], golden: RunRecord, faulted: RunRecord) -> Judgement:
    return judge(joints, {joint: limits_of(joint) for joint in joints}, golden, faulted)


def note(time_s: float, kind: str, text: str = "") -> RigEvent:
    return RigEvent(time_s, "right_knee", kind, text)


@pytest.mark.parametrize(
    ("kind", "text", "counts"),
    [
        ("emcy", "error 8700, error register 11", True),
        ("emcy", "errors gone, error register 00", False),
        ("heartbeat_lost", "", True),
        ("nmt_state", "", True),
        ("reboot", "", True),
        ("drive_stopped", "", True),
        ("still_enabled", "", False),
    ],
)
def test_what_the_controller_notices_is_a_reaction(run_maker: RunMaker, kind: str, text: str, counts: bool) -> None:
    """Every event in which it found something wrong; that all is well again, or slow to end, is none."""
    record = quiet(run_maker(), notes=[note(3.5, kind, text)])
    assert first_reaction(record, START_S) == (3.5 if counts else None)


def bus_off(state: ErrorState) -> Frame:
    can_id, data = write_error_frame(PortState(0, state, 255, 0, "test"))
    return Frame(can_id, data, FLAG_ERROR)


@pytest.mark.parametrize(
    ("frame", "sender", "bus", "counts"),
    [
        (Frame(EMCY_KNEE, SYNC_LOST), DRIVES_PORT, 1, True),
        (Frame(EMCY_KNEE, ERROR_GONE), DRIVES_PORT, 1, False),
        (Frame(EMCY_KNEE, SYNC_LOST), RECEIVED, 1, True),  # by the gateway, in real time
        (Frame(EMCY_KNEE, SYNC_LOST), GATEWAYS_PORT, 1, False),  # forged
        (Frame(EMCY_KNEE, SYNC_LOST), 1, 0, False),  # the same on the other side of the gateway
        (Frame(EMCY_KNEE, SYNC_LOST), 7, 1, False),  # a node that a wire fault has added
        (Frame(EMCY_KNEE, b"\x00"), DRIVES_PORT, 1, False),  # no EMCY at all
        (Frame(0x80, b"\x01"), DRIVES_PORT, 1, False),  # SYNC
        (Frame(0x705, b"\x05"), DRIVES_PORT, 1, False),
        (bus_off(ErrorState.BUS_OFF), DRIVES_PORT, 1, True),
        (bus_off(ErrorState.ERROR_PASSIVE), DRIVES_PORT, 1, False),
        (bus_off(ErrorState.BUS_OFF), GATEWAYS_PORT, 1, False),
    ],
)
def test_a_drive_reacts_by_emcy_or_bus_off(
    run_maker: RunMaker, frame: Frame, sender: int, bus: int, counts: bool
) -> None:
    """Only what the drives themselves said, on their own bus."""
    record = run_maker()
    record = quiet(record, rows=[row(record, 3.25, frame, sender, bus)])
    assert first_reaction(record, START_S) == (3.25 if counts else None)


def test_the_first_reaction_counts_whoever_it_is_and_none_before_the_fault(run_maker: RunMaker) -> None:
    """detected_s: first reaction of drive or master at or after first_start_s."""
    record = run_maker()
    early = row(record, 2.999, Frame(EMCY_KNEE, SYNC_LOST))
    record = quiet(record, [early, row(record, 3.4, Frame(EMCY_KNEE, SYNC_LOST))], [note(3.6, "reboot")])
    assert first_reaction(record, START_S) == 3.4
    assert first_reaction(record, 3.4) == 3.4, "in the very instant of the activation"
    assert first_reaction(record, 3.5) == 3.6


def test_a_reaction_after_the_motion_is_none(run_maker: RunMaker) -> None:
    """Reactions count to the end of the motion that is judged."""
    record = dataclasses.replace(quiet(run_maker(), notes=[note(3.5, "reboot")]), duration_ns=3_499_000_000)
    assert first_reaction(record, START_S) is None


@pytest.mark.parametrize(
    ("detected_after_failure_s", "expected"),
    [(None, Outcome.FAILURE_SILENT), (0.001, Outcome.FAILURE_SILENT), (0.0, Outcome.FAILURE_DETECTED),
     (-0.05, Outcome.FAILURE_DETECTED)],
)  # fmt: skip
def test_a_failure_is_detected_when_somebody_reacted_by_then(
    joints: tuple[str, ...],
    run_maker: RunMaker,
    activation_maker: ActivationMaker,
    detected_after_failure_s: float | None,
    expected: Outcome,
) -> None:
    """A reaction that comes only after the limit was exceeded prevents nothing."""
    golden, faulted = run_maker(), run_maker(bump_rad=1.5, activations=[activation_maker()])
    judgement = judged(joints, golden, faulted)
    failed_s = judgement.failures[0].time_s
    detected_s = None if detected_after_failure_s is None else failed_s + detected_after_failure_s
    assert outcome_of(judgement, "plant", detected_s) is expected
    assert outcome_of(judgement, "bus", detected_s) is Outcome.FAILURE, "nobody there can say more"


@pytest.mark.parametrize(
    ("bump_rad", "completed", "activated", "manifested", "reason", "expected"),
    [
        (0.0, True, False, False, "", Outcome.NOT_ACTIVATED),
        (0.0, True, True, False, "", Outcome.NOT_MANIFESTED),
        (0.01, True, True, True, "", Outcome.MASKED),
        (0.01, False, True, True, "", Outcome.DETECTED_SAFE),
        (0.45, True, True, True, "", Outcome.ERROR),
        (1.5, True, True, True, "frames lost", Outcome.INVALID),
    ],
)
def test_each_other_outcome(
    joints: tuple[str, ...],
    run_maker: RunMaker,
    activation_maker: ActivationMaker,
    bump_rad: float,
    completed: bool,
    activated: bool,
    manifested: bool,
    reason: str,
    expected: Outcome,
) -> None:
    """One outcome a run, the worst that holds."""
    one = activation_maker()
    if not manifested:
        one.frames_changed = 0
    faulted = run_maker(
        bump_rad=bump_rad, activations=[one] if activated else [], invalid_reasons=[reason] if reason else []
    )
    faulted = dataclasses.replace(faulted, completed=completed)
    assert outcome_of(judged(joints, run_maker(), faulted), "plant", None) is expected


def still(q_deg: Sequence[float]) -> Truth:
    """The right knee at these angles, a sample a millisecond; the other joints well inside."""
    q = np.tile(np.radians([10.0, -30.0, 0.0, 10.0, -30.0, 0.0]), (len(q_deg), 1))
    q[:, 4] = np.radians(q_deg)
    return Truth(np.arange(len(q_deg)) / 1000, q, np.zeros_like(q), np.zeros_like(q))


@pytest.mark.parametrize(
    ("q_deg", "beyond_deg", "beyond_s", "joint"),
    [
        ((-30, 0, -90, -30), 0.0, 0.0, ""),
        ((-30, 2, 5, -30), 5.0, 0.002, "right_knee"),
        ((-100, -30, 1, -30), 10.0, 0.002, "right_knee"),
    ],
)
def test_severity_is_the_most_beyond_the_range_and_the_time_beyond_it(
    joints: tuple[str, ...], q_deg: Sequence[float], beyond_deg: float, beyond_s: float, joint: str
) -> None:
    """Degrees beyond range, time beyond; an angle that equals its limit is inside."""
    limits = {name: limits_of(name) for name in joints}
    found = severity(joints, limits, still(q_deg), 0.003)
    assert (round(found.beyond_deg, 9), found.beyond_s, found.joint) == (beyond_deg, beyond_s, joint)


def test_time_beyond_counts_once_when_two_joints_are_beyond(joints: tuple[str, ...]) -> None:
    """Time during which any joint is beyond its range; the worse one is named."""
    truth = still((-30, 2, 2, -30))
    truth.q[1:3, 1] = np.radians(7.0)
    found = severity(joints, {name: limits_of(name) for name in joints}, truth, 0.003)
    assert (round(found.beyond_deg, 9), found.beyond_s, found.joint) == (7.0, 0.002, "left_knee")


def test_severity_ends_with_the_motion(joints: tuple[str, ...]) -> None:
    """Only what lies in [0, ended_s]."""
    limits = {name: limits_of(name) for name in joints}
    assert severity(joints, limits, still((-30, -30, 9, 9)), 0.001).beyond_deg == 0.0


@pytest.mark.parametrize(("time_s", "phase"), [(None, None), (-0.1, None), (0.0, 0.0), (0.75, 0.5), (3.3, 0.2)])
def test_phase_is_the_share_of_the_stride(time_s: float | None, phase: float | None) -> None:
    """Gait phase at the first activation, from stride time; there is none before time 0."""
    found = phase_at(time_s, 1.5)
    assert found == phase if phase is None else found == pytest.approx(phase, abs=1e-9)
