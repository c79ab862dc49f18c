"""A result folder as something to run again: its scenario, and the windows in which its faults acted."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from numpy.random import PCG64, Generator

from canopen_exo.bus.node import NEVER
from fi_gateway.errors import FaultError
from fi_gateway.replay import Window
from fi_gateway.rng_state import restore
from testbench.document import ReplayEntry, Summary
from testbench.errors import BenchError
from testbench.injections import INJECTIONS_FILE, read_injections
from testbench.scenario import Scenario, load_scenario
from testbench.store import SCENARIO_FILE, SUMMARY_FILE


@dataclass(frozen=True, slots=True)
class Replay:
    """What is run again.

    windows: by injector, from what its times count from; trace_hash: of the recorded faulted run.
    """

    scenario: Scenario
    windows: Mapping[str, tuple[Window, ...]]
    trace_hash: str

    def entry(self, document: Summary) -> ReplayEntry:
        """What the document of the run says about the replay."""
        return {"trace_hash": self.trace_hash, "same": document["trace_hash"]["faulted"] == self.trace_hash}


def load_replay(folder: Path, overrides: Sequence[str] = ()) -> Replay:
    """The recorded run in a result folder, with `key=value` overrides of its scenario.

    Raises FileErrors for a scenario that cannot be read, BenchError for the rest.
    """
    for name in (SCENARIO_FILE, SUMMARY_FILE, INJECTIONS_FILE):
        if not (folder / name).is_file():
            raise BenchError(f"replay {folder}: there is no {name} in it; give the folder of a result")
    scenario = load_scenario(folder / SCENARIO_FILE, overrides)
    path = folder / SUMMARY_FILE
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        power_up_ns, trace_hash = round(document["power_up_s"] * 1e9), document["trace_hash"]["faulted"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BenchError(f"replay {path}: is no summary of a result: {error!r}") from error
    recorded = read_injections(folder / INJECTIONS_FILE)
    windows = {}
    for name, found in recorded.items():
        spec = scenario.injectors.get(name)
        if spec is None:
            raise BenchError(
                f"replay {folder / INJECTIONS_FILE}: injector {name!r} is not in the scenario beside it; put it there, "
                "or take its rows out"
            )
        try:
            _check_streams(found)
        except FaultError as error:
            raise BenchError(f"replay {folder / INJECTIONS_FILE}: {name}: {error}") from error
        base_ns = power_up_ns if spec.start == "power_up" else 0
        windows[name] = tuple(_from(window, base_ns) for window in found)
    return Replay(scenario, windows, trace_hash)


def _check_streams(windows: tuple[Window, ...]) -> None:
    """Raise FaultError for one that cannot be restored, before anything runs."""
    scratch = Generator(PCG64(0))
    for window in windows:
        if window.stream:
            restore(scratch, window.stream)


def _from(window: Window, base_ns: int) -> Window:
    end_ns = NEVER if window.end_ns >= NEVER else window.end_ns - base_ns
    return Window(window.start_ns - base_ns, end_ns, window.stream, window.skipped)
