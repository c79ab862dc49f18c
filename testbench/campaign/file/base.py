"""The scenario under a campaign: a file beside it or a part of it, with the changes for every run."""

import os
from collections.abc import Sequence
from typing import cast

from fi_gateway.marked_yaml import (
    Data,
    Document,
    FileErrors,
    Keys,
    Mark,
    apply_override,
    did_you_mean,
    load,
    parse,
    set_value,
)
from fi_gateway.quantity import describe_value
from testbench.campaign.file.axes import Axis, read_settings
from testbench.campaign.file.settings import Settings
from testbench.campaign.plans.search import CombinationSearch
from testbench.campaign.records import Point


def base_scenario(
    data: dict[str, Data], document: Document, changes: Sequence[str], stored: str | None
) -> tuple[Document, list[str]]:
    """The scenario with the changes for every run, and what is wrong with it by itself."""
    given = data.get("scenario")
    if isinstance(given, dict):
        base = _part(document, ("scenario",))
    elif isinstance(given, str):
        try:
            path = _beside(document.source, given)
            base = load(path) if stored is None else parse(stored, path)
        except FileErrors as error:
            first = error.messages[0]
            if first.endswith("no such file"):
                document.report(("scenario",), f"{first}; it is looked for from the folder of this file")
                return Document(document.source), []
            return Document(document.source), list(error.messages)
    else:
        if "scenario" in data:
            got = describe_value(given)
            document.report(("scenario",), f"expected the path of a scenario, or a scenario as a mapping; got {got}")
        return Document(document.source), []
    settings = data.get("set")
    if isinstance(settings, dict) and "seed" in settings:
        document.report(("set", "seed"), "run k of every point has the campaign's seed plus k; set `seed:` itself")
    for key, text in read_settings(settings) if isinstance(settings, dict) else ():
        mark = document.mark(("set", key))
        base.overrides += 1
        set_value(base, key, text, Mark(base.overrides, 0, f"{document.source}:{mark.line}:{mark.column}: set"))
    for change in changes:
        apply_override(base, change)
    try:
        Settings(base, ()).scenario(Point(()))
    except FileErrors as error:
        return base, list(error.messages)
    return base, []


def _beside(source: str, given: str) -> str:
    """The path of a file named in another one; without `..` in it, unless links make that another file."""
    path = os.path.join(os.path.dirname(source), given)
    short = os.path.normpath(path)
    return short if os.path.exists(path) and os.path.exists(short) and os.path.samefile(path, short) else path


def _part(document: Document, at: Keys) -> Document:
    """A part of a document as one of its own; places in messages stay those of the file."""
    data, deep = document.data, len(at)
    for key in at:
        assert isinstance(data, dict)
        data = data[str(key)]
    cut = {
        name: {keys[deep:]: mark for keys, mark in marks.items() if keys[:deep] == at}
        for name, marks in (("values", document.values), ("keys", document.keys))
    }
    broken = {keys[deep:] for keys in document.broken if keys[:deep] == at}
    return Document(document.source, data, cut["values"], cut["keys"], broken=broken)


def check_keys(axes: Sequence[Axis], base: Document, document: Document) -> None:
    """Report keys that an axis sets and the scenario has no place for, and the one that is the campaign's."""
    for axis in axes:
        at: Keys = ("axes", axis.name, "cases" if axis.cases else "set")
        keys = dict.fromkeys(key for text in axis.texts for key, _ in axis.settings(text))
        for key in keys:
            if key == "seed":
                document.report(at, "seed is not an axis: run k of every point has the campaign's seed plus k")
            elif base.data is not None:
                tried = Document(base.source, cast("Data", _deep(base.data)))
                set_value(tried, key, "0", Mark(1, 1))
                if tried.problems:
                    document.report(at, f"{key}: {tried.problems[0].text} (in {base.source})")


def check_injectors(rule: CombinationSearch, base: Document, document: Document) -> None:
    """Report injectors that a search names and the scenario does not have."""
    known = Settings(base, ()).injectors
    for name in rule.injectors if base.data is not None else ():
        if name not in known:
            text = f"there is no injector {name!r}{did_you_mean(name, known)} (injectors: {', '.join(known) or 'none'})"
            document.report(("search", "combinations", "injectors"), text)


def _deep(data: Data) -> object:
    if isinstance(data, dict):
        return {key: _deep(value) for key, value in data.items()}
    return [_deep(value) for value in data] if isinstance(data, list) else data
