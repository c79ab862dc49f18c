"""All parts of `make test`, whatever fails on the way, and then its last lines.

    python -m tests.recipes MAKE REPORTS

Each part is a recipe of the Makefile. In User Mode Linux the tests on vcan have one processor, and it is emulated:
where there is another one, lint and the compiled build take their time on that. Everywhere else the rigs on vcan want
the machine for themselves, like those on the hub.
Ctrl-C ends it when all recipes have heard of it and ended.
"""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final

from benchmarks.compile_core import no_compiler
from tests.summary import summarise
from tests.vcan import uml

ON_ONE: Final = ("lint", "compile")
"""Take one processor."""

ON_ALL: Final = ("unit", "runs", "realtime")
VCAN: Final = "vcan"

REPORTED: Final = (*ON_ALL, VCAN)
"""Those that leave a JUnit file."""

INTERRUPTED: Final = 130


def can_be_beside() -> bool:
    """Whether the tests on vcan and what takes one processor do not disturb each other."""
    return len(os.sched_getaffinity(0)) > 1 and not uml.native_vcan_available()


def run_all(make: str, log: Path, beside: bool) -> list[str]:
    """The recipes that failed. log: where the one that runs beside others writes until it is shown."""
    failed: list[str] = []

    def run(recipe: str) -> None:
        with started(make, recipe) as process:
            pass
        if process.returncode:
            failed.append(recipe)

    if beside:
        print(f"make {VCAN}: runs beside {' and '.join(ON_ONE)}, and writes to {log}", flush=True)
        try:
            with log.open("wb") as output, started(make, VCAN, output) as process:
                for recipe in ON_ONE:
                    run(recipe)
        finally:
            sys.stdout.buffer.write(log.read_bytes())
            sys.stdout.flush()
        if process.returncode:
            failed.append(VCAN)
    for recipe in ON_ALL if beside else (*ON_ONE, *ON_ALL, VCAN):
        run(recipe)
    return failed


@contextmanager
def started(make: str, recipe: str, output: IO[bytes] | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """A recipe that runs meanwhile, and has ended afterwards. output: of both kinds, None for ours."""
    process = subprocess.Popen(
        [make, "--no-print-directory", recipe],
        stdout=output,
        stderr=None if output is None else subprocess.STDOUT,
        env={**os.environ, "MAKEFLAGS": " ".join(flags(os.environ.get("MAKEFLAGS", "").split()))},
    )
    try:
        yield process
        process.wait()
    except KeyboardInterrupt:  # the terminal has told it as well
        process.wait()
        raise
    except BaseException:
        process.terminate()
        process.wait()
        raise


def flags(given: list[str]) -> list[str]:
    """Those of the make that called, without its job server, which is not passed on."""
    return [one for one in given if not one.startswith(("-j", "--jobserver"))]


def end(number: int, _frame: object) -> None:
    """A signal handler."""
    sys.exit(128 + number)


def main() -> int:
    """Run and print; the exit code."""
    make, folder = sys.argv[1:]
    reports = Path(folder)
    shutil.rmtree(reports, ignore_errors=True)
    reports.mkdir(parents=True)
    signal.signal(signal.SIGTERM, end)
    try:
        failed = run_all(make, reports / f"{VCAN}.log", can_be_beside())
    except KeyboardInterrupt:
        return INTERRUPTED
    lines, is_well = summarise([reports / f"{recipe}.xml" for recipe in REPORTED], no_compiler(), failed)
    print("\n".join(lines))
    return 0 if is_well else 1


if __name__ == "__main__":
    sys.exit(main())
