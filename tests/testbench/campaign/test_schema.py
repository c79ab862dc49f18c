"""Campaign files: what they mean, and every mistake with its place, all at once, before anything runs.

In the table the sign § stands before the character that the complaint must point at; it is not part of the file.
"""

from decimal import Decimal
from pathlib import Path

import pytest

from fi_gateway.marked_yaml import FileErrors
from testbench.campaign.file.rules import Figure, FixedRuns, StopEarly, Until
from testbench.campaign.file.schema import load_campaign, parse_campaign
from testbench.campaign.plans.combinations import CombinationPlan
from testbench.campaign.plans.search import CombinationSearch, CriticalSearch
from testbench.campaign.records import Point, Wanted
from testbench.scenario import parse_scenario
from tests.testbench.campaign.campaigns import SCENARIO, changed, small, written

VALUES = "values: [0.05 s, 0.3 s]"
SET = "set: [injectors.freeze.effect.duration, injectors.zero.effect.duration]"
MORE = f"{VALUES}\n  stops: {{set: rig.stops, values: [on, off]}}"

FIGURE = "seed: 5\nreport: {figures: ["

# what is wrong; what of the small campaign is changed, and into what; words of the complaint
TABLE: list[tuple[str, ...]] = [
    ("unknown key", "runs: 3", "§run: 3\nruns: 3", "run: unknown key", "did you mean 'runs'"),
    ("no name", "name: small", "name: §sm all", "'sm all' is no name"),
    ("no runs", "runs: 3\n", "", "runs: missing; needed: runs (or search)"),
    ("no run", "runs: 3", "runs: §0", "runs: expected the number of runs of a point, 1..100000", "got 0"),
    ("half a run", "runs: 3", "runs: §1.5", "got 1.5"),
    ("runs and search", "runs: 3", "§runs: 3\nsearch: {combinations: {injectors: [freeze]}}", "one of the two"),
    ("too many runs", VALUES + "\nruns: 3", "range: {from: 1 ms, to: 200 ms, step: 1 ms}\n§runs: 6000", "1200000 runs"),
    ("rule that never starts", "runs: 3", "runs: {until: {outcome: failure, width: 0.1}, most: §5}", "from 20 up"),
    ("rule without width", "runs: 3", "runs: {until: {outcome: failure, width: §1.5}, most: 50}", "between 0 and 1"),
    ("unknown outcome", "runs: 3", "runs: {until: {outcome: §fail, width: 0.1}, most: 50}", "'fail' is no outcome"),
    ("bad seed", "seed: 5", "seed: §-1", "seed: expected a whole number"),
    ("unknown traces", "seed: 5", "seed: 5\ntraces: §allways", "did you mean 'always'"),
    ("time without unit", "seed: 5", "seed: 5\ntime_limit: §60", "60 has no unit"),
    ("stop on what", "seed: 5", "seed: 5\nstop_early: {on: §masked}", "unknown on 'masked' (allowed: failure)"),
    # --- axes
    ("axis that is none", "duration:\n    set", "§and:\n    set", "'and' is no name for an axis"),
    ("axis of nothing", VALUES, "§value: [1 s]", "value: unknown key; did you mean 'values'"),
    ("two ways", VALUES, f"{VALUES}\n    linear: {{from: 1 s, to: 2 s, points: 2}}", "got values, linear"),
    ("no values", VALUES, "values: §[]", "the list is empty"),
    ("value twice", VALUES, "values: [0.3 s, §300 ms]", "300 ms is there twice (as 0.3 s)"),
    ("list as value", VALUES, "values: [0.3 s, §[1 s]]", "expected a single value"),
    ("values of two kinds", VALUES, "values: §[0.3 s, 20 %]", "different kinds: duration, share"),
    ("range that misses", VALUES, "range: §{from: 0.1 s, to: 1 s, step: 0.4 s}", "do not meet 1 s", "0.9 s"),
    ("range downwards", VALUES, "range: §{from: 1 s, to: 0.1 s, step: 0.1 s}", "upwards"),
    ("range in two units", VALUES, "range: §{from: 10 ms, to: 1 s, step: 10 ms}", "all of them in one unit"),
    ("range of millions", VALUES, "range: §{from: 0 s, to: 1 s, step: 0.000001 s}", "allowed are 10000 on an axis"),
    ("one step", VALUES, "linear: {from: 1 s, to: 2 s, points: §1}", "too small; allowed from 2"),
    ("log from nothing", VALUES, "log: §{from: 0 s, to: 2 s, points: 3}", "ends above 0"),
    ("no distribution", VALUES, "random: §{points: 3}", "0 distributions given"),
    ("ends without search", VALUES, "§between: {from: 1 s, to: 2 s}", "the axis that search.critical moves along"),
    # --- what the scenario says to it
    ("key the scenario has not", SET, "set: §injectors.freez.effect.duration", "no 'freez' in injectors", "'freeze'"),
    ("unknown key in the scenario", VALUES, MORE.replace("rig.stops", "rig.stps").replace("[on", "[§on"),
     "axes.stops: on: rig.stps: unknown key; did you mean 'stops'"),
    ("value the scenario refuses", VALUES, "values: [0.05 s, §0 s]", "axes.duration: 0 s", "not a length of time"),
    ("unit the scenario refuses", VALUES, "values: [§5 deg, 6 deg]", "'5 deg' is an angle; a duration is wanted"),
    ("generated value refused", VALUES, "linear: §{from: 0 s, to: 2 s, points: 3}", "axes.duration: 0 s"),
    ("seed as an axis", SET, "set: §seed", "seed is not an axis"),
    ("scenario that is wrong", "plant: suspended", "plant: §suspnded", "rig.plant: unknown plant 'suspnded'"),
    ("no scenario", "seed: 5", "seed: 5\n§scenari: x", "unknown key; did you mean 'scenario'"),
    ("change that fails", "seed: 5", "seed: 5\nset: {rig.stops: §maybe}", "set: rig.stops: expected on or off"),
    ("change of the seed", "seed: 5", "seed: 5\nset: {seed: §3}", "the campaign's seed plus k"),
    # --- filters, together, figures
    ("filter without axis", "seed: 5", "seed: 5\nfilter: [§durtion < 1 s]", "filter.0: there is no axis 'durtion'"),
    ("filter in wrong unit", "seed: 5", "seed: 5\nfilter: §duration < 1 deg", "filter: duration is a duration"),
    ("filter that leaves nothing", "seed: 5", "seed: 5\n§filter: [duration > 1 s]", "none of the 2 points is left"),
    ("together without axis", "seed: 5", "seed: 5\ntogether: [§[duration, gain]]", "there is no axis 'gain'"),
    ("together of unequal length", VALUES, f"{MORE.replace(', off', '')}\ntogether: [§[duration, stops]]",
     "duration has 2, stops has 1"),
    ("figure over no axis", "seed: 5", f"{FIGURE}{{x: §gain, y: failure}}]}}", "there is no axis 'gain'"),
    ("figure of nothing", "seed: 5", f"{FIGURE}{{x: duration, y: §right_knee.rmse}}]}}", "unknown quantity"),
    ("figure beside the axis", "seed: 5", f"{FIGURE}{{x: duration, y: failure, paper: {{5 deg: §1}}}}]}}",
     "'5 deg' is no value of axis duration"),
    # --- searches
    ("search along no axis", "runs: 3", "search: {critical: {axis: §gain, tolerance: 1 ms}}", "no axis 'gain'"),
    ("search in wrong unit", "runs: 3", "search: {§critical: {axis: duration, tolerance: 1 deg}}", "in one unit"),
    ("search finer than nothing", "runs: 3", "search: {§critical: {axis: duration, tolerance: 0 s}}", "tolerance"),
    ("search for no injector", "runs: 3", "search: {combinations: {injectors: §[freez, zero]}}",
     "no injector 'freez'", "'freeze'"),
    ("search for nothing", "runs: 3", "§search: {}", "expected one of critical, combinations"),
]  # fmt: skip
NAMES = [one[0] for one in TABLE]


