"""Scenario files: read into plain data, every complaint at once with its place, written back, overridden, described."""

import copy
import math
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.node import MS, SECOND
from fi_gateway.marked_yaml import FileErrors, write
from fi_gateway.schema import build_injectors
from testbench.fault_file import load_any
from testbench.scenario import (
    Expectation,
    Motion,
    Rig,
    Scenario,
    default_joints,
    describe,
    load_scenario,
    parse_scenario,
    scenario_schema,
)

SCENARIOS = Path(__file__).parents[2] / "scenarios"
FILES = sorted(SCENARIOS.glob("*.yaml"))
KNEE = (SCENARIOS / "knee_freeze.yaml").read_text(encoding="utf-8")
PLAIN = """\
name: plain
rig: {plant: suspended, stops: on}
motion: {gait: walking, stride: 1.5 s, duration: 7 s}
"""


def messages(text: str) -> tuple[str, ...]:
    """All complaints about a text."""
    with pytest.raises(FileErrors) as caught:
        parse_scenario(text, "s.yaml")
    return caught.value.messages


def knee(old: str, new: str) -> str:
    """The knee scenario with one change."""
    assert old in KNEE
    return KNEE.replace(old, new, 1)


def test_the_examples_are_there() -> None:
    """One fault per file."""
    names = {"knee_freeze", "knee_freeze_at", "bit_flip", "dropped_pdos", "golden"}
    assert names <= {file.stem for file in FILES}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_example_loads_builds_and_comes_back_equal(file: Path) -> None:
    """scenarios/*.yaml load without warnings; the resolved file reads as an equal scenario, and so does its own."""
    scenario = load_scenario(file)
    assert scenario.name == file.stem
    assert scenario.warnings == []
    assert len(build_injectors(scenario.injectors, scenario.plan, scenario.seed, 0)) == len(scenario.injectors)
    resolved = scenario.resolved_yaml()
    assert parse_scenario(resolved) == scenario
    assert parse_scenario(resolved).resolved_yaml() == resolved


def test_a_scenario_is_plain_data_in_si_and_ns() -> None:
    """The first experiment, value by value."""
    scenario = load_scenario(SCENARIOS / "knee_freeze.yaml")
    assert (scenario.name, scenario.seed) == ("knee_freeze", 2020)
    assert (scenario.fail_on, scenario.tolerance_rad) == ("failure", 0)
    assert scenario.rig == Rig("suspended", False, 2 * MS)
    assert scenario.motion == Motion("walking", 1500 * MS, 7 * SECOND)
    assert list(scenario.injectors) == ["freeze_position", "zero_velocity"]
    assert scenario.expect == (
        Expectation("golden.tracking_rmse", "<", 0.01, "golden.tracking_rmse < 0.01 rad"),
        Expectation("failures", "==", 0.0, "failures == 0"),
    )
    assert scenario.plan.cycle_ns == 2 * MS


def test_defaults_are_written_into_the_resolved_file() -> None:
    """scenario.yaml as run says everything."""
    text = parse_scenario(PLAIN).resolved_yaml()
    assert [line.split(":")[0] for line in text.splitlines() if not line.startswith(" ")] == [
        *("name", "description", "rig", "motion", "seed", "injectors", "expect", "fail_on", "tolerance", "realtime"),
    ]
    assert "  rate: 500 Hz\n" in text
    assert "  stops: 'on'\n" in text  # quoted: other YAML readers take a bare on for true


def test_scenarios_can_be_sent_between_processes() -> None:
    """Campaign workers get them pickled."""
    scenario = parse_scenario(KNEE)
    assert pickle.loads(pickle.dumps(scenario)) == scenario
    assert copy.deepcopy(scenario) == scenario


def test_the_joints_are_the_papers() -> None:
    """Rated torque: table 1 of ESREL 2020; node ids 1..6; 17-bit encoders."""
    assert [(one.name, one.node_id, one.rated_torque_mnm, one.encoder_counts) for one in default_joints()] == [
        ("left_hip", 1, 72_900, 131_072),
        ("left_knee", 2, 54_900, 131_072),
        ("left_ankle", 3, 128_700, 131_072),
        ("right_hip", 4, 72_900, 131_072),
        ("right_knee", 5, 54_900, 131_072),
        ("right_ankle", 6, 128_700, 131_072),
    ]


