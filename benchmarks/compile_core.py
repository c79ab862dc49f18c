"""The core, compiled with mypyc, must give the same frames and the same results as the interpreted one.

The packages are copied to build/compiled and the modules of CORE are compiled there, unchanged; then one scenario is
run in both builds, each in a process of its own, and trace hashes and results are compared. Exit 0 equal (or no C
compiler: the reason is printed), 1 different or not compilable, 2 usage.
Leaves out: installing the compiled build; it stays in build/compiled (PYTHONPATH=build/compiled uses it).
"""

import argparse
import hashlib
import importlib.metadata
import json
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import time
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent
BUILD: Final = ROOT / "build" / "compiled"
PACKAGES: Final = ("canopen_exo", "joint_emulators", "hlc", "fi_gateway", "testbench", "dbc")

CORE: Final = (
    "canopen_exo/bus/attempt.py",
    "canopen_exo/bus/bit_engine.py",
    "canopen_exo/bus/bit_stream.py",
    "canopen_exo/bus/bits.py",
    "canopen_exo/bus/confinement.py",
    "canopen_exo/bus/controller.py",
    "canopen_exo/bus/disturbance.py",
    "canopen_exo/bus/error_states.py",
    "canopen_exo/bus/frame.py",
    "canopen_exo/bus/loop.py",
    "canopen_exo/bus/medium.py",
    "canopen_exo/bus/node.py",
    "canopen_exo/bus/recovery.py",
    "canopen_exo/bus/wire.py",
    "canopen_exo/cia402.py",
    "canopen_exo/device.py",
    "canopen_exo/emcy.py",
    "canopen_exo/heartbeat.py",
    "canopen_exo/master.py",
    "canopen_exo/nmt.py",
    "canopen_exo/od.py",
    "canopen_exo/pdo.py",
    "canopen_exo/sdo.py",
    "canopen_exo/signal.py",
    "canopen_exo/sync.py",
    "canopen_exo/write_rules.py",
    "fi_gateway/activation.py",
    "fi_gateway/conditions.py",
    "fi_gateway/distributions.py",
    "fi_gateway/effects.py",
    "fi_gateway/events.py",
    "fi_gateway/faults/base.py",
    "fi_gateway/faults/bits.py",
    "fi_gateway/faults/forgery.py",
    "fi_gateway/faults/hold.py",
    "fi_gateway/faults/loss.py",
    "fi_gateway/faults/passage.py",
    "fi_gateway/faults/value.py",
    "fi_gateway/gateway.py",
    "fi_gateway/injector.py",
    "fi_gateway/on_wire.py",
    "fi_gateway/outlet.py",
    "fi_gateway/passage.py",
    "fi_gateway/phase.py",
    "fi_gateway/repair.py",
    "fi_gateway/trigger.py",
    "fi_gateway/windows.py",
    "fi_gateway/wire_faults.py",
    "hlc/controller.py",
    "hlc/node.py",
    "joint_emulators/drive.py",
    "joint_emulators/motor.py",
    "joint_emulators/rack.py",
    "joint_emulators/sensors.py",
)
"""What runs once per frame, per SYNC or per millisecond."""