def complaints(text: str) -> list[str]:
    with pytest.raises(FileErrors) as caught:
        parse_campaign(text, "small.yaml")
    return list(caught.value.messages)


@pytest.mark.parametrize(("old", "new", "words"), [(one[1], one[2], one[3:]) for one in TABLE], ids=NAMES)
def test_mistake_is_said_with_its_place(old: str, new: str, words: tuple[str, ...]) -> None:
    """Everything in the table, at the place of the sign where there is one."""
    text = changed((old, new))
    at = text.find("§")
    if at >= 0:
        line = text.count("\n", 0, at) + 1
        place = f"small.yaml:{line}:{at - text.rfind(chr(10), 0, at)}: "
        text = text.replace("§", "")
    else:
        place = "small.yaml:"
    found = [one for one in complaints(text) if one.startswith(place) and all(word in one for word in words)]
    assert found, "\n".join([place, *complaints(text)])


def test_all_mistakes_are_said_at_once(tmp_path: Path) -> None:
    """Of the campaign and of its scenario's file, each with its own path."""
    scenario = tmp_path / "scenario.yaml"
    wrong = SCENARIO.replace("0.1 s}", "0.1}", 1)
    scenario.write_text("\n".join(line[2:] for line in wrong.splitlines()), encoding="utf-8")
    campaign = tmp_path / "campaign.yaml"
    named = (f"scenario:\n{SCENARIO}", "scenario: scenario.yaml")
    text = changed(("runs: 3", "runs: 0"), ("seed: 5", "seed: five"), named)
    campaign.write_text(text, encoding="utf-8")
    with pytest.raises(FileErrors) as caught:
        load_campaign(campaign)
    assert len(caught.value.messages) == 3
    assert [message.partition(":")[0] for message in caught.value.messages] == [*[str(campaign)] * 2, str(scenario)]


