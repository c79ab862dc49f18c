"""The report of a campaign: complete in itself, true to the rows, and safe whatever names it is given."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import pytest

from testbench.campaign.file.rules import Until
from testbench.campaign.records import Outcome, RunRow
from testbench.campaign.report.markdown import table_of
from testbench.campaign.report.meta import Meta
from testbench.campaign.report.page import html_text, write_report
from tests.testbench.campaign.made_rows import RMSE, axis, figure, meta, over_duration, point, row

DURATIONS = ("0.1 s", "0.2 s", "0.3 s", "0.4 s", "0.5 s")
PARABOLA = {text: [1 + 2 * x + 3 * x * x] * 3 for text, x in zip(DURATIONS, (0.1, 0.2, 0.3, 0.4, 0.5), strict=True)}
EMPTY = frozenset({"meta", "br", "path", "use", "rect", "line", "col"})


class Page(HTMLParser):
    """Checks that elements close in order, and collects ids, references and text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.attributes: Counter[str] = Counter()
        self.tags: Counter[str] = Counter()
        self.said = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        for name, value in attrs:
            self.attributes[name] += 1
            if name == "id":
                self.ids.append(value or "")
            if name in ("href", "xlink:href", "src"):
                self.references.append(value or "")
            if name in ("aria-labelledby", "aria-describedby"):
                self.references.append(f"#{value}")

    def handle_endtag(self, tag: str) -> None:
        if tag not in EMPTY:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style",):
            self.said += data


def parabola() -> tuple[list[RunRow], Meta]:
    points, rows = over_duration(DURATIONS, PARABOLA)
    wanted = [figure(fit="quadratic", paper=((0.2, 1.5),)), figure("failure")]
    return rows, meta([axis("duration", *DURATIONS)], points, wanted, wanted=len(rows))


def words(rows: Sequence[RunRow], about: Meta) -> str:
    """What the page says, in one line."""
    return " ".join(Page(html_text(rows, about)).said.split())


@pytest.fixture(scope="module")
def page() -> str:
    return html_text(*parabola())


def test_page_needs_nothing_else(page: str) -> None:
    """One self-contained file: no address, no script; references stay on the page, and each leads somewhere."""
    assert "://" not in page
    assert not re.search(r"<(script|link|iframe|img|object)|@import|url\((?!#)", page)
    found = Page(page)
    assert found.open == []
    assert len(found.ids) == len(set(found.ids))
    assert all(reference.startswith("#") for reference in found.references)
    assert {reference[1:] for reference in found.references} <= set(found.ids)


def test_names_from_files_stay_text() -> None:
    """Names, descriptions, reasons, values and the file itself come from users: none of them becomes an element."""
    evil = "<script>alert('1')</script>\"&amp;$x_1$"
    at = point(**{f"{evil}axis": evil})
    about = meta([axis(f"{evil}axis", evil)], [at], name=evil, description=evil, text=evil, store=evil, wanted=1)
    rows = [row(at, 0, Outcome.CRASHED, reason=evil), row(at, 1, Outcome.FAILURE_SILENT, beyond_deg=3)]
    text = html_text(rows, about)
    found = Page(text)
    assert found.tags["script"] == 0
    assert found.said.count(evil) >= 6
    assert text.count("<script") == 0


def test_same_rows_give_the_same_page(page: str) -> None:
    """Reproducible: no clock, no chance."""
    assert html_text(*parabola()) == page


def test_page_fits_phone_and_paper(page: str) -> None:
    """The width of the screen is taken, tables scroll inside their own box, print has rules of its own."""
    assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in page
    assert page.count("<table>") == page.count('<div class="scroll"') == page.count("<caption>")
    assert "@media print" in page
    assert "@media (max-width:" in page


def test_fit_of_runs_on_a_parabola_is_that_parabola() -> None:
    """Hand-made data, y = 1 + 2 x + 3 x^2: equation and R squared as they must be, of the runs and of the means."""
    said = words(*parabola())
    assert "Quadratic fit: y = 1 + 2 x + 3 x²; R² = 1.000 of the runs, 1.000 of the means." in said


def test_numbers_of_a_figure_stand_beside_the_papers() -> None:
    """Mean with interval, median, quartiles, extremes: 1, 2, 6 have mean 3, median 2, quartiles 1.5 and 4.

    Student's t, 2 degrees of freedom: 3 +- 4.303 x 2.646 / sqrt(3).
    """
    points, rows = over_duration(["0.1 s"], {"0.1 s": [1, 6, 2]})
    about = meta([axis("duration", "0.1 s")], points, [figure(paper=((0.1, 2.5),))])
    html = html_text(rows, about)
    cells = re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", html[html.index('id="values"') :].split("</section>")[0])
    assert cells[8:] == ["0.1", "3", "3 (-3.57 to 9.57)", "2", "1.5, 4", "1", "6", "2.5 (inside)"]


