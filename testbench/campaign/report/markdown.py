"""Tables of campaigns in Markdown documents: `python -m testbench.campaign.report.markdown FILE.md`.

A document says where a table stands and of which store it is:

    <!-- campaign results/campaigns/NAME.sqlite: values 2 -->
    (the table)
    <!-- end -->

Words after the colon: `values K` for the numbers of the K-th figure's table, `outcomes`, `critical`, and `run` for how
the campaign was run. Everything between the two lines is written anew from the store; the rest stays as it is.
"""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from testbench.campaign.records import NO_STATEMENT, RunRow
from testbench.campaign.report.meta import Meta
from testbench.campaign.report.plots import values_tables
from testbench.campaign.report.searched import critical_results, critical_table
from testbench.campaign.report.tables import outcome_table
from testbench.campaign.store.archive import contents
from testbench.campaign.store.store import open_store
from testbench.errors import BenchError

_BLOCK: Final = re.compile(r"(<!-- campaign (\S+): ([^>]*?) -->\n).*?(<!-- end -->)", re.DOTALL)


def refreshed(text: str, root: Path) -> str:
    """The document with all its tables written anew. root: what the paths of stores count from.

    Raises StoreError for a store that cannot be read, BenchError for a table there is none of.
    """
    read: dict[str, tuple[list[RunRow], Meta]] = {}

    def block(found: re.Match[str]) -> str:
        begin, path, what, end = found.groups()
        if path not in read:
            store = open_store(root / path)
            try:
                read[path] = contents(store)
            finally:
                store.close()
        return f"{begin}{table_of(*read[path], what)}{end}"

    return _BLOCK.sub(block, text)


def table_of(rows: Sequence[RunRow], meta: Meta, what: str) -> str:
    """One block: `outcomes`, `critical`, `run`, or `values K`; raises BenchError for others."""
    word, _, number = what.partition(" ")
    if word == "outcomes" and not number:
        return outcome_table(rows, meta).markdown()
    if word == "run" and not number:
        return _run(rows, meta)
    if word == "critical" and not number and (results := critical_results(rows, meta)):
        return critical_table(results).markdown()
    if word == "values":
        tables = values_tables(rows, meta)
        if number.isdecimal() and 1 <= int(number) <= len(tables):
            return tables[int(number) - 1].markdown()
        raise BenchError(f"campaign {meta.name}: values {number!r} given; allowed: values 1 to {len(tables)}")
    raise BenchError(f"campaign {meta.name}: {what!r} given; allowed: outcomes, values K, run; critical for a search")


def _run(rows: Sequence[RunRow], meta: Meta) -> str:
    """How it was run, in a sentence; nothing that differs from machine to machine."""
    mute = sum(row.outcome in NO_STATEMENT for row in rows)
    seeds = sorted({row.seed for row in rows})
    span = f"seeds {seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"seed {seeds[0]}" if seeds else "no seed"
    missing = f", {meta.wanted - len(rows)} still missing" if meta.wanted > len(rows) else ""
    return f"{len(rows)} runs{missing}, {meta.asked}, {span}; {mute} without a statement.\n"


def main(arguments: Sequence[str]) -> int:
    """Refresh documents in place; stores count from the working directory."""
    for name in arguments:
        path = Path(name)
        path.write_text(refreshed(path.read_text(encoding="utf-8"), Path()), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
