"""The last lines of `make test`: how many tests passed, how many were skipped, and why.

Read from the JUnit files that the recipes have pytest write; all is not well when one is missing or tells of a failure,
and when a recipe failed.
"""

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

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
