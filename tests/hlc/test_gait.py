"""The recorded gait and its Fourier series."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hlc.errors import HlcError
from hlc.gait import COLUMNS, Gait, Recording, packaged_recording, parse_recording, read_recording

NAMES = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
STRIDE_NS = 1_500_000_000
PHASES = np.linspace(0.0, 1.0, 400, endpoint=False)
HEADER = ",".join(COLUMNS)


@pytest.fixture(scope="module")
def gait() -> Gait:
    return Gait(STRIDE_NS, NAMES, packaged_recording())


def csv(rows: list[str]) -> str:
    return "\n".join(["# a comment", HEADER, *rows]) + "\n"


def closed(percents: list[float]) -> str:
    return csv([f"{percent},20,-10,0" for percent in percents])


def test_packaged_recording_is_whole_and_says_where_it_is_from() -> None:
    """CC BY 4.0: the attribution stays with the data."""
    recording = packaged_recording()
    assert recording.percent.tolist() == list(range(101))
    assert recording.angles_rad.shape == (101, 3)
    assert "Fukuchi" in recording.source
    assert "CC BY 4.0" in recording.source


def test_series_goes_through_the_recording(gait: Gait) -> None:
    """Seven harmonics hold the recording, smoothed with seven, to 0.001 deg: twice the half of its last decimal."""
    recording = packaged_recording()
    fitted = gait.q(recording.percent / 100)[:, 3:]
    assert np.rad2deg(np.abs(fitted - recording.angles_rad)).max() < 0.001
    assert np.rad2deg(gait.residual_rad).max() < 0.001


def test_residual_is_the_largest_distance_from_the_recording() -> None:
    """Fewer harmonics, larger residual, reported per joint in output order."""
    recording = packaged_recording()
    coarse = Gait(STRIDE_NS, ("right_knee", "left_hip"), recording, harmonics=2)
    distance = np.abs(coarse.q(recording.percent / 100)[:, 0] - recording.angles_rad[:, 1]).max()
    assert coarse.residual_rad[0] == pytest.approx(distance, rel=1e-9)
    assert coarse.residual_rad[0] > np.deg2rad(2)


def test_known_angles_come_back_in_rad_with_their_signs(gait: Gait) -> None:
    """Rows of the file: 0 % hip 20.173, knee -2.038, ankle 2.105 deg; order left leg, right leg."""
    at_strike = np.rad2deg(gait.q(np.array([0.0]))[0])
    assert at_strike[3:] == pytest.approx([20.173, -2.038, 2.105], abs=0.001)
    half_later = np.rad2deg(gait.q(np.array([0.5]))[0])
    assert half_later[:3] == pytest.approx([20.173, -2.038, 2.105], abs=0.001)


def test_left_leg_is_half_a_stride_later(gait: Gait) -> None:
    """q_left(p) = q_right(p - 1/2), in angle, velocity and acceleration."""
    for of in (gait.q, gait.dq, gait.ddq):
        assert of(PHASES)[:, :3] == pytest.approx(of(PHASES - 0.5)[:, 3:], abs=1e-11)


@pytest.mark.parametrize("strides", [1.0, -1.0, 1000.0])
def test_gait_is_periodic(gait: Gait, strides: float) -> None:
    """Phase counts strides; whole ones change nothing (1e-9: rounding of the phase times 2 pi 7 after 1000 strides)."""
    assert gait.q(PHASES + strides) == pytest.approx(gait.q(PHASES), abs=1e-9)


def test_derivatives_are_those_of_the_angles(gait: Gait) -> None:
    """Central differences; their error is h^2/6 times the third derivative, below 1e-6 of these at h = 1e-5 strides."""
    h = 1e-5
    span = 2 * h * STRIDE_NS * 1e-9
    assert (gait.q(PHASES + h) - gait.q(PHASES - h)) / span == pytest.approx(gait.dq(PHASES), abs=1e-5)
    assert (gait.dq(PHASES + h) - gait.dq(PHASES - h)) / span == pytest.approx(gait.ddq(PHASES), abs=1e-4)


def test_mean_is_the_mean(gait: Gait) -> None:
    """The series' constant term: exact for equally spaced phases."""
    assert gait.q(PHASES).mean(axis=0) == pytest.approx(gait.mean(), abs=1e-12)


def test_a_slower_stride_scales_velocity_and_acceleration(gait: Gait) -> None:
    """Twice the time: half the velocity, a quarter of the acceleration, the same angles."""
    slow = Gait(2 * STRIDE_NS, NAMES, packaged_recording())
    assert slow.q(PHASES) == pytest.approx(gait.q(PHASES), abs=1e-12)
    assert slow.dq(PHASES) == pytest.approx(gait.dq(PHASES) / 2, abs=1e-11)
    assert slow.ddq(PHASES) == pytest.approx(gait.ddq(PHASES) / 4, abs=1e-11)


def test_speeds_and_angles_stay_inside_the_limits(gait: Gait) -> None:
    """About 21.8, 44.9, 26.2 rpm (2 %: those were measured on a plant that follows it); knee never beyond 0."""
    rpm = np.abs(gait.dq(PHASES)).max(axis=0) * 30 / np.pi
    assert rpm[3:] == pytest.approx([21.8, 44.9, 26.2], rel=0.02)
    assert rpm[:3] == pytest.approx(rpm[3:], rel=1e-9)
    degrees = np.rad2deg(gait.q(PHASES))
    assert degrees[:, 4].max() < -1.8
    assert degrees.min() > -90


