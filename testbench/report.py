"""Plots of a judged pair of runs, as PNG: the joint at fault in detail, all joints at a glance, who started whom.

Units are the table's (deg, rpm, N m). The golden run is a broad pale line and the faulted run a narrow dark one on
top, so that both can be seen where they are equal. Drawn without a display and without pyplot's global state.
"""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from canopen_exo.bus.node import NEVER
from fi_gateway.trigger_specs import TriggerSpec
from hlc.limits import JointLimits
from testbench.chain_figure import CHAIN_PLOT, chain_figure
from testbench.golden import clip
from testbench.record import Array, RunRecord, Truth, motion_rows
from testbench.store import Writer
from testbench.verdict import Judgement

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FAULT_PLOT: Final = "fault.png"
JOINTS_PLOT: Final = "joints.png"

_GOLDEN: Final = "#7fb2e5"
_FAULTED: Final = "#9e1b32"
_REFERENCE: Final = "#222222"
_COMMAND: Final = "#8a8a8a"
_WINDOW: Final = "#f3c55b"
_WINDOW_EDGE: Final = "#d99a1c"  # so that a window of one frame is seen too
_MOST_LANES: Final = 12
_LIMIT: Final = "#555555"
_RPM: Final = 30 / np.pi


@dataclass(frozen=True, slots=True)
class Plotted:
    """What the plots show. title: scenario and seed; limits: by joint name; triggers: by the injector they start."""

    title: str
    joints: tuple[str, ...]
    limits: Mapping[str, JointLimits]
    golden: RunRecord
    faulted: RunRecord
    judgement: Judgement
    triggers: Mapping[str, TriggerSpec] = field(default_factory=dict)


def plot_files(shown: Plotted) -> dict[str, Writer]:
    """File name -> writer of every plot, for the result folder."""
    files: dict[str, Writer] = {
        FAULT_PLOT: lambda path: save(fault_figure(shown), path),
        JOINTS_PLOT: lambda path: save(joints_figure(shown), path),
    }
    if shown.triggers:
        activations = shown.faulted.activations
        files[CHAIN_PLOT] = lambda path: save(chain_figure(shown.triggers, activations, shown.title), path)
    return files