@pytest.mark.parametrize(
    ("old", "new", "place", "words"),
    [
        ("name: knee_freeze", "name: knee freeze", "1:7: name", ["'knee freeze' is no name", "letters, digits"]),
        ("name: knee_freeze", "name: ../knee", "1:7: name", ["is no name"]),
        ("name: knee_freeze", "name: 5", "1:7: name", ["5 is no name"]),
        ("name: knee_freeze", "nam: knee_freeze", "1:1: nam", ["unknown key; did you mean 'name'?"]),
        ("description: right", "description: note: right", "2:18", ["a second ': ' in one line; put quotes"]),
        ("suspended", "standing", "3:14: rig.plant", ["unknown plant 'standing'", "suspended"]),
        ("suspended", "walking", "3:14: rig.plant", ["plant 'walking' is not available yet; available: suspended"]),
        ("stops: off", "stops: false", "3:32: rig.stops", ["expected on or off; got false"]),
        ("stops: off, ", "", "3:1: rig.stops", ["missing; needed: plant, stops"]),
        ("500 Hz", "500", "3:43: rig.rate", ["500 has no unit", "Hz, kHz"]),
        ("500 Hz", "300 Hz", "3:43: rig.rate", ["plant steps of 1 ms", "500, 250, 200, 125, 100, 62.5 or 50 Hz"]),
        ("500 Hz", "400 Hz", "3:43: rig.rate", ["plant steps of 1 ms"]),
        ("500 Hz", "2000 Hz", "3:43: rig.rate", ["plant steps of 1 ms"]),
        ("500 Hz", "40 Hz", "3:43: rig.rate", ["at most 20 ms"]),
        ("500 Hz", "0 Hz", "3:43: rig.rate", ["plant steps of 1 ms"]),
        ("500 Hz", "-500 Hz", "3:43: rig.rate", ["plant steps of 1 ms"]),
        ("500 Hz", "1000 Hz", "3:43: rig.rate", ["worst-case load 153 %", "at most 100 %", "lower the rate"]),
        ("rate: 500 Hz", "file: my_rig.yaml", "3:37: rig.file", ["not available yet; available: plant, stops, rate"]),
        ("gait: walking", "gait: running", "4:16: motion.gait", ["unknown gait 'running'", "walking"]),
        ("1.5 s", "1.501 s", "4:33: motion.stride", ["whole number of control cycles of 2 ms", "1.5 s or 1.502 s"]),
        ("1.5 s", "499 ms", "4:33: motion.stride", ["0.499 s given; allowed 0.5 s..20 s"]),
        ("1.5 s", "20.002 s", "4:33: motion.stride", ["allowed 0.5 s..20 s"]),
        ("duration: 7 s", "duration: 0 s", "4:50: motion.duration", ["'0 s' is not a length of time"]),
        ("duration: 7 s", "duration: 7.0005 s", "4:50: motion.duration", ["whole milliseconds up to 3600 s"]),
        ("duration: 7 s", "duration: 3600.001 s", "4:50: motion.duration", ["whole milliseconds up to 3600 s"]),
        ("seed: 2020", "seed: -1", "5:7: seed", ["whole number 0..9223372036854775807; got -1"]),
        ("seed: 2020", "seed: 1.5", "5:7: seed", ["got 1.5"]),
        ("seed: 2020", "seed: true", "5:7: seed", ["got true"]),
        ("seed: 2020", "seed: '2020'", "5:7: seed", ["got '2020'"]),
        ("seed: 2020", "seed: 2020\nseed: 1", "6:1: seed", ["given twice; first at 5:1"]),
        ("  zero_velocity:", "  freeze_position:", "12:3: injectors.freeze_position", ["given twice; first at 7:3"]),
        ("  freeze_position:", "  freeze.position:", "7:3: injectors.freeze.position", ["is no name"]),
        ("node: right_knee", "node: rightknee", "8:40: injectors.freeze_position.target.node",
         ["did you mean 'right_knee'?", "left_hip, left_knee, left_ankle, right_hip, right_knee, right_ankle"]),
        ("bus: to_controller", "bus: to_drives", "8:19: injectors.freeze_position.target.bus",
         ["write bus: to_controller"]),
        ("{type: stuck_at}", "{type: stuck}", "9:19: injectors.freeze_position.fault.type",
         ["did you mean 'stuck_at'?"]),
        ("p: 0.0005", "p: 1.5", "10:43: injectors.freeze_position.event.p", ["1.5 is not a probability"]),
        ("p: 0.0005", "p: .nan", "10:43: injectors.freeze_position.event.p", [".nan is not a finite number"]),
        ("value: 0 rpm", "value: 0 deg", "14:42: injectors.zero_velocity.fault.value",
         ["'0 deg' is an angle; an angular velocity is wanted", "rad/s, deg/s, rpm"]),
        ("any: [freeze_position]", "any: [freeze_positio]", "17:21: injectors.zero_velocity.trigger.any.0",
         ["no injector is called 'freeze_positio'; did you mean 'freeze_position'?"]),
        ("any: [freeze_position]", "any: [zero_velocity]", "17:20: injectors.zero_velocity.trigger.any",
         ["zero_velocity -> zero_velocity"]),
        ("failures == 0", "failure == 0", "20:5: expect.1", ["did you mean 'failures'?"]),
        ("0.01 rad", "0.01", "19:5: expect.0", ["has no unit"]),
        ("expect:", "fail_on: warning\nexpect:", "18:10: fail_on", ["unknown fail_on 'warning'", "failure, error"]),
        ("expect:", "tolerance: 3\nexpect:", "18:12: tolerance", ["3 has no unit"]),
        ("expect:", "tolerance: -1 deg\nexpect:", "18:12: tolerance", ["allowed 0 deg..90 deg"]),
        ("expect:", "tolerance: 91 deg\nexpect:", "18:12: tolerance", ["allowed 0 deg..90 deg"]),
    ],
)  # fmt: skip
def test_a_bad_value_is_refused_at_its_line_and_column(old: str, new: str, place: str, words: list[str]) -> None:
    """path:line:col: key: what, got, allowed, remedy."""
    said = [message for message in messages(knee(old, new)) if message.startswith(f"s.yaml:{place}: ")]
    assert len(said) == 1, messages(knee(old, new))
    assert all(word in said[0] for word in words), said


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "s.yaml:1:1: the file is empty"),
        ("- a\n", "s.yaml:1:1: expected a mapping with name, rig, motion, description, seed, injectors, expect, "
                  "fail_on, tolerance, realtime; got a list"),
        (PLAIN.replace("motion", "injectors: {}\n#"), "s.yaml:1:1: motion: missing; needed: name, rig, motion"),
        (PLAIN + "injectors:\n", "s.yaml:4:11: injectors: expected a mapping of names; got nothing"),
        (PLAIN + "injectors: [a]\n", "s.yaml:4:12: injectors: expected a mapping of names; got a list"),
        (PLAIN + "expect: failures == 0\n",
         "s.yaml:4:9: expect: expected a list such as [a, b]; got 'failures == 0'"),
    ],
)  # fmt: skip
def test_a_file_of_the_wrong_shape_is_refused_with_one_message(text: str, message: str) -> None:
    """Whatever the file holds, it is said once."""
    assert messages(text) == (message,)


