"""docs/paper.md: its campaigns are the paper's, its tables come from stores, and lines of them come out again."""

import itertools
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from testbench.campaign.file.rules import FixedRuns
from testbench.campaign.file.schema import Campaign, load_campaign
from testbench.campaign.making.execute import Workshop, make_run
from testbench.campaign.making.identity import code_version
from testbench.campaign.records import Point, RunRow, Wanted
from testbench.campaign.report.markdown import table_of
from testbench.campaign.report.meta import Meta

ROOT = Path(__file__).resolve().parents[3]
DOCUMENT = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
RECIPE = (ROOT / "Makefile").read_text(encoding="utf-8")
FILES = sorted((ROOT / "campaigns").glob("*.yaml"))
BLOCK = re.compile(r"<!-- campaign results/campaigns/(\S+)\.sqlite: ([^>]*?) -->\n(.*?)<!-- end -->", re.DOTALL)

NOT_RUN = "Not run yet: `make paper`.\n"


def blocks() -> Iterator[tuple[str, str, str]]:
    for found in BLOCK.finditer(DOCUMENT):
        yield found[1], found[2], found[3]


def test_every_table_is_made_by_the_recipe() -> None:
    """No result that a command in the repository does not reproduce: `make paper` makes every store that is named."""
    made = set(re.findall(r"--out \$\$to/(\S+)\.sqlite", RECIPE))
    assert {store for store, _, _ in blocks()} == made
    for path in re.findall(r"run (campaigns/\S+\.yaml) --out", RECIPE):
        assert (ROOT / path).is_file()


@pytest.mark.long
def test_every_campaign_of_the_paper_can_be_run() -> None:
    """Files, scenarios and every point are valid; experiment 1 has the paper's 20 durations, 0.5 s once."""
    campaigns = {path.stem: load_campaign(path) for path in FILES}
    assert set(campaigns) == {path.stem for path in FILES} == {one.name for one in campaigns.values()}
    durations = [dict(point.parameters)["duration"] for point in campaigns["rmse_over_duration"].points]
    assert len(durations) == len(set(durations)) == 20
    assert {"0.05 s", "0.5 s", "0.75 s", "3 s"} <= set(durations)
    assert campaigns["rmse_over_duration"].rule == FixedRuns(30)


def recipe_of(store: str) -> tuple[str, list[str], int | None]:
    """(file, changes of the scenario, runs a point); of the file unless the recipe has `--runs`, None for a search."""
    (line,) = re.findall(rf"run (campaigns/\S+ --out \$\$to/{re.escape(store)}\.sqlite[^;\n]*)", RECIPE)
    words = shlex.split(line)
    options = list(itertools.pairwise(words[1:]))
    rule, asked = load_campaign(ROOT / words[0]).rule, [int(value) for key, value in options if key == "--runs"]
    runs = asked[0] if asked else rule.runs if isinstance(rule, FixedRuns) else None
    return words[0], [value for key, value in options if key == "--set"], runs


@pytest.mark.long
def test_every_table_is_of_all_runs_that_the_recipe_asks_for() -> None:
    """The document shows what `make paper` makes, whole, or says that it was not run."""
    for store, what, text in blocks():
        if text == NOT_RUN:
            continue
        _, _, runs = recipe_of(store)
        if what == "run":
            assert f", {runs} runs a point, seeds 1 to {runs};" in text
        elif runs is not None:
            lines = [line.split("|") for line in text.splitlines() if line.startswith("|")]
            place = [cell.strip() for cell in lines[0]].index("runs")
            assert {line[place].strip() for line in lines[2:]} == {str(runs)}


def about(campaign: Campaign, points: tuple[Point, ...]) -> Meta:
    return Meta(
        name=campaign.name,
        description="",
        file="",
        text="",
        store="",
        axes=campaign.axes,
        points=points,
        rule=campaign.rule,
        asked="",
        wanted=0,
        seed=campaign.seed,
        figures=campaign.figures,
    )


def made_again(campaign: Campaign, point: Point, runs: int) -> list[RunRow]:
    """The first runs of one point."""
    workshop = Workshop()
    wanted = [Wanted(point, number) for number in range(runs)]
    return [make_run(campaign.spec_of(one, code_version(), "", True), workshop) for one in wanted]


@pytest.mark.run
@pytest.mark.parametrize(
    ("store", "values", "what"),
    [("rmse_over_duration-pins", ("0.05 s",), "values 1"), ("compensated", ("single", "0.1 s"), "outcomes")],
)
def test_line_of_the_document_comes_out_again(store: str, values: tuple[str, ...], what: str) -> None:
    """Same seeds, same numbers: the runs of one point, made anew, give the line that stands in the document."""
    path, changes, runs = recipe_of(store)
    campaign = load_campaign(ROOT / path, changes)
    (point,) = (point for point in campaign.points if tuple(text for _, text in point.parameters) == values)
    (table,) = (text for name, words, text in blocks() if (name, words) == (store, what))
    begin = [text.split()[0] for text in values] if what.startswith("values") else [*values]  # unit in their head
    written = _cells(table, begin)
    assert runs is not None
    assert int(written["runs"]) == runs
    rows = made_again(campaign, point, runs)
    again = _cells(table_of(rows, about(campaign, (point,)), what), begin)
    others = written.keys() - again.keys()  # outcomes that other points show
    assert {head: written[head] for head in again} == again
    assert {written[head] for head in others} <= {"0", ""}


def _cells(table: str, begin: list[str]) -> dict[str, str]:
    """Cells by head, of the line whose first cells are `begin`."""
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line.startswith("|")]
    (found,) = (line for line in lines[2:] if line[: len(begin)] == begin)
    return dict(zip(lines[0], found, strict=True))
