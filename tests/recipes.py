"""All parts of `make test`, whatever fails on the way, and then its last lines.

    python -m tests.recipes MAKE REPORTS

Each part is a recipe of the Makefile. In User Mode Linux the tests on vcan have one processor, and it is emulated:
where there is another one, lint and the compiled build take their time on that. Everywhere else the rigs on vcan want
the machine for themselves, like those on the hub.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Final

from benchmarks.compile_core import no_compiler
from tests.summary import summarise
from tests.vcan import uml

ON_ONE: Final = ("lint", "compile")
"""Take one processor."""

ON_ALL: Final = ("unit", "runs", "realtime")
VCAN: Final = "vcan"

REPORTED: Final = (*ON_ALL, VCAN)
"""Those that leave a JUnit file."""


def can_be_beside() -> bool:
    """Whether the tests on vcan and what takes one processor do not disturb each other."""
    return (os.cpu_count() or 1) > 1 and not uml.native_vcan_available()


def run_all(make: str, log: Path, beside: bool) -> list[str]:
    """The recipes that failed. log: where the one that runs beside others writes until it is shown."""
    failed: list[str] = []

    def run(recipe: str) -> None:
        if subprocess.run([make, "--no-print-directory", recipe]).returncode:
            failed.append(recipe)

    if beside:
        with log.open("w+") as written:
            print(f"make {VCAN}: runs beside {' and '.join(ON_ONE)}, and writes to {log}", flush=True)
            command = [make, "--no-print-directory", VCAN]
            with subprocess.Popen(command, stdout=written, stderr=subprocess.STDOUT) as running:
                for recipe in ON_ONE:
                    run(recipe)
            if running.returncode:
                failed.append(VCAN)
            written.seek(0)
            print(written.read(), end="", flush=True)
    for recipe in ON_ALL if beside else (*ON_ONE, *ON_ALL, VCAN):
        run(recipe)
    return failed


def main() -> int:
    """Run and print; the exit code."""
    make, folder = sys.argv[1:]
    reports = Path(folder)
    reports.mkdir(parents=True, exist_ok=True)
    failed = run_all(make, reports / f"{VCAN}.log", can_be_beside())
    lines, is_well = summarise([reports / f"{recipe}.xml" for recipe in REPORTED], no_compiler(), failed)
    print("\n".join(lines))
    return 0 if is_well else 1


if __name__ == "__main__":
    sys.exit(main())
