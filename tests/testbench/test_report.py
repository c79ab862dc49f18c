"""Plots: drawn whatever happened, with what the reader needs to know written on them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from PIL import Image

from fi_gateway.activation import Activation
from hlc.limits import limits_of
from testbench.record import RunRecord
from testbench.report import Plotted, fault_figure, joint_at_fault, joints_figure, plot_files, save, windows
from testbench.store import FILES
from testbench.verdict import judge

RunMaker = Callable[..., RunRecord]
ActivationMaker = Callable[..., Activation]

SIX = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
LIMITS = {joint: limits_of(joint) for joint in SIX}


def shown(golden: RunRecord, faulted: RunRecord, title: str = "knee_freeze, seed 2020") -> Plotted:
    return Plotted(title, SIX, LIMITS, golden, faulted, judge(SIX, LIMITS, golden, faulted))


@pytest.fixture
def failed(run_maker: RunMaker, activation_maker: ActivationMaker) -> Plotted:
    hit = [
        activation_maker(),
        activation_maker("zero_velocity", "right_knee.velocity", 3.1, 0.3),
        activation_maker(start_s=5.0, index=1),
    ]
    return shown(run_maker(), run_maker(bump_rad=2.0, activations=hit))


@pytest.mark.long
def test_both_plots_are_written_as_png(tmp_path: Path, failed: Plotted) -> None:
    """Design: plots as PNG in the result folder; an image that opens, large enough to read."""
    files = plot_files(failed)
    assert set(files) <= FILES
    for name, write in files.items():
        write(tmp_path / name)
        with Image.open(tmp_path / name) as image:
            image.load()
            assert image.format == "PNG"
            assert min(image.size) >= 800
            assert np.asarray(image.convert("L")).std() > 10  # not an empty sheet


@pytest.mark.long
def test_same_run_gives_the_same_bytes(tmp_path: Path, failed: Plotted) -> None:
    """Reproducible down to the picture."""
    for name in ("a.png", "b.png"):
        save(joints_figure(failed), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_title_names_scenario_joint_verdict_and_outcome(failed: Plotted) -> None:
    """A plot torn out of its folder still says what it shows."""
    assert fault_figure(failed).get_suptitle() == "knee_freeze, seed 2020: right knee\nverdict FAIL, outcome failure"
    assert joints_figure(failed).get_suptitle().startswith("knee_freeze, seed 2020: joint angles\n")


def test_axes_carry_units_and_both_limits(failed: Plotted) -> None:
    """Labels with units; the limits of table 1 as lines, always inside the picture."""
    *axes, lanes = fault_figure(failed).axes
    assert [one.get_ylabel() for one in axes] == ["angle [deg]", "speed [rpm]", "torque [N m]"]
    assert lanes.get_xlabel() == "time from start of motion [s]"
    for one, limits in zip(axes, ((-90.0, 0.0), (-65.2, 65.2), (-54.9, 54.9)), strict=True):
        drawn = [np.asarray(line.get_ydata()) for line in one.lines]
        levels = sorted(float(values[0]) for values in drawn if values.size == 2)
        assert levels == pytest.approx(limits)
        bottom, top = one.get_ylim()
        assert bottom < limits[0]
        assert limits[1] < top


def test_panels_show_what_the_plant_did_in_table_units(failed: Plotted) -> None:
    """The faulted line is the truth of the faulted run, in deg, rpm and N m."""
    truth = failed.faulted.truth
    expected = (np.degrees(truth.q[:, 4]), truth.dq[:, 4] * 30 / np.pi, truth.tau[:, 4])
    for axes, values in zip(fault_figure(failed).axes[:3], expected, strict=True):
        drawn = [np.asarray(line.get_ydata()) for line in axes.lines]
        assert any(one.shape == values.shape and np.allclose(one, values) for one in drawn)
        assert axes.get_ylim()[1] > values.max()


def lane_bars(axes: Axes) -> list[tuple[float, float, bool]]:
    """Start, end and whether it is filled, of each window drawn in the lanes."""
    bars = []
    for bar in axes.collections:
        (path,) = bar.get_paths()
        ends = np.asarray(path.vertices, np.float64)[:, 0]
        is_filled = np.asarray(bar.get_facecolor()).size > 0
        bars.append((round(float(np.min(ends)), 9), round(float(np.max(ends)), 9), is_filled))
    return bars


def test_every_injector_has_a_lane_with_its_windows_and_counts(failed: Plotted) -> None:
    """faults.md: activated, injected and manifested are three counts; drawn where they belong."""
    lanes = fault_figure(failed).axes[3]
    assert [label.get_text() for label in lanes.get_yticklabels()] == ["freeze_position", "zero_velocity"]
    counts = ["2 activated, 300 injected, 296 manifested", "1 activated, 150 injected, 148 manifested"]
    assert [text.get_text() for text in lanes.texts] == counts
    assert lane_bars(lanes) == [(3.0, 3.3, True), (5.0, 5.3, True), (3.1, 3.4, True)]


def test_attempts_that_a_wire_fault_disturbed_are_counted_as_in_the_document(
    run_maker: RunMaker, activation_maker: ActivationMaker
) -> None:
    """Injected and manifested: attempts to send are what it acts on."""
    one = activation_maker(signal="right_knee.TPDO1@drive")
    one.frames_injected, one.frames_changed, one.attempts_disturbed = 0, 0, 12
    lanes = fault_figure(shown(run_maker(), run_maker(activations=[one]))).axes[3]
    assert [text.get_text() for text in lanes.texts] == ["1 activated, 12 injected, 12 manifested"]


def test_window_that_changed_nothing_is_hollow(run_maker: RunMaker, activation_maker: ActivationMaker) -> None:
    """Activated is not manifested."""
    one = activation_maker()
    one.frames_changed = 0
    lanes = fault_figure(shown(run_maker(), run_maker(activations=[one]))).axes[3]
    assert lane_bars(lanes) == [(3.0, 3.3, False)]


def test_lanes_are_as_many_as_can_be_read(run_maker: RunMaker, activation_maker: ActivationMaker) -> None:
    """More injectors than lanes: the plot says where the others are."""
    hit = [activation_maker(f"injector_{number}") for number in range(20)]
    lanes = fault_figure(shown(run_maker(), run_maker(activations=hit))).axes[3]
    assert len(lanes.get_yticklabels()) == 12
    assert lanes.get_title(loc="right") == "and 8 more injectors, see injections.csv"


def test_run_without_activations_has_no_lanes(run_maker: RunMaker) -> None:
    """An empty strip would say nothing."""
    axes = fault_figure(shown(run_maker(), run_maker())).axes
    assert len(axes) == 3
    assert axes[-1].get_xlabel() == "time from start of motion [s]"


@pytest.mark.long
def test_huge_command_does_not_squeeze_the_torques(failed: Plotted) -> None:
    """The command before the clamp may be thousands of N m; the axis follows the torques that acted."""
    said = failed.faulted.commands
    said.tau_command[1500:1600, 4] = 1e5
    assert fault_figure(failed).axes[2].get_ylim()[1] < 200


def test_each_joint_has_its_panel_one_side_a_column(failed: Plotted) -> None:
    """Six joints, left and right side by side."""
    titles = [axes.get_title(loc="left") for axes in joints_figure(failed).axes]
    assert titles == ["left hip", "right hip", "left knee", "right knee", "left ankle", "right ankle"]


def test_every_joint_shows_reference_golden_and_faulted_run(failed: Plotted) -> None:
    """All six joints: what was wanted, what came without and with faults; the legend says which is which."""
    said, runs = failed.faulted.commands, (failed.golden.truth, failed.faulted.truth)
    figure = joints_figure(failed)
    panels = {axes.get_title(loc="left").replace(" ", "_"): axes for axes in figure.axes}
    for k, joint in enumerate(SIX):
        drawn = [np.asarray(line.get_ydata()) for line in panels[joint].lines]
        for expected in (np.degrees(said.q_ref[:, k]), *(np.degrees(truth.q[:, k]) for truth in runs)):
            assert any(one.shape == expected.shape and np.allclose(one, expected) for one in drawn)
    (legend,) = figure.legends
    labels = [text.get_text() for text in legend.get_texts()]
    assert labels == ["golden run", "faulted run", "reference", "limit", "fault active"]


def test_what_a_foreign_controller_wanted_is_not_shown(failed: Plotted) -> None:
    """It says its commands on the bus, and no reference."""
    nothing = np.zeros((failed.faulted.commands.t_s.size, 0))
    said = replace(failed.faulted.commands, q_ref=nothing, dq_ref=nothing)
    view = replace(failed, faulted=replace(failed.faulted, commands=said))
    for figure, more in ((joints_figure(view), []), (fault_figure(view), ["torque command before clamp"])):
        labels = [text.get_text().partition(" (")[0] for text in figure.legends[0].get_texts()]
        assert labels == ["golden run", "faulted run", *more, "limit", "fault active"]


def test_windows_of_one_joint_are_joined_where_they_overlap(failed: Plotted) -> None:
    """Chained faults shade one span, not two on top of each other."""
    assert windows(failed, "right_knee") == [(3.0, 3.4), (5.0, 5.3)]
    assert windows(failed, "left_knee") == []
    assert windows(failed) == windows(failed, "right_knee")


@pytest.mark.parametrize(
    ("start_s", "duration_s", "expected"),
    [
        (-1.0, 0.5, []),
        (-1.0, 1.5, [(0.0, 0.5)]),
        (6.9, 0.5, [(6.9, 7.0)]),
        (6.0, 1e9, [(6.0, 7.0)]),
        (7.0, 1.0, []),
        (2.0, 1e-9, [(2.0, 2.000000001)]),
    ],
)
def test_windows_are_clipped_to_the_motion(
    run_maker: RunMaker,
    activation_maker: ActivationMaker,
    start_s: float,
    duration_s: float,
    expected: list[tuple[float, float]],
) -> None:
    """Only what lies in 0..duration is shown, also for faults without end."""
    hit = [activation_maker(start_s=start_s, duration_s=duration_s)]
    assert windows(shown(run_maker(), run_maker(activations=hit))) == expected


def test_fault_of_whole_frames_is_shown_at_every_joint(run_maker: RunMaker, activation_maker: ActivationMaker) -> None:
    """Without a signal no joint is named; none may look unharmed."""
    view = shown(run_maker(), run_maker(activations=[activation_maker(signal="")]))
    assert all(windows(view, joint) == [(3.0, 3.3)] for joint in SIX)


def test_joint_at_fault_is_that_of_the_first_signal_hit(run_maker: RunMaker, activation_maker: ActivationMaker) -> None:
    """Else the one farthest from the golden run."""
    hit = [activation_maker(signal=""), activation_maker(signal="left_ankle.velocity")]
    assert joint_at_fault(shown(run_maker(), run_maker(bump_rad=1.0, activations=hit))) == "left_ankle"
    assert joint_at_fault(shown(run_maker(), run_maker(bump_rad=1.0))) == "right_knee"


@pytest.mark.long
@pytest.mark.parametrize("title", ["a $x^ b", "with_$\\bad{", "long " * 80, "Knie, früh"])
def test_any_title_can_be_drawn(tmp_path: Path, run_maker: RunMaker, title: str) -> None:
    """A scenario's description is text, not a formula, and stays on the sheet."""
    short = {"duration_s": 0.2, "start_s": 0.05, "end_s": 0.1}
    figure = joints_figure(shown(run_maker(**short), run_maker(**short), title))
    save(figure, tmp_path / "joints.png")
    assert len(figure.get_suptitle().splitlines()[0]) < 100


@pytest.mark.parametrize("count", [1, 2, 3])
def test_other_numbers_of_joints_are_drawn(run_maker: RunMaker, count: int) -> None:
    """The rig file may have fewer joints; spare panels are hidden."""
    joints = SIX[:count]
    run = run_maker(duration_s=0.2, start_s=0.05, end_s=0.1)
    truth, said = run.truth, run.commands
    cut = replace(
        run,
        truth=replace(truth, q=truth.q[:, :count], dq=truth.dq[:, :count], tau=truth.tau[:, :count]),
        commands=replace(
            said,
            q_ref=said.q_ref[:, :count],
            dq_ref=said.dq_ref[:, :count],
            tau_command=said.tau_command[:, :count],
        ),
    )
    figure = joints_figure(Plotted("x", joints, LIMITS, cut, cut, judge(joints, LIMITS, cut, cut)))
    assert sum(axes.get_visible() for axes in figure.axes) == count
