"""docs/campaigns.md: its file reads, its queries run, its tables name every column and every option."""

import dataclasses
import re
import sqlite3
from pathlib import Path

import pytest

from testbench.campaign.file.schema import CampaignFile, parse_campaign
from testbench.campaign.store.store import Recipe, open_store
from testbench.cli import main
from tests.testbench.campaign.workers import row_of, spec

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "campaigns.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_the_campaign_shown_reads() -> None:
    """Its scenario is one of the repository; of twelve points the filter leaves ten."""
    (shown,) = blocks("yaml")
    campaign = parse_campaign(shown, str(ROOT / "campaigns" / "shown.yaml"))
    assert len(campaign.points) == 10
    assert len(campaign.figures) == 2


@pytest.mark.parametrize("search", re.findall(r"`(search: \{.*\})`", TEXT.replace("\n", " ").replace("}}` ", "}}`\n")))
def test_searches_shown_read(search: str) -> None:
    """As they stand in the text, with the axis and the injectors they name."""
    (shown,) = blocks("yaml")
    text = re.sub(r"filter: .*\n|report:[^~]*", "", shown).replace("runs: 30", search)
    text = text.replace("[a, b, c]", "[freeze_position, zero_velocity]")
    assert parse_campaign(text, str(ROOT / "campaigns" / "shown.yaml")).rule


def test_queries_shown_run(tmp_path: Path) -> None:
    """On a store with runs, each gives rows."""
    store = open_store(tmp_path / "s.sqlite", write=True)
    for number in range(4):
        given = spec(number, axis="50 ms")
        row = dataclasses.replace(row_of(given), detected_s=1.0, failure_s=0.75)
        point = dataclasses.replace(row.point, parameters=(("duration", "50 ms"),))
        store.runs.append(dataclasses.replace(row, point=point), Recipe("", "1", None, 0.0))
    assert len(blocks("sql")) == 3
    found = [store.database.connection.execute(query).fetchall() for query in blocks("sql")]
    store.close()
    assert found[0] == [(1, 4, 0.5)]
    assert found[1] == [(0.05, pytest.approx(0.375))]
    assert found[2] == [(f"1/{number}", 1.5, 0.25) for number in range(4)]


def columns(path: Path) -> dict[str, list[str]]:
    """Table -> its columns."""
    open_store(path, write=True).close()
    connection = sqlite3.connect(path)
    tables = [name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type IN ('table', 'view')")]
    found = {name: [row[1] for row in connection.execute(f"PRAGMA table_info({name})")] for name in tables}
    connection.close()
    return found


def test_every_table_and_column_is_described(tmp_path: Path) -> None:
    described = set(re.findall(r"`([a-z0-9_]+)`", TEXT[TEXT.index("## The store") :]))
    for table, names in columns(tmp_path / "s.sqlite").items():
        assert table in described
        assert set(names) - described <= {"invocation"}, table


def test_every_key_of_the_file_is_described() -> None:
    names = {"changes": "set", "filters": "filter", "time_limit_ns": "time_limit"}
    for name in CampaignFile.__dataclass_fields__:
        assert f"`{names.get(name, name)}`" in TEXT


def test_every_option_of_run_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["campaign", "run", "--help"])
    for option in re.findall(r"^  (--[a-z-]+)", capsys.readouterr().out, re.MULTILINE):
        assert f"`{option}" in TEXT, option
