"""Campaign files for tests."""

from pathlib import Path

from testbench.campaign.file.schema import Campaign, parse_campaign

SCENARIO = """\
  name: short
  rig: {plant: suspended, stops: off, rate: 500 Hz}
  motion: {gait: walking, stride: 1.5 s, duration: 1.5 s}
  injectors:
    freeze:
      target: {bus: to_controller, node: right_knee, signal: position}
      fault: {type: stuck_at}
      event: {type: failure_probability, p: 0.005, per: 1 ms}
      effect: {type: constant_time, duration: 0.1 s}
    zero:
      target: {bus: to_controller, node: right_knee, signal: velocity}
      fault: {type: stuck_at_value, value: 0 rpm}
      event: {type: never}
      effect: {type: constant_time, duration: 0.1 s}
      trigger: {any: [freeze], on: activated}
"""

CAMPAIGN = f"""\
name: small
description: two durations
scenario:
{SCENARIO}
axes:
  duration:
    set: [injectors.freeze.effect.duration, injectors.zero.effect.duration]
    values: [0.05 s, 0.3 s]
runs: 3
seed: 5
"""


def small(*changes: tuple[str, str], source: str = "small.yaml") -> Campaign:
    """The small campaign, with texts in it replaced."""
    return parse_campaign(changed(*changes), source)


def changed(*changes: tuple[str, str]) -> str:
    """The text of the small campaign with texts in it replaced, each of which must be there once."""
    text = CAMPAIGN
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def written(folder: Path, *changes: tuple[str, str]) -> Path:
    """The same as a file."""
    path = folder / "small.yaml"
    path.write_text(changed(*changes), encoding="utf-8")
    return path
