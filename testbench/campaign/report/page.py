"""The report of a campaign: one HTML file that needs nothing else, and a JUnit file for continuous integration.

What it says comes from the rows of the store and the campaign file alone. Readable on a phone (wide tables scroll by
themselves) and in print.
"""

from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Final

from testbench.campaign.records import NO_STATEMENT, RunRow
from testbench.campaign.report.dependence import phase_section, ranking_section
from testbench.campaign.report.junit import junit_text
from testbench.campaign.report.markup import Html, tag
from testbench.campaign.report.measured import is_search
from testbench.campaign.report.meta import Meta
from testbench.campaign.report.plots import figure_section, values_section
from testbench.campaign.report.searched import search_section
from testbench.campaign.report.sections import headline, notable_runs, outcome_section

_STYLE: Final = "report.css"

Section = tuple[str, str, Html]
"""Anchor, title in the list of contents, content."""


def write_report(rows: Sequence[RunRow], meta: Meta, html_path: Path, junit_path: Path) -> None:
    """Write both files, each as a whole or not at all. May raise OSError. Imports matplotlib."""
    for path, text in ((html_path, html_text(rows, meta)), (junit_path, junit_text(rows, meta))):
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f".{path.name}.unfinished")
        unfinished.write_text(text, encoding="utf-8")
        unfinished.replace(path)


def html_text(rows: Sequence[RunRow], meta: Meta) -> str:
    """The whole page; the same rows and meta give the same text."""
    figures, drawn = figure_section(rows, meta)
    sections: list[tuple[str, str, Html | None]] = [
        ("figures", "Figures", figures),
        ("search", "What was searched", search_section(rows, meta, drawn + 1)),
        ("outcomes", "Outcomes by point", outcome_section(rows, meta)),
        ("values", "Numbers of the figures", values_section(rows, meta)),
        ("phase", "By gait phase", None if is_search(meta) else phase_section(rows)),
        ("ranking", "What matters", None if is_search(meta) else ranking_section(rows, meta)),
        ("runs", "Runs to look at", notable_runs(rows, meta)),
        ("how", "How it was run", _how(rows, meta)),
        ("file", "Campaign file", _file(meta)),
    ]
    there = [(anchor, title, content) for anchor, title, content in sections if content is not None]
    contents = tag("nav", [tag("a", title, href=f"#{anchor}") for anchor, title, _ in there], aria_label="contents")
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("title", f"{meta.name}: campaign report"),
        tag("style", Html(files("testbench.campaign.report").joinpath(_STYLE).read_text(encoding="utf-8"))),
    )
    changed = [tag("p", f"Changed from the campaign file: {', '.join(meta.changes)}.")] if meta.changes else []
    header = tag("header", tag("h1", meta.name), tag("p", meta.description), *changed)
    body = tag("body", header, headline(rows, meta), contents, tag("main", [content for _, _, content in there]))
    return f"<!DOCTYPE html>\n{tag('html', head, body, lang='en')}\n"


def _how(rows: Sequence[RunRow], meta: Meta) -> Html:
    """Versions, seeds, machines, times, and what is not counted."""
    seeds = sorted({row.seed for row in rows})
    mute = sum(row.outcome in NO_STATEMENT for row in rows)
    facts: list[tuple[str, str]] = [
        ("command", meta.command),
        ("runs", f"{meta.asked}; {len(rows)} made, {meta.wanted} wanted, {mute} without a statement"),
        ("seeds", f"campaign {meta.seed}; runs {_span(seeds)}"),
        ("machines", _distinct(row.machine for row in rows)),
        ("processes", str(meta.jobs)),
        ("started, ended", " to ".join(time for time in (meta.started, meta.ended) if time)),
        ("wall time", f"{meta.wall_s:.0f} s; {_times(rows)}"),
        ("golden runs", _hashes(rows)),
        ("versions", _versions(rows, meta)),
        *(("note", note) for note in meta.notes),
    ]
    listed = [part for name, text in facts if text for part in (tag("dt", name), tag("dd", text))]
    return tag("section", tag("h2", "How it was run"), tag("dl", listed), id="how")


def _file(meta: Meta) -> Html:
    return tag(
        "section", tag("h2", "Campaign file"), tag("p", tag("code", meta.file)), tag("pre", meta.text), id="file"
    )


def _times(rows: Sequence[RunRow]) -> str:
    """Work of the runs, and what was taken over from golden runs."""
    wall, cpu, forked = (sum(getattr(row, name) for row in rows) for name in ("wall_s", "cpu_s", "forked_s"))
    taken = f"; {forked:.0f} s of motion were taken over from golden runs" if forked else ""
    return f"the runs alone {wall:.0f} s, {cpu:.0f} s of processor time{taken}"


def _versions(rows: Sequence[RunRow], meta: Meta) -> str:
    """Of everything that was used; several of one thing when runs of several versions are in the store."""
    found: dict[str, set[str]] = {}
    for versions in (meta.versions, *(row.versions for row in rows)):
        for name, version in versions.items():
            found.setdefault(name, set()).add(version)
    return ", ".join(f"{name} {' and '.join(sorted(versions))}" for name, versions in sorted(found.items()))


def _hashes(rows: Sequence[RunRow]) -> str:
    return _distinct(row.golden_hash[:12] for row in rows)


def _distinct(texts: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(text for text in texts if text))


def _span(seeds: Sequence[int]) -> str:
    if not seeds:
        return "none"
    if seeds == list(range(seeds[0], seeds[-1] + 1)) and len(seeds) > 1:
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds[:20])) + (f" and {len(seeds) - 20} more" if len(seeds) > 20 else "")