def test_every_complaint_comes_at_once_in_the_order_of_the_file() -> None:
    """All errors at once: YAML, shape, rig, injectors, expectations."""
    text = KNEE
    for old, new in (
        ("500 Hz", "300 Hz"), ("gait: walking", "gait: running"), ("seed: 2020", "seed: .nan"),
        ("node: right_knee", "node: knee"), ("duration: 0.3 s}\n  zero", "duration: 0.3}\n  zero"),
        ("value: 0 rpm", "value: 0 deg"), ("any: [freeze_position]", "any: [freeze]"), ("failures", "failed"),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new, 1)
    assert [message.split(": ")[1] for message in messages(text)] == [
        "rig.rate",
        "motion.gait",
        "seed",
        "injectors.freeze_position.target.node",
        "injectors.freeze_position.effect.duration",
        "injectors.zero_velocity.fault.value",
        "injectors.zero_velocity.trigger.any.0",
        "expect.1",
    ]


@pytest.mark.parametrize(
    ("rate", "cycle_ms"),
    [("500 Hz", 2), ("250 Hz", 4), ("0.2 kHz", 5), ("125 Hz", 8), ("100 Hz", 10), ("62.5 Hz", 16), ("50 Hz", 20)],
)
def test_the_rate_is_a_whole_number_of_plant_steps(rate: str, cycle_ms: int) -> None:
    """A control period must be a multiple of the physics step."""
    stride = "1.6 s"  # whole cycles at every one of these rates
    scenario = parse_scenario(PLAIN.replace("stops: on", f"stops: on, rate: {rate}").replace("1.5 s", stride))
    assert scenario.rig.cycle_ns == cycle_ms * MS
    assert parse_scenario(scenario.resolved_yaml()) == scenario


