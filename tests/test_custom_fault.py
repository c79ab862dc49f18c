"""examples/custom_fault: a fault type from another package is read, checked, said and run like a built-in one."""

import copy
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

from canopen_exo.bus.frame import Frame
from fi_gateway.faults import Fault
from tests.fi_gateway.faults.bench import ODD, OUT, POSITION, begun, joint, values

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "examples" / "custom_fault"
SCENARIO = PACKAGE / "coarse_encoder.yaml"


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(PACKAGE))
    return import_module("exo_quantise.faults")


def exo_hil(path: Path, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The command line, with `path` where Python looks for packages."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTEST_", "PYTHON"))}
    return subprocess.run(
        [sys.executable, "-m", "testbench.cli", *arguments],
        cwd=cwd,
        env={**environment, "PYTHONPATH": str(path), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.mark.parametrize(
    ("step", "value", "out", "saturated"),
    [(100, 0, 0, 0), (100, 49, 0, 0), (100, 50, 100, 0), (100, 149, 100, 0), (100, -50, 0, 0), (100, -51, -100, 0),
     (2**30, 2**31 - 1, 2**31 - 1, 1)],
)  # fmt: skip
def test_the_fault_rounds_to_its_step(module: ModuleType, step: int, value: int, out: int, saturated: int) -> None:
    """out = step x floor(in / step + 1/2); what does not fit saturates and is counted, as in every ValueFault."""
    fault: Fault = begun(module.Quantise(POSITION, step))
    assert values(fault.apply(0, joint(value, 7), OUT)) == (out, 7)
    assert fault.saturated == saturated


def test_the_fault_can_be_copied(module: ModuleType) -> None:
    """Snapshots copy it with what it has counted."""
    fault: Fault = begun(module.Quantise(ODD, 1500))
    fault.apply(0, Frame(0x185, ODD.write(bytes(8), 1023)), OUT)
    twin = copy.deepcopy(fault)
    assert twin.saturated == fault.saturated == 1
    assert twin.apply(0, joint(2**20, 7), OUT) == fault.apply(0, joint(2**20, 7), OUT)


@pytest.mark.long
def test_the_scenario_is_said_in_words(tmp_path: Path) -> None:
    """`exo-hil check` with a dotted path."""
    done = exo_hil(PACKAGE, "check", str(SCENARIO), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "position of right_knee (0x185, to_controller) known only in steps of 3 deg for 0.5 s" in done.stdout


@pytest.mark.long
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("step: 3 deg", "step: 3", "9:59: injectors.coarse_position.fault.step: position of right_knee: 3 has no"),
        ("step: 3 deg", "step: 0.004 deg", "fault.step: 0.004 deg is less than 2 counts of 4.79e-05 rad each"),
        ("step: 3 deg", "stp: 3 deg", "fault.stp: QuantiseSpec has no such key; did you mean 'step'?"),
        ("step: 3 deg", "step: [3]", "fault.step: expected a value with its unit"),
        ("exo_quantise.faults", "exo_quantize.faults", "fault.type: cannot import 'exo_quantize.faults'"),
        ("QuantiseSpec", "Quantise", "'exo_quantise.faults.Quantise' is no fault for files: it must be a class"),
        ("QuantiseSpec", "Coarse", "fault.type: 'exo_quantise.faults' has no 'Coarse'"),
        ("exo_quantise.faults.QuantiseSpec", "quantise", "fault.type: unknown fault 'quantise'"),
    ],
)
def test_mistakes_are_found_as_in_built_in_types(tmp_path: Path, old: str, new: str, message: str) -> None:
    """path:line:col, key, what is wrong and what is allowed; exit code 2."""
    bad = tmp_path / "bad.yaml"
    bad.write_text(SCENARIO.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    done = exo_hil(PACKAGE, "check", "bad.yaml", cwd=tmp_path)
    assert done.returncode == 2, done.stdout
    assert message in done.stderr


@pytest.mark.run
def test_the_scenario_runs(tmp_path: Path) -> None:
    """The fault acts, and the resolved scenario in the result folder names it and runs again to the same traces."""
    hashes = []
    for file, out in ((str(SCENARIO), "first"), ("first/scenario.yaml", "second")):
        done = exo_hil(PACKAGE, "run", file, "--json", "--out", out, cwd=tmp_path)
        assert done.returncode in (0, 1), done.stderr
        document = json.loads(done.stdout)
        assert [one["injector"] for one in document["injections"]] == ["coarse_position"]
        assert document["injections"][0]["frames"] > 200
        hashes.append(document["trace_hash"])
    assert hashes[0] == hashes[1]
    assert hashes[0]["golden"] != hashes[0]["faulted"]


@pytest.mark.long
def test_an_installed_package_is_found_by_its_short_name(tmp_path: Path) -> None:
    """Entry point in the group exo_hil.faults: check, list of types in messages, and JSON Schema."""
    place = tmp_path / "place"
    pip = ["install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", str(place)]
    done = subprocess.run(
        [sys.executable, "-m", "pip", *pip, str(PACKAGE)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    good, bad = tmp_path / "good.yaml", tmp_path / "bad.yaml"
    text = SCENARIO.read_text(encoding="utf-8").replace("exo_quantise.faults.QuantiseSpec", "quantise")
    good.write_text(text, encoding="utf-8")
    bad.write_text(text.replace("quantise", "quantize"), encoding="utf-8")
    assert "known only in steps of 3 deg" in exo_hil(place, "check", "good.yaml", cwd=tmp_path).stdout
    assert "did you mean 'quantise'?" in exo_hil(place, "check", "bad.yaml", cwd=tmp_path).stderr
    schema = json.loads(exo_hil(place, "export", "schema", cwd=tmp_path).stdout)
    assert '"const": "quantise"' in json.dumps(schema)