def test_median_has_its_interval_beside_that_of_the_mean() -> None:
    """Between smallest and largest of six values (1 - 2/64 = 96.9 %), where one run is far above; none for five."""
    values = [1.0, 2.0, 3.0, 4.0, 5.0, 900.0]
    points, rows = over_duration(["0.1 s", "0.2 s"], {"0.1 s": values, "0.2 s": values[:5]})
    about = meta([axis("duration", "0.1 s", "0.2 s")], points, [figure()])
    html = html_text(rows, about)
    cells = re.findall(r"<td[^>]*>(.*?)</td>", html[html.index('id="values"') :].split("</section>")[0])
    assert (cells[2], cells[8]) == ("3.5 (1 to 900)", "3")
    assert "3.5 (1 to 900)" in table_of(rows, about, "values 1")


@pytest.mark.parametrize(("paper", "said"), [(-3.6, "below"), (-3.5, "inside"), (9.5, "inside"), (9.6, "above")])
def test_published_number_is_said_to_be_inside_or_not(paper: float, said: str) -> None:
    """Against the interval of our mean, -3.57 to 9.57 for 1, 2, 6; so no reader has to compare digits."""
    points, rows = over_duration(["0.1 s"], {"0.1 s": [1, 6, 2]})
    about = meta([axis("duration", "0.1 s")], points, [figure(paper=((0.1, paper),))])
    assert f">{paper:g} ({said})<" in html_text(rows, about)


def test_part_of_an_axis_is_shown_and_fitted_alone() -> None:
    """The paper has two figures over one axis; each has its own fit."""
    points, rows = over_duration(DURATIONS, {**PARABOLA, "0.5 s": [50.0]})
    about = meta([axis("duration", *DURATIONS)], points, [figure(fit="quadratic", span=(0.1, 0.4))])
    said = words(rows, about)
    assert "12 runs, each a dot. Quadratic fit: y = 1 + 2 x + 3 x²" in said


def test_shares_leave_out_what_makes_no_statement_and_say_so() -> None:
    """4 runs, one hangs: 1 of 3 failed, Wilson 95 % 6.1 to 79.2 %."""
    at = point(duration="0.1 s")
    outcomes = (Outcome.MASKED, Outcome.FAILURE_SILENT, Outcome.ERROR, Outcome.HANG)
    rows = [row(at, k, outcome) for k, outcome in enumerate(outcomes)]
    said = words(rows, meta([axis("duration", "0.1 s")], [at], wanted=4))
    assert "4 runs made. 1 of them makes no statement (1 hang) and is in no share below." in said
    assert "1 of 3 runs failed, 33.3 % over all points together." in said
    assert "33.3 % (6.1 to 79.2 %)" in said
    assert "In 2 runs a limit of torque, speed or angle was exceeded." in said


def test_intervals_that_were_asked_for_repeatedly_say_so_where_they_stand() -> None:
    """Rule `until`: beside table and figure of shares; a fixed number of runs has nothing to say."""
    at = point(duration="0.1 s")
    rows = [row(at, k, Outcome.MASKED) for k in range(20)]
    axes, shown, note = [axis("duration", "0.1 s")], [figure("failure")], "cover less often than 95 %"
    until = meta(axes, [at], shown, rule=Until("failure", 0.1, 20, 20, 400))
    assert words(rows, until).count(note) == 2
    assert note not in words(rows, meta(axes, [at], shown))


def test_unfinished_campaign_says_what_is_missing() -> None:
    """A report of a part must not read like one of the whole; one without any run is made, too."""
    rows, about = parabola()
    assert "12 runs made, 3 of 15 still missing." in words(rows[:12], about)
    assert "0 runs made, 15 of 15 still missing." in words([], about)


def test_runs_cut_short_are_told_under_their_numbers() -> None:
    """After an early stop an RMSE covers less of the motion; it must not pass for one of the whole."""
    points, rows = over_duration(["0.1 s"], {"0.1 s": [1.0, 2.0]})
    cut = row(points[0], 2, metrics={RMSE: 3.0}, ended_s=2.5)
    about = meta([axis("duration", "0.1 s")], points, [figure()], motions={points[0]: 7.0})
    assert "1 run ended early: its numbers cover a part of the motion." in words([*rows, cut], about)
    table = table_of([*rows, cut], about, "values 1").splitlines()[0]
    assert table.endswith("in rad (1 run ended early: its numbers cover a part of the motion):")
    assert "ended early" not in words(rows, about)
    assert "1 run ended early" in words([cut], about), "also where no run went to its end"


def test_motions_of_other_length_are_not_cut_short() -> None:
    """An axis over the length of the motion: each run is held against its own point's."""
    points = [point(duration="2 s"), point(duration="7 s")]
    rows = [row(points[k], 0, metrics={RMSE: 1.0}, ended_s=ended) for k, ended in enumerate((2.0, 7.0))]
    about = meta([axis("duration", "2 s", "7 s")], points, [figure()], motions={points[0]: 2.0, points[1]: 7.0})
    assert "ended early" not in words(rows, about)