@pytest.mark.parametrize(
    ("override", "check"),
    [
        ("injectors.freeze_position.effect.duration=0.5s", "duration: 0.5 s"),
        ("injectors.freeze_position.enabled=false", "enabled: false"),
        ("injectors.freeze_position.effect={type: once}", "type: once"),
        ("injectors.freeze_position.event.p=20 %", "p: 0.2"),
        ("rig.stops=on", "stops: 'on'"),
        ("seed=7", "seed: 7"),
        ("tolerance=3 deg", "tolerance: 0.0523598"),
        ("fail_on=error", "fail_on: error"),
        ("expect.0=errors == 0", "- errors == 0"),
        ("expect=[]", "expect: []"),
    ],
)
def test_an_override_addresses_values_by_path_and_injectors_by_name(override: str, check: str) -> None:
    """--set key=value; the rest stays as in the file."""
    before = load_scenario(SCENARIOS / "knee_freeze.yaml").resolved_yaml()
    after = load_scenario(SCENARIOS / "knee_freeze.yaml", [override]).resolved_yaml()
    assert check in after
    assert check not in before
    assert parse_scenario(after).resolved_yaml() == after


def test_overrides_apply_in_order() -> None:
    """The last one wins."""
    assert load_scenario(SCENARIOS / "golden.yaml", ["seed=1", "seed=2"]).seed == 2


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("injectors.freeze_position.effect.duration=0.5",
         ": 0.5 has no unit; a duration needs one (units: s, ms, us, ns, min, h; for example '0.3 s')"),
        ("injectors.freeze_position.effect.durtion=0.5 s",
         ": constant_time has no such key; did you mean 'duration'? (allowed: type, duration)"),
        ("injectors.freeze.effect.duration=1 s",
         ": no 'freeze' in injectors; there are freeze_position, zero_velocity"),
        ("injectors.freeze_position.target={bus: both}", ": which frames? add signal (controlword, target_torque, "
         "position, velocity, statusword, torque, error_code), pdo (RPDO1, TPDO1, TPDO2), kind or cob_id"),
        ("injectors.zero_velocity.fault={type: bias, value: 3}",
         ": injectors.zero_velocity.fault.value: velocity of right_knee: 3 has no unit; an angular velocity needs one "
         "(units: rad/s, deg/s, rpm; for example '65.2 rpm')"),
        ("seed", ": expected key=value, such as motion.duration=7s"),
        ("seed=x", ": expected a whole number 0..9223372036854775807; got 'x'"),
        ("sed=1", ": unknown key; did you mean 'seed'? (allowed: name, rig, motion, description, seed, injectors, "
         "expect, fail_on, tolerance, realtime)"),
    ],
)  # fmt: skip
def test_a_bad_override_is_reported_as_such(override: str, message: str) -> None:
    """`--set injectors.x.y=...: message`, never the file's place."""
    with pytest.raises(FileErrors) as caught:
        load_scenario(SCENARIOS / "knee_freeze.yaml", [override])
    assert caught.value.messages == (f"--set {override}{message}",)


