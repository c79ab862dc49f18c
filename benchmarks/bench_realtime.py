"""The whole rig in real time on an emulated bus, at 500, 200 and 100 Hz: was it in time, and how late was what.

Four processes (hub, joints, gateway, controller) against the clock, a golden and a faulted run each, as
`exo-hil run --realtime` has them. For information: what a machine reaches depends on its cores and on what else runs.
Late cycles and wake-ups are explained in docs/real_time.md; a run in which more than 1 % of the cycles are late, one by
more than 20 ms, or a frame was lost counts as invalid.

Usage: python benchmarks/bench_realtime.py [--rates HZ[,HZ...]] [--duration S]
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parent.parent
SCENARIO: Final = ROOT / "scenarios" / "golden.yaml"
PATIENCE_S: Final = 120.0


def measure(hertz: int, duration_s: float) -> dict[str, Any] | str:
    """The result document of a run at that rate; what the program said when it gave none."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "testbench.cli", "run", str(SCENARIO), "--realtime", "--json"]
        command += ["--out", f"{folder}/result", "--set", f"rig.rate={hertz} Hz"]
        command += ["--set", f"motion.duration={duration_s:g} s"]
        try:
            done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        except subprocess.TimeoutExpired:
            return f"not done after {PATIENCE_S:g} s"
    try:
        document: dict[str, Any] = json.loads(done.stdout)
    except json.JSONDecodeError:
        lines = done.stderr.strip().splitlines()
        return (lines[-1][:400] if lines else "") or f"exit code {done.returncode}"
    return document


def micros(distribution: dict[str, Any]) -> str:
    """Median, 99 % and worst [us]."""
    values = (distribution[name] / 1000 for name in ("p50_ns", "p99_ns", "worst_ns"))
    return " / ".join(f"{value:.0f}" for value in values)


def print_run(hertz: int, document: dict[str, Any]) -> None:
    """Validity, then one line for each distribution, of the golden run."""
    whole = document["realtime"]
    verdict = "valid" if document["valid"] else "INVALID: " + "; ".join(document["invalid_reasons"])[:300]
    late = [whole[name] for name in ("golden", "faulted")]
    print(
        f"{hertz} Hz: {verdict}; {sum(one['late_cycles'] for one in late)} of {whole['cycles']} cycles late, "
        f"the latest by {max(one['worst_late_ms'] for one in late):.1f} ms"
    )
    for name, distribution in late[0]["lateness"].items():
        if distribution["count"]:
            print(f"  {name:10} woken late by        {micros(distribution):>22} us (median / 99 % / worst)")
    for name, distribution in late[0]["latency"].items():
        print(f"  {'gateway':10} to the {name:10}    {micros(distribution):>22} us added")


def main() -> int:
    """Measure and print; nothing is asserted."""
    parser = argparse.ArgumentParser(description="the rig against the clock at several rates")
    parser.add_argument("--rates", default="500,200,100", help="Hz, those that docs/scenarios.md allows")
    parser.add_argument("--duration", type=float, default=3.0, help="of the motion after time 0, s")
    options = parser.parse_args()
    print(
        f"real time on the hub, {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f} before; "
        f"{options.duration:g} s of motion, golden and faulted run"
    )
    for text in options.rates.split(","):
        found = measure(int(text), options.duration)
        if isinstance(found, str):
            print(f"{text} Hz: INVALID: it gave nothing to judge: {found}", flush=True)
        else:
            print_run(int(text), found)
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
