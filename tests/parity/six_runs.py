"""A campaign of six runs over a bus, with `exo-hil campaign run --realtime`: the same on the hub and on vcan."""

import json
from pathlib import Path
from typing import Any

import pytest

from testbench.campaign.records import Outcome, RunRow
from testbench.campaign.store.store import open_store
from testbench.cli import INVALID, PASS, main
from tests.parity.patience import BUSY, is_lateness
from tests.parity.walks import Bench

CAMPAIGN = """\
name: six_runs
description: right knee frozen for two durations, three times each, against the clock
scenario: walk.yaml
axes:
  duration:
    set: injectors.fault.effect.duration
    values: [0.1 s, 0.3 s]
runs: 3
seed: 1
"""
SHORT = "motion: {gait: walking, stride: 1.5 s, duration: 0.5 s}"


def make_six_runs(bench: Bench, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Six rows, each judged or invalid for lateness; asked again, nothing is made. Skips when all of them were late."""
    text = bench.text("freeze").replace("motion: {gait: walking, stride: 1.5 s, duration: 2.5 s}", SHORT)
    (folder / "walk.yaml").write_text(text.replace("time: 1 s", "time: 0.1 s"))
    (folder / "six.yaml").write_text(CAMPAIGN)
    store = folder / "six.sqlite"
    command = ["campaign", "run", str(folder / "six.yaml"), "--realtime", *bench.options, "--out", str(store), "--json"]
    code = main([*command, "--no-report"])
    made: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert (made["made"], made["done"], made["wanted"]) == (6, 6, 6)
    again = main([*command, "--no-report"])
    assert json.loads(capsys.readouterr().out)["made"] == 0
    found = open_store(store)
    try:
        rows = found.runs.all()
    finally:
        found.close()
    late = [row for row in rows if row.outcome is Outcome.INVALID]
    assert code == again == (INVALID if late else PASS)
    for row in late:
        assert row.attempts == 3
        assert is_lateness(row.reason.removeprefix("golden run: ").split("; "), bench.cycle_ns / 1e6), row.reason
    judged = [row for row in rows if row not in late]
    if not judged:
        pytest.skip(f"{BUSY}: {late[0].reason}")
    for row in judged:
        check_row(row)


def check_row(row: RunRow) -> None:
    """The injector was armed over live control, acted when it should, and for how long its point says."""
    [injection] = row.injections
    asked_s = float(dict(row.point.parameters)["duration"].removesuffix(" s"))
    assert (injection.injector, injection.cause) == ("fault", "event")
    assert injection.start_s == pytest.approx(0.1, abs=0.04)  # stuck_at waits for a sample, two cycles at most
    assert injection.end_s == pytest.approx(injection.start_s + asked_s, abs=1e-6)
    assert row.manifested > 0
    assert row.metrics["right_knee.rmse_position_rad"] > 0
    assert row.metrics["timing.worst_late_ms"] >= 0
    assert " in real time on " in row.versions["code"]
