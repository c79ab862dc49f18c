"""The golden runs that tests are compared with: one for each kind of rig, made in lock-step when first asked for."""

from typing import final

from testbench.record import RunRecord
from testbench.rig import RigParams
from testbench.run import rig_params, run_rig
from testbench.scenario import Scenario


@final
class Goldens:
    """Golden runs of a test session."""

    def __init__(self) -> None:
        self._runs: dict[RigParams, RunRecord] = {}

    def of(self, scenario: Scenario) -> RunRecord:
        """The fault-free run of the scenario's rig and motion. Raises NotStartedError."""
        params = rig_params(scenario)
        if params not in self._runs:
            self._runs[params] = run_rig(params, [])[0]
        return self._runs[params]
