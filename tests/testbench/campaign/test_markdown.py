"""Tables in documents: written from stores, and nothing else of the document is touched."""

import pytest

from testbench.campaign.records import Outcome
from testbench.campaign.report.markdown import table_of
from testbench.errors import BenchError
from tests.testbench.campaign.made_rows import axis, figure, meta, over_duration, row


def test_outcomes_and_values_are_tables_of_markdown() -> None:
    """Words to the left, numbers to the right; the paper's number beside ours."""
    points, rows = over_duration(["0.1 s"], {"0.1 s": [1.0, 2.0]})
    about = meta([axis("duration", "0.1 s")], points, [figure(paper=((0.1, 2.5),)), figure("failure")], wanted=3)
    rows.append(row(points[0], 2, Outcome.HANG))
    assert table_of(rows, about, "values 1").splitlines() == [
        "Right knee, position RMSE over duration, in rad:",
        "",
        "| duration [s] | runs | mean | median | quartiles | lowest | highest | the paper |",
        "| --: | --: | --: | --: | --: | --: | --: | --: |",
        "| 0.1 | 2 | 1.5 (-4.85 to 7.85) | 1.5 | 1.25, 1.75 | 1 | 2 | 2.5 (inside) |",
    ]
    assert table_of(rows, about, "outcomes").splitlines()[2:] == [
        "| duration | runs | masked | failed | failed by more than 3 deg | any limit exceeded "
        "| noticed | no statement |",
        "| :-- | --: | --: | --: | --: | --: | --: | :-- |",
        "| 0.1 s | 2 | 2 | 0 % (0 to 65.8 %) | 0 % (0 to 65.8 %) | 0 % (0 to 65.8 %) | 0 | 1 hang |",
    ]
    assert table_of(rows, about, "run") == "3 runs, 3 runs a point, seeds 1 to 3; 1 without a statement.\n"


@pytest.mark.parametrize("what", ["values 2", "values", "critical", "outcome", "outcomes 1"])
def test_table_there_is_none_of_is_refused(what: str) -> None:
    """Says what there is."""
    points, rows = over_duration(["0.1 s"], {"0.1 s": [1.0, 2.0]})
    about = meta([axis("duration", "0.1 s")], points, [figure()])
    with pytest.raises(BenchError, match="allowed:"):
        table_of(rows, about, what)
