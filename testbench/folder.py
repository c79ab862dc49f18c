"""A judged pair of runs as a result folder: logs, traces, summary and plots, whole or not at all."""

from pathlib import Path

from hlc.limits import limits_of
from testbench.report import Plotted, plot_files
from testbench.run import Result
from testbench.store import check_folder, result_files, write_result


def write_folder(folder: Path, result: Result) -> Path:
    """Write the result; returns the folder as it was resolved. Raises BenchError when the place is refused or full."""
    scenario = result.scenario
    check_folder(folder, scenario.name)
    names = tuple(joint.name for joint in scenario.plan.joints)
    limits = {name: limits_of(name) for name in names}
    title = f"{scenario.name}, seed {scenario.seed}"
    files = result_files(scenario.resolved_yaml(), result.document, names, result.golden, result.faulted)
    triggers = {name: spec.trigger for name, spec in scenario.injectors.items() if spec.trigger is not None}
    shown = Plotted(title, names, limits, result.golden, result.faulted, result.judgement, triggers)
    files.update(plot_files(shown))
    return write_result(folder, files)
