"""What a store keeps of its campaign besides runs, and what a report reads back.

One store is of one campaign, which may be changed and run again: what is new is added, what the file no longer wants,
or another version of the program has made, stays and does not count.
"""

import json
from collections.abc import Iterable
from pathlib import Path

from testbench.campaign.file.axes import Axis
from testbench.campaign.file.schema import Campaign, stored_campaign
from testbench.campaign.records import Point, RunRow
from testbench.campaign.report.meta import Meta
from testbench.campaign.store.store import Store, StoreError
from testbench.campaign.words import asked


def remember(store: Store, campaign: Campaign) -> None:
    """Keep the campaign in the store; raises StoreError when the store is another one's."""
    name = store.meta("name")
    if name and name != campaign.name:
        raise StoreError(
            f"store {store.path}: it is of campaign {name!r}, not {campaign.name!r}; give another place with --out"
        )
    base = campaign.settings.base
    own = base.source == campaign.source
    try:
        scenario = "" if own else Path(base.source).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise StoreError(f"{base.source}: {error.strerror or error}; it was read a moment ago") from error
    store.set_meta(
        {
            "name": campaign.name,
            "source": campaign.source,
            "text": campaign.text,
            "scenario": scenario,
            "changes": json.dumps(campaign.changes),
            "runs": json.dumps(campaign.runs),
        }
    )


def remembered(store: Store) -> Campaign:
    """The campaign as it was run last, its points unchecked; raises FileErrors when this version cannot read it."""
    source = store.meta("source")
    if not source:
        raise StoreError(f"store {store.path}: no campaign was run into it; `exo-hil campaign run FILE --out` does")
    runs: int | None = json.loads(store.meta("runs"))
    return stored_campaign(store.meta("text"), source, store.meta("scenario"), json.loads(store.meta("changes")), runs)


def contents(store: Store) -> tuple[list[RunRow], Meta]:
    """The runs that count, and all else that a report says."""
    campaign, rows, made = remembered(store), store.runs.all(), store.invocations.all()
    last = made[-1] if made else None
    notes = [f"{count} runs of version {version} are in the store and not counted" for version, count in _others(store)]
    meta = Meta(
        name=campaign.name,
        description=campaign.description,
        file=Path(campaign.source).name,
        text=campaign.text,
        store=str(store.path),
        axes=campaign.axes,
        points=campaign.points,
        rule=campaign.rule,
        asked=asked(campaign.rule),
        wanted=int(store.meta("wanted") or len(rows)),
        seed=campaign.seed,
        figures=campaign.figures,
        command=last.command if last else "",
        started=made[0].started if made else "",
        ended=(last.ended or "") if last else "",
        wall_s=sum(one.wall_s for one in made),
        jobs=last.jobs if last else 1,
        versions={"code": last.code_version} if last else {},
        notes=tuple(notes),
        changes=campaign.changes,
        motions=_motions(campaign, {row.point for row in rows}),
    )
    return rows, meta


def _motions(campaign: Campaign, points: Iterable[Point]) -> dict[Point, float]:
    """How long the motion is to be at each point [s]; read once for each setting of it. {} where no run ends early."""
    if campaign.stop_early is None:
        return {}
    about = {axis.name for axis in campaign.axes if _sets_motion(axis)}
    known: dict[tuple[tuple[str, str], ...], float] = {}
    found = {}
    for point in points:
        place = tuple(pair for pair in point.parameters if pair[0] in about)
        if place not in known:
            known[place] = campaign.settings.scenario(point).motion.duration_ns / 1e9
        found[point] = known[place]
    return found


def _sets_motion(axis: Axis) -> bool:
    keys = {key for text in axis.texts for key, _ in axis.settings(text)}
    return any(key.partition(".")[0] == "motion" for key in keys)


def _others(store: Store) -> list[tuple[str, int]]:
    return list(store.runs.others().items())