INTERPRETED: Final = {
    "*/__init__.py": "holds no code",
    "*/errors.py": "exceptions are raised once",
    "canopen_exo/bus/adapter.py": "real time only, through python-can",
    "canopen_exo/bus/channel.py": "real time only",
    "canopen_exo/bus/error_frame.py": "per error",
    "canopen_exo/bus/hub*.py": "a process of its own, in real time only",
    "canopen_exo/bus/interfaces.py": "runs once, opens interfaces",
    "canopen_exo/bus/lateness.py": "real time only",
    "canopen_exo/bus/losses.py": "real time only: told at the end",
    "canopen_exo/bus/realtime*.py": "real time only: waits for the kernel",
    "canopen_exo/bus/recvmmsg.py": "real time only: one system call, through ctypes",
    "canopen_exo/bus/scheduling.py": "runs once",
    "canopen_exo/bus/socketcan.py": "real time only, mostly system calls",
    "canopen_exo/bus/trace.py": "runs after the run",
    "canopen_exo/dbc.py": "runs once, through cantools",
    "canopen_exo/eds.py": "runs once, through canopen",
    "canopen_exo/plan.py": "frozen dataclasses, read once",
    "canopen_exo/talk.py": "what is printed, for people",
    "fi_gateway/*_specs.py": "files are read once, through pydantic",
    "fi_gateway/fault_specs/*.py": "files are read once, through pydantic",
    "fi_gateway/kinds.py": "files are read once, through pydantic",
    "fi_gateway/addition.py": "injectors are read once, through pydantic",
    "fi_gateway/*control*.py": "called by people and scripts, not per frame",
    "fi_gateway/boundary.py": "files are read once, through pydantic",
    "fi_gateway/chain.py": "drawn once, for people",
    "fi_gateway/doubts.py": "files are judged once",
    "fi_gateway/fiblock_compat.py": "whole arrays, outside of runs",
    "fi_gateway/marked_yaml.py": "files are read once, through PyYAML",
    "fi_gateway/quantity.py": "files are read once",
    "fi_gateway/replay.py": "called once an activation, in replays only",
    "fi_gateway/rng_state.py": "called once an activation",
    "fi_gateway/schema.py": "files are read once, through pydantic",
    "fi_gateway/target.py": "files are read once, through pydantic",
    "fi_gateway/unplaced.py": "complaints about files",
    "hlc/dmp.py": "learning is numpy; two short calls a cycle are not",
    "hlc/dynamics.py": "MuJoCo and numpy, whole arrays",
    "hlc/gait.py": "numpy, whole arrays",
    "hlc/limits.py": "constants",
    "joint_emulators/models/*.py": "text is built once",
    "joint_emulators/plant.py": "one call into MuJoCo a millisecond",
}
"""Modules of the core packages that stay Python, with the reason (patterns as in pathlib's match)."""

COMPARED: Final = ("trace_hash", "verdict", "injections", "joints", "golden", "errors", "failures")
"""Keys of the `run --json` document that must be equal; the others hold times and paths."""

# debug_level 0: no line tables. Contraction to fused multiply-add would change floats where the CPU has it.
COMPILE: Final = """
import sys
from mypyc.build import mypycify
from setuptools import setup
modules = mypycify(["--config-file", sys.argv[1], *sys.argv[2:]], opt_level="3", debug_level="0")
arguments = ["-q", "build_ext", "--inplace"]
setup(name="exo-hil-core", packages=[], py_modules=[], ext_modules=modules, script_args=arguments)
"""
FLAGS: Final = "-ffp-contract=off"

WHERE: Final = """
import importlib, json, sys
print(json.dumps({name: importlib.import_module(name).__file__ for name in sys.argv[1:]}))
"""


def no_compiler() -> str | None:
    """Why C extensions cannot be built here; None when they can."""
    command = os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc"
    compiler = shlex.split(command)[0]
    if shutil.which(compiler) is None:
        return f"the C compiler {compiler!r} is not installed (CC names another one)"
    if not (Path(sysconfig.get_path("include")) / "Python.h").exists():
        return f"Python.h is not in {sysconfig.get_path('include')}: the headers of this Python are not installed"
    return None


def fingerprint() -> str:
    """Of everything the compiled build depends on."""
    digest = hashlib.sha256()
    for part in (sys.version, importlib.metadata.version("mypy"), COMPILE, FLAGS, *CORE):
        digest.update(part.encode() + b"\0")
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def environment(path: Path) -> dict[str, str]:
    """The environment of a build: its packages come first."""
    return {**os.environ, "PYTHONPATH": str(path), "PYTHONDONTWRITEBYTECODE": "1"}


def compile_core() -> bool:
    """Make build/compiled what the sources say; False when mypyc or the C compiler refuses, having said why."""
    stamp = BUILD / "fingerprint"
    wanted = fingerprint()
    if stamp.exists() and stamp.read_text() == wanted:
        print(f"compiled build: up to date in {BUILD.relative_to(ROOT)}")
        return True
    shutil.rmtree(BUILD, ignore_errors=True)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, BUILD / package, ignore=shutil.ignore_patterns("__pycache__"))
    started = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", COMPILE, str(ROOT / "pyproject.toml"), *CORE],
        cwd=BUILD,
        env={**environment(BUILD), "CFLAGS": f"{os.environ.get('CFLAGS', '')} {FLAGS}"},
        check=False,
    )
    if done.returncode:
        print("compiled build: mypyc or the C compiler refused, see above", file=sys.stderr)
        return False
    shutil.rmtree(BUILD / "build", ignore_errors=True)
    stamp.write_text(wanted)
    print(f"compiled build: {len(CORE)} modules in {time.perf_counter() - started:.0f} s")
    return True