@pytest.mark.parametrize("stride_ns", [0, -1])
def test_a_stride_takes_time(stride_ns: int) -> None:
    """Stride time above 0."""
    with pytest.raises(HlcError, match="stride time"):
        Gait(stride_ns, NAMES, packaged_recording())


@pytest.mark.parametrize("harmonics", [0, 8])
def test_harmonics_are_bounded(harmonics: int) -> None:
    """1..7."""
    with pytest.raises(HlcError, match=r"allowed 1\.\.7"):
        Gait(STRIDE_NS, NAMES, packaged_recording(), harmonics)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "f.csv:1:1: columns none given"),
        ("# only comments\n", "f.csv:1:1: columns none given"),
        ("percent,hip_deg\n0,1\n", "f.csv:1:1: columns percent,hip_deg given, allowed percent,hip_deg,knee_deg,ankle"),
        (csv([]), "f.csv:1:1: percent: nothing given"),
        (csv(["0,1,2"]), "f.csv:3:1: row: 3 values given, allowed 4"),
        (csv(["0,1,2,x"]), "f.csv:3:7: ankle_deg: 'x' given, allowed a number from -180 to 180"),
        (csv(["0,nan,2,3"]), "f.csv:3:3: hip_deg: 'nan' given"),
        (csv(["0,1,inf,3"]), "f.csv:3:5: knee_deg: 'inf' given"),
        (csv(["0,1,181,3"]), "f.csv:3:5: knee_deg: '181' given"),
        (csv(["-1,1,2,3"]), "f.csv:3:1: percent: '-1' given, allowed a number from 0 to 100"),
        (closed([0, 5, 10]), "f.csv:5:1: percent: 0 to 10 given, a recording goes from 0 to 100"),
        (closed([1, *range(5, 101, 5)]), "percent: 1 to 100 given"),
        (closed([0, *range(10, 101, 5)]), "f.csv:4:1: percent: 10 after 0 given, allowed are rising values less than"),
        (closed([0, 5, 5, *range(10, 101, 5)]), "f.csv:5:1: percent: 5 after 5 given"),
        (closed([0, 10, 5, *range(10, 101, 5)]), "f.csv:5:1: percent: 5 after 10 given"),
    ],
)
def test_faults_of_a_recording_are_named_with_line_and_column(text: str, message: str) -> None:
    """User files: path:line:col: key: message."""
    with pytest.raises(HlcError) as caught:
        parse_recording(text, "f.csv")
    assert message in str(caught.value)


@pytest.mark.parametrize(("last", "fits"), [("21.0", True), ("19.0", True), ("21.001", False), ("18.999", False)])
def test_a_stride_ends_where_it_starts(last: str, fits: bool) -> None:
    """Closure within 1 deg; the bound itself is allowed."""
    rows = [f"{percent},20,-10,0" for percent in range(0, 100, 5)]
    text = csv([*rows, f"100,{last},-10,0"])
    if fits:
        assert parse_recording(text, "f.csv").percent[-1] == 100.0
    else:
        with pytest.raises(HlcError, match="hip_deg: differs by"):
            parse_recording(text, "f.csv")


def test_all_faults_are_told_at_once() -> None:
    """One message a line."""
    with pytest.raises(HlcError) as caught:
        parse_recording(csv(["0,a,2,3", "5,1,b,3", "10,1,2"]), "f.csv")
    assert [line.split(": ")[0] for line in str(caught.value).splitlines()] == ["f.csv:3:3", "f.csv:4:5", "f.csv:5:1"]


def test_a_users_file_gives_the_same_recording(tmp_path: Path) -> None:
    """Round trip of the packaged numbers through a file with Windows line ends."""
    packaged = packaged_recording()
    rows = [
        ",".join(repr(float(value)) for value in (percent, *np.rad2deg(angles)))
        for percent, angles in zip(packaged.percent, packaged.angles_rad, strict=True)
    ]
    path = tmp_path / "mine.csv"
    path.write_bytes(csv(rows).replace("\n", "\r\n").encode())
    mine = read_recording(path)
    assert mine.name == str(path)
    assert mine.angles_rad == pytest.approx(packaged.angles_rad, abs=1e-14)


@pytest.mark.parametrize("content", [None, b"\xff\xfe"])
def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path, content: bytes | None) -> None:
    """Missing, or not text: the message names the file."""
    path = tmp_path / "gone.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(HlcError, match=r"gone\.csv:1:1: cannot be read"):
        read_recording(path)


@given(st.text() | st.lists(st.text(alphabet="0123456789.,-enaif \n#", max_size=30), max_size=30).map(csv))
def test_any_text_is_a_recording_or_refused(text: str) -> None:
    """No crash on any text."""
    try:
        recording = parse_recording(text, "f.csv")
    except HlcError:
        return
    assert isinstance(recording, Recording)
    assert np.isfinite(recording.angles_rad).all()