def test_a_filter_is_told_of_the_axes_that_are_wrong_themselves() -> None:
    """They are in the file; a list without them would say that there are none."""
    said = complaints(changed((VALUES, "values: [0.3 s, 20 %]"), ("seed: 5", "seed: 5\nfilter: [durtion < 1 s]")))
    assert any("'durtion'; did you mean 'duration'? (axes: duration" in one for one in said)


def test_a_range_of_numbers_without_unit_ends_its_message_cleanly() -> None:
    """No unit, no space for it."""
    wrong = "range: {from: 0.1, to: 1, step: 0.4}"
    assert any(one.endswith("the last one below it is 0.9") for one in complaints(changed((VALUES, wrong))))


def test_each_value_is_complained_about_once() -> None:
    """However many points have it; here two injectors get it."""
    text = changed((VALUES, f"values: [0.05 s, 0 s]\n  stops: {MORE.partition('stops: ')[2]}"))
    assert len(complaints(text)) == 2


def test_what_hangs_on_several_values_names_the_point() -> None:
    """A stride and a rate, each right by itself, that do not go together."""
    axes = "rate: {set: rig.rate, values: [500 Hz, 125 Hz]}\n  stride: {set: motion.stride, values: [1.2 s, 1.5 s]}"
    (message,) = complaints(changed((VALUES, f"{VALUES}\n  {axes}"), ("values: [0.05 s, 0.3 s]", "values: [0.3 s]")))
    assert "axes.stride: 1.5 s: motion.stride: 1.5 s is not a whole number of control cycles of 8 ms" in message


def test_points_that_are_one_scenario_are_refused() -> None:
    """They would count twice."""
    axes = f"{VALUES}\n  other: {{set: description, values: [a, b]}}\n  same: {{cases: {{x: {{}}, y: {{}}}}}}"
    assert any("are one scenario, and would count twice" in one for one in complaints(changed((VALUES, axes))))


def test_points_in_their_order_with_their_scenarios() -> None:
    """Both injectors get the value; the seed is that of the run."""
    campaign = small((VALUES, MORE))
    assert [point.parameters for point in campaign.points][:2] == [
        (("duration", "0.05 s"), ("stops", "on")),
        (("duration", "0.05 s"), ("stops", "off")),
    ]
    spec = campaign.spec_of(Wanted(campaign.points[0], 2), "v", "folder", fork=True)
    scenario = parse_scenario(spec.scenario)
    assert scenario.seed == spec.seed == 7
    assert scenario.rig.stops is True
    assert scenario.resolved_yaml() == spec.scenario
    assert spec.scenario.count("duration: 50 ms") == 2
    assert (spec.keep_traces, spec.time_limit_s, spec.stop_on) == ("never", 120.0, None)
    assert spec.folder == str(Path("folder") / spec.identity[:16])