def test_each_combination_of_the_other_axes_has_its_figure() -> None:
    """Pins on and off are never averaged."""
    axes = [axis("duration", "0.1 s", "0.2 s"), axis("stops", "off", "on")]
    points, rows = [], []
    for stops in ("off", "on"):
        more, made = over_duration(["0.1 s", "0.2 s"], {"0.1 s": [1.0], "0.2 s": [2.0]}, stops=stops)
        points += more
        rows += made
    said = words(rows, meta(axes, points, [figure()]))
    assert "Figure 1. Right knee, position RMSE over duration, stops off." in said
    assert "Figure 2. Right knee, position RMSE over duration, stops on." in said


def test_too_many_combinations_are_taken_together_and_the_figure_says_so() -> None:
    """20 phases are not 20 figures."""
    phases = [f"{k}" for k in range(7)]
    points, rows = [], []
    for phase in phases:
        more, made = over_duration(["0.1 s"], {"0.1 s": [1.0]}, phase=phase)
        points += more
        rows += made
    said = words(rows, meta([axis("duration", "0.1 s"), axis("phase", *phases)], points, [figure()]))
    assert (
        "over duration, all values of phase together. 7 runs, each a dot. Without intervals: runs with the same seeds"
        in said
    )


def test_runs_are_counted_by_the_phase_of_their_first_fault() -> None:
    """Stratification: ten parts of the stride, a run at 100 % is one at 0 %."""
    at = point(duration="0.1 s")
    rows = [
        row(at, 0, Outcome.FAILURE_SILENT, first_phase=0.93, beyond_deg=12.5),
        row(at, 1, first_phase=0.99),
        row(at, 2, first_phase=0.05, activated=3),
        row(at, 3, Outcome.NOT_ACTIVATED, first_phase=None),
    ]
    said = words(rows, meta([axis("duration", "0.1 s")], [at]))
    assert "90 to 100 %2250.0 %12.5" in said  # 2 runs of 2 seeds
    assert "0 to 10 %110.0 %0.0" in said
    assert "there are no intervals here" in said
    assert "In 1 of these 3 runs more than one window of a fault opened." in said


def test_what_matters_is_ranked() -> None:
    """RMSE that follows the duration and nothing else: rank correlation 1, the gait phase explains nothing."""
    points, rows = over_duration(
        DURATIONS, {text: [float(k) + 0.01 * n for n in range(10)] for k, text in enumerate(DURATIONS)}
    )
    said = words(rows, meta([axis("duration", *DURATIONS)], points, [figure()]))
    assert re.search(r"Right knee, position RMSE, 50 runs.*duration5(9\d|100) %0\.9\d", said)


def test_every_shown_run_has_its_command(page: str) -> None:
    """The exact command that replays it."""
    rows, about = parabola()
    codes = [unescape(found) for found in re.findall(r"<code>(exo-hil campaign replay .*?)</code>", page)]
    assert codes
    identities = {one.identity[:12] for one in rows}
    assert all(code.split()[:4] == ["exo-hil", "campaign", "replay", about.store] for code in codes)
    assert {code.split()[4] for code in codes} <= identities


def test_report_of_600_runs_is_small() -> None:
    """Below 1 MB: it can be sent by mail."""
    durations = [f"{0.05 * k:.2f} s" for k in range(1, 21)]
    points, rows = over_duration(
        durations, {text: [0.1 * k * (n + 1) for n in range(30)] for k, text in enumerate(durations)}
    )
    about = meta(
        [axis("duration", *durations)], points, [figure(fit="quadratic"), figure(span=(0, 0.5)), figure("failure")]
    )
    assert len(html_text(rows, about).encode()) < 1_000_000


@pytest.mark.long
def test_both_files_are_written_or_left_alone(tmp_path: Path) -> None:
    """Folders are made; a file that cannot be written leaves the old one as it was and nothing half-written."""
    rows, about = parabola()
    html, junit = tmp_path / "made" / "knee.html", tmp_path / "made" / "knee.xml"
    write_report(rows, about, html, junit)
    assert html.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert junit.read_text(encoding="utf-8").startswith('<?xml version="1.0"')
    assert {path.name for path in html.parent.iterdir()} == {"knee.html", "knee.xml"}
    blocked = tmp_path / "file"
    blocked.write_text("here")
    with pytest.raises(OSError, match="file"):
        write_report(rows, about, blocked / "knee.html", blocked / "knee.xml")


@pytest.mark.long
def test_what_was_changed_from_the_file_is_said_at_the_head() -> None:
    """Published numbers stand beside these; a reader must see that the runs are not those of the file."""
    rows, about = parabola()
    changed = html_text(rows, replace(about, changes=("motion.duration=3s",)))
    assert "Changed from the campaign file: motion.duration=3s." in changed.partition("</header>")[0]
    assert "Changed from" not in html_text(rows, about)
