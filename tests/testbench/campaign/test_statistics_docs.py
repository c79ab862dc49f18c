"""docs/statistics.md: its examples print what it says."""

import doctest
from pathlib import Path

from testbench.campaign.statistics.shares import clopper_pearson

FILE = Path(__file__).parents[3] / "docs" / "statistics.md"


def test_the_examples_print_what_is_shown() -> None:
    """Every `>>>` of the page, run."""
    text = FILE.read_text(encoding="utf-8").replace("```", "\n")
    examples = doctest.DocTestParser().get_doctest(text, {}, "statistics.md", str(FILE), 0)
    assert len(examples.examples) >= 10
    said: list[str] = []
    assert doctest.DocTestRunner(verbose=False).run(examples, out=said.append).failed == 0, "".join(said)


def test_what_five_runs_are_worth() -> None:
    """The last line of the page."""
    assert round(clopper_pearson(0, 5).high, 2) == 0.52