def test_everything_in_a_file_is_taken_over(tmp_path: Path) -> None:
    """All keys but searches, from a file."""
    rest = """seed: 5
set: {rig.stops: on}
filter: duration < 0.2 s
stop_early: {on: failure, grace: 0.2 s}
traces: failures
time_limit: 2 min
report:
  figures: [{x: duration, y: right_knee.rmse_position_rad, to: 0.5 s, fit: quadratic, paper: {50 ms: 0.047}}]
"""
    rule = ("runs: 3", "runs: {until: {outcome: masked, width: 0.1}, most: 400}")
    path = written(tmp_path, ("seed: 5\n", rest), rule)
    campaign = load_campaign(path)
    assert campaign.stop_early == StopEarly("failure", 0.2)
    assert (campaign.traces, campaign.time_limit_s, len(campaign.points)) == ("failures", 120.0, 1)
    assert campaign.rule == Until("masked", 0.1, batch=20, least=20, most=400)
    figure = Figure("duration", "right_knee.rmse_position_rad", float("-inf"), 0.5, "quadratic", ((0.05, 0.047),))
    assert campaign.figures == (figure,)
    assert "stops: 'on'" in campaign.scenario_text(campaign.points[0])


def test_changes_and_runs_of_the_command_line(tmp_path: Path) -> None:
    """--set changes the scenario of every run, --runs the number; both say so when they are wrong."""
    path = written(tmp_path)
    campaign = load_campaign(path, ["rig.stops=on"], 7)
    assert campaign.rule == FixedRuns(7)
    assert "stops: 'on'" in campaign.scenario_text(campaign.points[0])
    with pytest.raises(FileErrors, match=r"^--set rig\.stop=on: .*did you mean 'stops'"):
        load_campaign(path, ["rig.stop=on"])
    searching = written(tmp_path, ("runs: 3", "search: {combinations: {injectors: [freeze, zero]}}"))
    with pytest.raises(FileErrors, match=r"^--runs 7: runs: give one of the two, runs or search"):
        load_campaign(searching, (), 7)
    path = written(tmp_path)
    with pytest.raises(FileErrors, match=r"^--runs 200000: runs: expected"):
        load_campaign(path, (), 200_000)


def test_critical_search_has_the_ends_of_its_axis() -> None:
    """The axis gives the ends; the others span the map, and both ends are looked at before the first run."""
    between = (VALUES, "between: {from: 0.05 s, to: 0.3 s}\n  stops: {set: rig.stops, values: [on, off]}")
    search = "search: {critical: {axis: duration, tolerance: 10 ms, method: logistic}}"
    with pytest.raises(FileErrors, match="all of them in one unit"):
        small(between, ("runs: 3", search))
    campaign = small(between, ("runs: 3", search.replace("10 ms", "0.01 s")))
    rule = campaign.rule
    assert isinstance(rule, CriticalSearch)
    assert (rule.text(0), rule.text(rule.steps), rule.method) == ("0.05 s", "0.3 s", "logistic")
    assert (rule.value(1), rule.unit) == (Decimal("0.06"), "s"), "no rounding through a float"
    assert [point.parameters for point in campaign.points] == [(("stops", "on"),), (("stops", "off"),)]
    assert "duration: 0.13 s" in campaign.scenario_text(Point((("duration", "0.13 s"), ("stops", "on"))))
    too_short = (VALUES, "between: {from: 0 s, to: 0.3 s}")
    with pytest.raises(FileErrors, match=r"axes\.duration: 0 s: injectors\.freeze\.effect\.duration"):
        small(too_short, ("runs: 3", "search: {critical: {axis: duration, tolerance: 0.01 s}}"))


def test_combination_search_switches_injectors() -> None:
    """Those named are on, the others of the list off."""
    campaign = small(("runs: 3", "search: {combinations: {injectors: [freeze, zero], runs: 4}}"))
    assert campaign.rule == CombinationSearch(("freeze", "zero"), runs=4)
    assert isinstance(campaign.rule, CombinationSearch)
    point = CombinationPlan(campaign.rule, campaign.points).point(campaign.points[0], ("zero",))
    text = campaign.scenario_text(point)
    scenario = parse_scenario(text)
    assert [scenario.injectors[name].enabled for name in ("freeze", "zero")] == [False, True]