def test_complaints_about_file_and_overrides_come_together() -> None:
    """The file's first."""
    with pytest.raises(FileErrors) as caught:
        load_scenario(SCENARIOS / "knee_freeze.yaml", ["seed=x", "injectors.freeze_position.effect.type=once", "y"])
    starts = [message.split(": ")[0] for message in caught.value.messages]
    assert starts[0].endswith("knee_freeze.yaml:11:35")
    assert starts[1:] == ["--set seed=x", "--set y"]


def test_silent_injectors_are_warned_about() -> None:
    """Allowed, and told."""
    scenario = parse_scenario(knee("{type: failure_probability, p: 0.0005, per: 1 ms}", "{type: at, time: 7 s}"))
    assert scenario.warnings == [
        "injectors.freeze_position.event: 7 s comes after the motion has ended at 7 s",
        "injectors.zero_velocity: will stay silent: its event never happens and nothing that triggers it can start",
    ]


def test_a_scenario_can_be_read_aloud() -> None:
    """`exo-hil check`: rig, motion, every injector, verdict."""
    assert describe(parse_scenario(KNEE)) == [
        "knee_freeze: right knee encoder freezes, its velocity reads 0 (ESREL 2020, first experiment)",
        "rig: suspended, without mechanical stops, 500 Hz; bus load 63 to 77 %",
        "motion: walking, stride 1.5 s, 7 s after a fade-in of one stride",
        "seed: 2020",
        "freeze_position: position of right_knee (0x185, to_controller) held at its last value for 0.3 s; starts with "
        "probability 0.0005 per 1 ms (0.5/s), about 3.1 activations of freeze_position expected in 7 s, dead time "
        "included",
        "zero_velocity: velocity of right_knee (0x185, to_controller) reads 0 rpm for 0.3 s; starts when "
        "freeze_position is activated",
        "triggers:",
        "  freeze_position",
        "    `-- activated --> zero_velocity",
        "verdict: fails if a joint leaves its range of travel",
        "expected: golden.tracking_rmse < 0.01 rad",
        "expected: failures == 0",
    ]


def test_what_fails_the_verdict_is_said() -> None:
    """Tolerance and fail_on show."""
    lines = describe(parse_scenario(PLAIN + "fail_on: error\ntolerance: 3 deg\n"))
    assert "no injectors: a fault-free run" in lines
    assert lines[-1] == (
        "verdict: fails if a joint leaves its range of travel by more than 3 deg or passes a torque or speed limit"
    )


def test_editors_get_a_schema() -> None:
    """JSON Schema of the file format: keys as in files, unknown ones refused."""
    schema = scenario_schema()
    definitions = schema["$defs"]
    assert isinstance(definitions, dict)
    rig = definitions["Rig"]
    assert isinstance(rig, dict)
    assert rig["required"] == ["plant", "stops"]
    assert isinstance(rig["properties"], dict)
    assert list(rig["properties"]) == ["plant", "stops", "rate", "queues"]
    assert schema["additionalProperties"] is rig["additionalProperties"] is False


def test_reading_messages_needs_no_pydantic() -> None:
    """pydantic is imported only when a scenario is loaded; what reports and quantities need is not a scenario."""
    code = "import sys, fi_gateway.marked_yaml, testbench.expect; sys.exit('pydantic' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, cwd=SCENARIOS.parent).returncode == 0


