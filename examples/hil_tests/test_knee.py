"""Wrong knee angles while the rig walks."""

import pytest

from testbench.plugin.exo import Exo
from testbench.plugin.observer import ControllerState

KNEE_POSITION = {"bus": "to_controller", "node": "right_knee", "signal": "position"}


@pytest.mark.requirement("KNEE-1")
def test_without_a_fault_the_knee_follows_the_golden_run(walking: Exo) -> None:
    """Nothing but a fault moves the rig away from the golden run."""
    walking.run_for("0.5 s")
    assert walking.deviation("right_knee").rmse_position_rad < 0.01


@pytest.mark.requirement("KNEE-2")
@pytest.mark.parametrize("bias", ["-0.05 rad", "0.02 rad", "0.05 rad"])
def test_a_biased_encoder_moves_the_knee_by_no_more_than_the_bias(walking: Exo, bias: str) -> None:
    """The controller follows what it reads, and comes back when the fault is over."""
    fault = walking.gateway.inject(target=KNEE_POSITION, fault={"type": "bias", "value": bias}, duration="0.2 s")
    walking.run_for("0.1 s")
    read = walking.controller.drives["right_knee"].position_rad
    assert read - walking.drives["right_knee"].position_rad == pytest.approx(float(bias.removesuffix(" rad")), abs=0.03)
    walking.run_for("0.4 s")
    assert not fault.is_active
    assert fault.row.manifested > 0
    assert 0.001 < walking.deviation("right_knee").rmse_position_rad < 0.05


@pytest.mark.requirement("KNEE-3")
def test_a_frozen_encoder_is_felt_and_does_not_stop_the_walk(walking: Exo) -> None:
    """A knee encoder that freezes for 0.2 s in the swing throws the knee off the gait; the controller holds on."""
    walking.run_until(lambda: 0.6 < walking.controller.phase < 0.7, within="1.5 s")
    walking.gateway.inject(target=KNEE_POSITION, fault={"type": "stuck_at"}, duration="0.2 s")
    walking.run_for("0.3 s")
    assert walking.deviation("right_knee").rmse_position_rad > 0.01
    assert walking.controller.state is ControllerState.MOTION


@pytest.mark.requirement("KNEE-2")
@pytest.mark.exo(scenario="knee_bias.yaml")
def test_the_bias_of_the_scenario_file_comes_and_goes(exo: Exo) -> None:
    """A fault from a scenario file, at its own time."""
    bias = exo.gateway.injection("bias")
    exo.run_until_motion()
    exo.run_for("0.5 s")
    assert not bias.is_active
    exo.run_until(lambda: bias.is_active, within="0.6 s")
    exo.run_until(lambda: not bias.is_active, within="0.5 s")
    assert bias.row.activated == 1
