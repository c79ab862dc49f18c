"""The last lines of `make test`: how many tests passed, how many were skipped, and why.

    python -m tests.summary --failed "lint vcan" build/reports/unit.xml ...

Reads the JUnit files that the recipes have pytest write; exit 1 when one is missing or tells of a failure, and when a
recipe failed.
"""

import argparse
import sys
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from benchmarks.compile_core import no_compiler
from tests.parity.patience import BUSY

WIDTH: Final = 240
"""Characters of a reason; the recipe that ran the test has printed all of it."""


def summarise(reports: list[Path], no_compiled_build: str | None, failed: Sequence[str] = ()) -> tuple[list[str], bool]:
    """The lines, and whether all went well.

    no_compiled_build: why there is none, None when there is; failed: the recipes that did.
    """
    passed = 0
    reasons: Counter[str] = Counter()
    problems = [f"make {recipe} failed" for recipe in failed]
    for report in reports:
        try:
            cases = list(ET.parse(report).iter("testcase"))
        except (OSError, ET.ParseError) as error:
            problems.append(f"{report}: no report of a pytest run ({error}); run `make {report.stem}` again")
            continue
        for case in cases:
            skipped = case.find("skipped")
            if skipped is not None:
                reasons[" ".join(skipped.get("message", "").split())] += 1
            elif case.find("failure") is not None or case.find("error") is not None:
                problems.append(f"{report}: {case.get('name')} failed")
            else:
                passed += 1
    if no_compiled_build is not None:
        reasons[f"compiled build: {no_compiled_build}"] += 1
    busy = sum(count for reason, count in reasons.items() if reason.startswith(BUSY))
    lines = [f"make test: {passed} passed, {reasons.total()} skipped, {busy} of them because the machine was too busy"]
    for reason, count in sorted(reasons.items(), key=lambda item: (-item[1], item[0])):
        more = " ..." if len(reason) > WIDTH else ""
        lines.append(f"  skipped {count}: {reason[:WIDTH]}{more}")
    return lines + problems, not problems


def main() -> int:
    """Print it."""
    parser = argparse.ArgumentParser(description="the last lines of `make test`")
    parser.add_argument("--failed", default="", metavar="RECIPES", help="those that failed, with spaces between them")
    parser.add_argument("reports", nargs="+", type=Path, help="JUnit files")
    given = parser.parse_args()
    lines, is_well = summarise(given.reports, no_compiler(), given.failed.split())
    print("\n".join(lines))
    return 0 if is_well else 1


if __name__ == "__main__":
    sys.exit(main())
