"""The pytest plug-in on vcan: a test as a user writes it, in a pytest of its own, on a whole rig of processes."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import pytest

from testbench.plugin.hooks import best_bus
from tests.parity.patience import Late, Patience, told_late
from tests.vcan import uml

HIL: Final = """
from canopen_exo.cia402 import DriveState


def test_a_biased_knee(exo):
    golden = exo.golden  # made before the rig moves
    exo.run_until_motion()
    fault = exo.gateway.inject(
        target={"bus": "to_controller", "node": "right_knee", "signal": "position"},
        fault={"type": "bias", "value": "0.05 rad"},
        duration="0.4 s",
    )
    exo.run_until(lambda: fault.row.manifested > 5, within="2 s")
    exo.run_until(lambda: not fault.is_active, within="2 s")
    assert 0 < exo.deviation("right_knee").rmse_position_rad < 0.1
    assert exo.golden is golden
    exo.send(0x123, b"ab", bus="drive")
    exo.expect(0x123, data=b"ab", within="1 s", bus="controller")
    exo.gateway.inject(target={"bus": "to_drives", "pdo": "RPDO1"}, fault={"type": "drop"})
    exo.expect(0x085, data="50 82 .. .. .. .. .. ..", within="40 cycles")
    exo.run_until(lambda: exo.drives["right_knee"].state is DriveState.SWITCH_ON_DISABLED, within="40 cycles")
"""


@pytest.mark.realtime
def test_a_users_test_runs_on_vcan(tmp_path: Path, patience: Patience) -> None:
    """docs/pytest.md: the words of lock-step mean the same on vcan. A machine that is too busy skips.

    It walks longer than usual: what a test does between two waits takes some seconds in User Mode Linux.
    """
    file = tmp_path / "test_hil.py"
    file.write_text(HIL, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += ["--exo-bus=vcan", "--exo-set=rig.rate=50Hz", "--exo-set=motion.duration=12 s", "--exo-fifo"]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTEST_", "EXO_HIL_"))}

    def attempt() -> Late | None:
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        done = subprocess.run([*command, f"--basetemp={folder}", str(file)], cwd=tmp_path, env=environment,
                              capture_output=True, text=True, timeout=180)
        if done.returncode == 0:
            return None
        late = told_late(done.stdout, 20.0)
        assert late, done.stdout + done.stderr
        return Late("; ".join(late))

    patience.until_punctual(attempt)


def test_auto_is_vcan_while_both_interfaces_are_up() -> None:
    """docs/pytest.md: the best bus that is there; one that is down carries nothing."""
    assert best_bus(1) == ("vcan", "vcan0 and vcan1 can be opened")
    uml.set_link("vcan1", up=False)
    assert best_bus(1) == ("hub", "bus socketcan:vcan1: interface down")