@pytest.mark.long
@given(
    st.text(st.characters(exclude_categories=["Cs"]), max_size=30),
    st.integers(0, 2**63 - 1),
    st.integers(250, 10_000),
    st.integers(2, 3_600_000),
    st.floats(0, math.pi / 2),
    st.booleans(),
)
def test_whatever_is_set_comes_back_from_the_resolved_file(
    description: str, seed: int, stride_cycles: int, duration_ms: int, tolerance: float, stops: bool
) -> None:
    """Loading scenario.yaml as run gives an equal Scenario, to the last bit."""
    scenario = Scenario(
        "any",
        Rig("suspended", stops),
        Motion("walking", stride_cycles * 2 * MS, duration_ms * MS),
        description,
        seed,
        fail_on="error",
        tolerance_rad=tolerance,
    )
    assert parse_scenario(scenario.resolved_yaml()) == scenario


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.sampled_from(["off", "1 s", "stuck_at", "a", "right_knee", "both", "position", "failures == 0", "0x185"]),
    lambda inner: st.lists(inner, max_size=2)
    | st.dictionaries(st.sampled_from(["type", "bus", "node", "signal", "any", "value"]), inner, max_size=3),
    max_leaves=5,
)  # fmt: skip
KEYS = [
    *("name", "rig", "motion", "seed", "injectors", "expect", "fail_on", "tolerance", "rig.stops", "rig.rate"),
    *("motion.stride", "injectors.freeze_position", "injectors.freeze_position.target"),
    *("injectors.freeze_position.fault", "injectors.freeze_position.event", "injectors.freeze_position.effect"),
    *("injectors.zero_velocity.trigger", "injectors.zero_velocity.fault.value", "expect.0"),
]


@pytest.mark.long
@given(st.lists(st.tuples(st.sampled_from(KEYS), VALUES), min_size=1, max_size=2))
def test_anything_in_a_file_is_a_scenario_or_a_clear_refusal(changes: list[tuple[str, object]]) -> None:
    """No crash and no internal words, whatever stands where."""
    overrides = [f"{key}={write({'x': value}).partition(':')[2].strip()}" for key, value in changes]  # type: ignore[dict-item]
    said = ""
    try:
        scenario = load_scenario(SCENARIOS / "knee_freeze.yaml", overrides)
        assert parse_scenario(scenario.resolved_yaml()) == scenario
        assert describe(scenario)
    except FileErrors as error:
        said = str(error)
    assert not any(word in said for word in ("Input should", "pydantic", "dataclass", "Traceback", "_ns"))


# --- real time -------------------------------------------------------------------------------------------------------


def test_limits_of_real_time_are_one_percent_and_20_ms_unless_said() -> None:
    """A real-time run is invalid beyond 1 % of late cycles, or one that is late by more than 20 ms."""
    realtime = parse_scenario(PLAIN).realtime
    assert (realtime.late_share, realtime.late_worst_ns) == (0.01, 20_000_000)
    realtime = parse_scenario(PLAIN + "realtime: {late_share: 2.5 %, late_worst: 5 ms}\n").realtime
    assert (realtime.late_share, realtime.late_worst_ns) == (0.025, 5_000_000)


def test_limits_of_real_time_can_be_set_in_a_file_that_says_nothing_of_them() -> None:
    """`run --realtime --set realtime.late_share=2%`, and `check` with the same words."""
    for read in (load_scenario, load_any):
        found = read(SCENARIOS / "golden.yaml", ["realtime.late_share=2%"])
        assert isinstance(found, Scenario)
        assert (found.realtime.late_share, found.realtime.late_worst_ns) == (0.02, 20_000_000)


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ("{late_share: 1}", ""),
        ("{late_share: 0, late_worst: 0 s}", ""),
        ("{late_share: 101 %}", "allowed 0..1 or 0 %..100 %"),
        ("{late_worst: 20}", "20 has no unit"),
        ("{late_worst: -1 ms}", "negative"),
        ("{late_most: 20 ms}", "unknown key"),
    ],
)
def test_limits_of_real_time_are_checked(block: str, words: str) -> None:
    """Dense at the boundaries; what is wrong is named with its place."""
    text = f"{PLAIN}realtime: {block}\n"
    if not words:
        assert parse_scenario(parse_scenario(text).resolved_yaml()) == parse_scenario(text)
        return
    with pytest.raises(FileErrors, match=words):
        parse_scenario(text)