def save(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG, the same bytes for the same figure."""
    figure.savefig(path, format="png", dpi=110, metadata={"Software": None})


def joint_at_fault(shown: Plotted) -> str:
    """The joint whose signal was hit first; without one, the joint farthest from the golden run."""
    for activation in shown.faulted.activations:
        joint = activation.signal.partition(".")[0]
        if joint in shown.joints:
            return joint
    comparison = shown.judgement.comparison
    return max(shown.joints, key=lambda joint: comparison[joint].rmse_position_rad)


def windows(shown: Plotted, joint: str | None = None) -> list[tuple[float, float]]:
    """When faults were active [s], within the motion, overlapping ones joined; of one joint's signals, or of all.

    Faults of frames that are no joint's alone belong to every one.
    """
    found = []
    for one in shown.faulted.activations:
        owner = one.signal.partition(".")[0]
        if joint is None or owner == joint or owner not in shown.joints:
            start = max(0, one.start_ns - shown.faulted.time0_ns)
            end = min(shown.faulted.duration_ns, min(one.end_ns, NEVER) - shown.faulted.time0_ns)
            if start < end:
                found.append((start / 1e9, end / 1e9))
    merged: list[tuple[float, float]] = []
    for start_s, end_s in sorted(found):
        if merged and start_s <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end_s))
        else:
            merged.append((start_s, end_s))
    return merged


def fault_figure(shown: Plotted) -> "Figure":
    """The joint at fault: position, velocity and torque over the motion, and when which injector was active.

    Imports matplotlib.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    joint = joint_at_fault(shown)
    k, limit = shown.joints.index(joint), shown.limits[joint]
    duration_s = shown.faulted.duration_s
    golden, faulted = clip(shown.golden.truth, duration_s), clip(shown.faulted.truth, duration_s)
    said = shown.faulted.commands
    rows = motion_rows(said.t_s, duration_s)
    t_said = said.t_s[rows]
    shares = [6.0, 6.0, 6.0, *([0.4 + 0.8 * len(_laned(shown))] if shown.faulted.activations else [])]
    figure = Figure(figsize=(11, 8.5 + sum(shares[3:]) * 0.4), layout="constrained")
    position, velocity, torque, *rest = figure.subplots(len(shares), 1, sharex=True, height_ratios=shares)
    lanes: Axes | None = rest[0] if rest else None
    low, high = np.degrees(limit.min_angle_rad), np.degrees(limit.max_angle_rad)
    _panel(position, "angle [deg]", (low, high))
    if said.has_reference:
        _refer(position, t_said, np.degrees(said.q_ref[rows, k]))
    _pair(position, golden, faulted, golden.q[:, k], faulted.q[:, k], 180 / np.pi)
    speed = limit.speed_rad_s * _RPM
    _panel(velocity, "speed [rpm]", (-speed, speed))
    if said.has_reference:
        _refer(velocity, t_said, said.dq_ref[rows, k] * _RPM)
    _pair(velocity, golden, faulted, golden.dq[:, k], faulted.dq[:, k], _RPM)
    _panel(torque, "torque [N m]", (-limit.torque_nm, limit.torque_nm))
    # an artist, not a plot: a command of thousands of N m shall not squeeze the torques that acted
    torque.add_artist(Line2D(t_said, said.tau_command[rows, k], color=_COMMAND, lw=0.9, zorder=1.5))
    _pair(torque, golden, faulted, golden.tau[:, k], faulted.tau[:, k], 1.0)
    for axes in (position, velocity, torque):
        _shade(axes, windows(shown, joint))
        axes.set_xlim(0, duration_s)
    if lanes is not None:
        _lanes(lanes, shown)
    (torque if lanes is None else lanes).set_xlabel("time from start of motion [s]")
    one = shown.judgement.comparison[joint]
    _heading(figure, shown, joint.replace("_", " "))
    position.set_title(f"RMSE against golden: {one.rmse_position_rad:.4f} rad", loc="right", fontsize=9)
    velocity.set_title(f"RMSE against golden: {one.rmse_velocity_rad_s:.3f} rad/s", loc="right", fontsize=9)
    torque.set_title(f"RMSE against golden: {one.rmse_torque_nm:.2f} N m", loc="right", fontsize=9)
    _legend(figure, with_reference=said.has_reference, with_command=True, with_windows=bool(windows(shown, joint)))
    return figure


def joints_figure(shown: Plotted) -> "Figure":
    """Angle of every joint over the motion, one side a column. Imports matplotlib."""
    from matplotlib.figure import Figure

    duration_s = shown.faulted.duration_s
    golden, faulted = clip(shown.golden.truth, duration_s), clip(shown.faulted.truth, duration_s)
    said = shown.faulted.commands
    spoken = motion_rows(said.t_s, duration_s)
    rows = (len(shown.joints) + 1) // 2
    figure = Figure(figsize=(12, 2.6 * rows + 1.2), layout="constrained")
    grid = figure.subplots(rows, 2, sharex=True, sharey="row", squeeze=False)
    for spare in grid.flat[len(shown.joints) :]:
        spare.set_visible(False)
    for k, joint in enumerate(shown.joints):
        axes: Axes = grid[k % rows][k // rows]
        limit = shown.limits[joint]
        low, high = np.degrees(limit.min_angle_rad), np.degrees(limit.max_angle_rad)
        _panel(axes, "angle [deg]" if k < rows else "", (low, high))
        if said.has_reference:
            _refer(axes, said.t_s[spoken], np.degrees(said.q_ref[spoken, k]))
        _pair(axes, golden, faulted, golden.q[:, k], faulted.q[:, k], 180 / np.pi)
        _shade(axes, windows(shown, joint))
        axes.set_xlim(0, duration_s)
        axes.set_title(joint.replace("_", " "), loc="left", fontsize=10, fontweight="bold")
        one = shown.judgement.comparison[joint]
        axes.set_title(f"RMSE {one.rmse_position_rad:.4f} rad", loc="right", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("time from start of motion [s]")
    _heading(figure, shown, "joint angles")
    _legend(figure, with_reference=said.has_reference, with_command=False, with_windows=bool(windows(shown)))
    return figure


def _panel(axes: "Axes", label: str, limits: tuple[float, float]) -> None:
    """Grid, label and limit lines; the range follows the limits and everything drawn by `plot`."""
    for limit in limits:
        axes.axhline(limit, color=_LIMIT, lw=1.0, ls="-.", zorder=2)
    axes.margins(x=0, y=0.07)
    axes.set_ylabel(label)
    axes.grid(color="#dddddd", lw=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _refer(axes: "Axes", t_s: Array, values: Array) -> None:
    axes.plot(t_s, values, color=_REFERENCE, lw=1.0, ls=(0, (4, 3)), zorder=4)


def _pair(axes: "Axes", golden: Truth, faulted: Truth, before: Array, after: Array, to_unit: float) -> None:
    axes.plot(golden.t_s, before * to_unit, color=_GOLDEN, lw=4.0, solid_capstyle="round", zorder=2.5)
    axes.plot(faulted.t_s, after * to_unit, color=_FAULTED, lw=1.3, zorder=3)


def _shade(axes: "Axes", spans: list[tuple[float, float]]) -> None:
    for start_s, end_s in spans:
        axes.axvspan(start_s, end_s, facecolor=(_WINDOW, 0.35), edgecolor=_WINDOW_EDGE, lw=0.9, zorder=0)


def _laned(shown: Plotted) -> list[str]:
    """The injectors that get a lane, in the order in which they began."""
    return list(dict.fromkeys(one.injector for one in shown.faulted.activations))[:_MOST_LANES]


def _lanes(axes: "Axes", shown: Plotted) -> None:
    """One lane per injector: its windows, filled where frames came out different, and its three counts."""
    names, faulted = _laned(shown), shown.faulted
    for lane, name in enumerate(names):
        found = [one for one in faulted.activations if one.injector == name]
        for one in found:
            start = max(0, one.start_ns - faulted.time0_ns)
            end = min(faulted.duration_ns, min(one.end_ns, NEVER) - faulted.time0_ns)
            if start < end:
                fill = _WINDOW if one.manifested else "none"
                span = (start / 1e9, (end - start) / 1e9)
                axes.broken_barh([span], (lane - 0.4, 0.45), facecolor=fill, edgecolor=_WINDOW_EDGE, lw=0.9)
        injected = sum(one.frames_injected + one.attempts_disturbed for one in found)
        manifested = sum(one.manifested for one in found)
        counts = f"{len(found)} activated, {injected} injected, {manifested} manifested"
        axes.text(0.004, lane + 0.26, counts, fontsize=7, va="center", transform=axes.get_yaxis_transform())
    axes.set_yticks(range(len(names)), [textwrap.shorten(name, 18, placeholder="...") for name in names], fontsize=7)
    axes.set_ylim(len(names) - 0.5, -0.6)
    axes.grid(axis="x", color="#dddddd", lw=0.6)
    axes.set_axisbelow(True)
    left_out = len({one.injector for one in faulted.activations}) - len(names)
    if left_out:
        axes.set_title(f"and {left_out} more injectors, see injections.csv", loc="right", fontsize=7)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _heading(figure: "Figure", shown: Plotted, subject: str) -> None:
    judgement = shown.judgement
    verdict = "PASS" if judgement.passed else "FAIL"
    title = textwrap.shorten(shown.title, 80, placeholder=" ...")
    figure.suptitle(
        f"{title}: {subject}\nverdict {verdict}, outcome {judgement.outcome.replace('_', ' ')}",
        fontsize=13,
        fontweight="bold",
        parse_math=False,  # a name may hold a dollar sign
    )


def _legend(figure: "Figure", *, with_reference: bool, with_command: bool, with_windows: bool) -> None:
    """One legend below everything, the same entries for every panel."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: list[Line2D | Patch] = [
        Line2D([], [], color=_GOLDEN, lw=4.0, label="golden run"),
        Line2D([], [], color=_FAULTED, lw=1.3, label="faulted run"),
    ]
    if with_reference:
        entries.append(Line2D([], [], color=_REFERENCE, lw=1.0, ls=(0, (4, 3)), label="reference"))
    if with_command:
        entries.append(Line2D([], [], color=_COMMAND, lw=0.9, label="torque command before clamp (may leave the plot)"))
    entries.append(Line2D([], [], color=_LIMIT, lw=1.0, ls="-.", label="limit"))
    if with_windows:
        entries.append(Patch(facecolor=(_WINDOW, 0.35), edgecolor=_WINDOW_EDGE, lw=0.9, label="fault active"))
    figure.legend(handles=entries, loc="outside lower center", ncols=len(entries), frameon=False, fontsize=9)