def left_interpreted() -> list[str]:
    """Modules of CORE which the compiled build would import as Python."""
    names = [path.removesuffix(".py").replace("/", ".") for path in CORE]
    done = subprocess.run(
        [sys.executable, "-c", WHERE, *names],
        cwd=BUILD,
        env=environment(BUILD),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        return [f"(import failed)\n{done.stderr}"]
    found: dict[str, str] = json.loads(done.stdout)
    return [
        f"{name} ({path})" for name, path in found.items() if path.endswith(".py") or not path.startswith(str(BUILD))
    ]


def run(path: Path, scenario: Path, out: Path) -> dict[str, object]:
    """The JSON document of one run of the build in `path`; raises SystemExit when the run is not valid."""
    shutil.rmtree(out, ignore_errors=True)
    done = subprocess.run(
        [sys.executable, "-m", "testbench.cli", "run", str(scenario), "--json", "--out", str(out)],
        cwd=path,
        env=environment(path),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode not in (0, 1) or not done.stdout.strip():  # a verdict of pass or fail is a run like any other
        raise SystemExit(f"run in {path.relative_to(ROOT.parent)}: exit {done.returncode}, see above")
    document: dict[str, object] = json.loads(done.stdout)
    return document


def differences(interpreted: dict[str, object], compiled: dict[str, object]) -> list[str]:
    """The compared keys whose values differ, or which a document does not have."""
    found = []
    for key in COMPARED:
        if interpreted.get(key) is None or compiled.get(key) is None:
            found.append(f"{key}: missing from a document")
        elif interpreted[key] != compiled[key]:
            found.append(f"{key}: interpreted {interpreted[key]}\n{' ' * len(key)}  compiled    {compiled[key]}")
    return found


def compare(scenario: Path) -> int:
    """Run the scenario in both builds; 0 when the compared keys are equal."""
    interpreted = run(ROOT, scenario, ROOT / "build" / "interpreted-run")
    compiled = run(BUILD, scenario, ROOT / "build" / "compiled-run")
    different = differences(interpreted, compiled)
    for line in different:
        print(f"compiled build: {line}", file=sys.stderr)
    if different:
        return 1
    print(f"compiled build: same frames and results, trace hash {compiled['trace_hash']}")
    for name, document in (("interpreted", interpreted), ("compiled", compiled)):
        print(f"for information: {name} {document.get('x_realtime')} x real time")
    return 0


def main() -> int:
    """Compile, check that it is compiled, then what the arguments ask for."""
    parser = argparse.ArgumentParser(description="compile the core and compare both builds")
    parser.add_argument("scenario", nargs="?", type=Path, default=ROOT / "scenarios" / "knee_freeze.yaml")
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument("--compile-only", action="store_true", help="stop after the compiled modules are imported")
    choice.add_argument("--tests", action="store_true", help="run the packages' tests on the compiled build instead")
    arguments = parser.parse_args()
    reason = no_compiler()
    if reason is not None:
        print(f"compiled build: skipped, {reason}")
        return 0
    if not compile_core():
        return 1
    python = left_interpreted()
    if python:
        print(f"compiled build: not compiled: {', '.join(python)}", file=sys.stderr)
        return 1
    if arguments.compile_only:
        return 0
    if arguments.tests:  # -P: the checkout must not come before the compiled build
        command = [sys.executable, "-P", "-m", "pytest", "--ignore=tests/test_project.py", "-n", "2"]
        command += ["-m", "not realtime", "--ignore=tests/vcan"]  # those take turns with the machine
        return subprocess.run(command, cwd=ROOT, env=environment(BUILD), check=False).returncode
    return compare(arguments.scenario.resolve())


if __name__ == "__main__":
    sys.exit(main())
