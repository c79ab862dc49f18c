"""The pytest plug-in as its users meet it: pytest runs inside the test, with the plug-in loaded by name.

One module, although long: all tests share that way of running pytest.
"""

import subprocess
import sys
import xml.etree.ElementTree as ET
from importlib.metadata import entry_points
from pathlib import Path

import can
import pytest

import testbench.plugin.lockstep  # noqa: F401 (an inner run must not be the first to load MuJoCo: it unloads its modules)
from canopen_exo.bus.channel import Arrival, Channel
from canopen_exo.bus.interfaces import BusName
from canopen_exo.bus.node import ErrorState, PortState
from canopen_exo.errors import CanopenExoError
from testbench.plugin.hooks import best_bus, named_buses
from tests.parity.patience import Late, Patience, told_late

pytest_plugins = ["pytester"]

HEAVY = {"numpy", "mujoco", "pydantic", "can", "canopen", "cantools", "matplotlib", "pyarrow", "yaml"}
FAST = "--exo-set=rig.rate=100Hz"

SCENARIO = """
name: biased
rig: {plant: suspended, stops: off, rate: 250 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 7 s}
injectors:
  bias:
    target: {bus: to_controller, node: right_knee, signal: position}
    fault: {type: bias, value: 0.05 rad}
    event: {type: at, time: 1 s}
    effect: {type: constant_time, duration: 0.3 s}
"""


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inner runs load this plug-in by name, and none by entry point."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)


def run(pytester: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    """Pytest in this process."""
    return pytester.runpytest_inprocess("-p", "testbench.plugin.hooks", *arguments)


def run_apart(pytester: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    """Pytest in a process of its own."""
    return pytester.runpytest_subprocess("-p", "testbench.plugin.hooks", *arguments, timeout=120)


# ---- an environment that has it -------------------------------------------------------------------------------------


def test_the_entry_point_is_there() -> None:
    """pytest finds the plug-in wherever exo-hil is installed; `-p no:exo_hil` switches it off."""
    (found,) = (point for point in entry_points(group="pytest11") if point.name == "exo_hil")
    assert found.value == "testbench.plugin.hooks"


def test_loading_it_imports_nothing_heavy(pytester: pytest.Pytester) -> None:
    """It is loaded in every pytest run of the environment."""
    pytester.makepyfile(
        f"""
        import sys

        def test_nothing_heavy():
            assert not {sorted(HEAVY)} & sys.modules.keys()
        """.replace("[", "{").replace("]", "}")
    )
    run_apart(pytester, "--exo-bus=hub").assert_outcomes(passed=1)


@pytest.mark.long
def test_without_mujoco_only_the_test_that_asks_fails(pytester: pytest.Pytester) -> None:
    """The extra `sim` is optional: one line says what to install."""
    pytester.makeconftest("import sys\nsys.modules['mujoco'] = None")  # importing it raises ModuleNotFoundError
    pytester.makepyfile("def test_rig(exo): pass\ndef test_other(): pass")
    result = run_apart(pytester)
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*exo: mujoco is missing: pip install 'exo-hil[[]sim]'"])


# ---- which rig ------------------------------------------------------------------------------------------------------


def test_markers_say_which_rig_the_nearest_first(pytester: pytest.Pytester) -> None:
    """docs/pytest.md: scenario beside the test, rate, stops, seed, overrides; markers are joined key by key."""
    folder = pytester.mkpydir("suite")
    (folder / "biased.yaml").write_text(SCENARIO)
    (folder / "test_rigs.py").write_text(
        """
import pytest

pytestmark = pytest.mark.exo(scenario="biased.yaml", rate="100 Hz")

def test_of_the_module(exo):
    assert exo.scenario.name == "biased"
    assert exo.scenario.rig.cycle_ns == 10_000_000
    assert not exo.scenario.rig.stops

@pytest.mark.exo(rate="50 Hz", stops=True, seed=5, overrides=["motion.duration=3 s"])
def test_nearer(exo):
    assert exo.scenario.name == "biased"
    assert exo.scenario.rig.cycle_ns == 20_000_000
    assert exo.scenario.rig.stops
    assert (exo.scenario.seed, exo.scenario.motion.duration_ns) == (5, 3_000_000_000)
"""
    )
    run(pytester).assert_outcomes(passed=2)


def test_options_say_which_rig_where_no_marker_does(pytester: pytest.Pytester) -> None:
    """--exo-scenario from where pytest was called, --exo-set on top of everything."""
    pytester.path.joinpath("biased.yaml").write_text(SCENARIO)
    pytester.makepyfile(
        """
        import pytest

        def test_file(exo):
            assert (exo.scenario.name, exo.scenario.rig.cycle_ns, exo.bus) == ("biased", 20_000_000, "lockstep")

        @pytest.mark.exo(rate="500 Hz")
        def test_set_wins(exo):
            assert exo.scenario.rig.cycle_ns == 20_000_000
        """
    )
    run(pytester, "--exo-scenario=biased.yaml", "--exo-set=rig.rate=50Hz").assert_outcomes(passed=2)
    result = run(pytester)
    result.stdout.fnmatch_lines(["*('rig', 2000000, 'lockstep') == ('biased', *"])


@pytest.mark.parametrize(
    ("marker", "words"),
    [
        ("exo(rat='100 Hz')", "marker exo: 'rat' given, allowed keys: scenario, rate, stops, seed, overrides"),
        ("exo('100 Hz')", "marker exo: '100 Hz' without a key given, allowed keys: *"),
        ("exo(rate='3 Hz')", "*rig.rate=3 Hz: *3 Hz* is not a rate this rig can run at*"),
        ("exo(scenario='missing.yaml')", "*missing.yaml: no such file"),
        ("exo(overrides='seed=1')", "marker exo: overrides 'seed=1' given, allowed is a list such as*"),
    ],
)
def test_a_wrong_marker_fails_its_test_in_one_line(pytester: pytest.Pytester, marker: str, words: str) -> None:
    """What was given, what is allowed; no traceback through the plug-in."""
    pytester.makepyfile(f"import pytest\n@pytest.mark.{marker}\ndef test_rig(exo): pass\ndef test_other(): pass")
    result = run(pytester, "--strict-markers")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines([f"exo: {words}".replace("[", "[[]")])
    result.stdout.no_fnmatch_line("*hooks.py*")
    result.stdout.no_fnmatch_line("*During handling*")


@pytest.mark.parametrize(
    ("options", "words"), [(["--exo-bus=hub"], "start `exo-hil hub --timed`*"), ([], "name a bus*")]
)
def test_a_foreign_part_needs_buses_that_others_can_find(
    pytester: pytest.Pytester, options: list[str], words: str
) -> None:
    """Neither virtual time nor the hub of one test can be reached; what can is said."""
    pytester.makepyfile("def test_rig(exo): pass")
    result = run(pytester, "--exo-without=hlc", *options)
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines([f"exo: --exo-without hlc: *{words}"])


def test_a_duration_without_a_unit_is_refused_with_the_form_that_is_allowed(pytester: pytest.Pytester) -> None:
    """As in a scenario file: 0.1 of what?"""
    pytester.makepyfile("def test_rig(exo): exo.run_for(0.1)")
    result = run(pytester)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["E*duration 0.1 given, allowed is text with a unit: '0.1 s', '15 cycles'"])


@pytest.mark.long
def test_time_0_that_the_controller_has_said_cannot_be_said_again(pytester: pytest.Pytester) -> None:
    """`exo.gateway.start()` is for foreign controllers."""
    pytester.makepyfile("def test_rig(exo):\n    exo.run_until_motion()\n    exo.gateway.start()")
    result = run(pytester)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["E*FaultError: start: time 0 is known already*"])


@pytest.mark.parametrize(
    ("option", "buses"),
    [
        ("lockstep", None),
        ("hub", None),
        ("vcan", ("socketcan:vcan0", "socketcan:vcan1")),
        ("socketcan:can0,socketcan:can1", ("socketcan:can0", "socketcan:can1")),
        ("socketcan:can0,can1", ("socketcan:can0", "socketcan:can1")),
        ("pcan:A@500000,kvaser:0", ("pcan:A@500000", "kvaser:0")),
        ("hub:127.0.0.1:5000/a,hub:127.0.0.1:5000/b", ("hub:127.0.0.1:5000/a", "hub:127.0.0.1:5000/b")),
    ],
)
def test_buses_are_named_as_everywhere(option: str, buses: tuple[str, str] | None) -> None:
    """One bus syntax everywhere: INTERFACE:CHANNEL[@bitrate]; controller bus, then drive bus."""
    assert named_buses(option) == buses


@pytest.mark.parametrize(
    "option", ["can0", "socketcan:can0", "socketcan:can0,socketcan:can0", "socketcan:can0,can0@500000",
     "hub:drive,hub:127.0.0.1:29536/drive", "a:b,c:d,e:f", "", "x y:a,b"]
)
def test_a_bus_that_is_none_ends_the_run_before_any_test(pytester: pytest.Pytester, option: str) -> None:
    """A usage error that says what is allowed."""
    pytester.makepyfile("def test_other(): pass")
    result = run(pytester, f"--exo-bus={option}")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    allowed = "lockstep, hub, vcan, auto, or two buses such as"
    result.stderr.fnmatch_lines([f"ERROR: --exo-bus {option}: *allowed: {allowed}*"])


def test_where_the_rigs_run_is_said_only_when_it_was_chosen(pytester: pytest.Pytester) -> None:
    """A run that does not use the plug-in does not hear of it."""
    pytester.makepyfile("def test_other(): pass")
    run(pytester).stdout.no_fnmatch_line("*exo*hil*bus*")
    run(pytester, "--exo-bus=hub").stdout.fnmatch_lines(["exo-hil: bus hub"])


@pytest.mark.parametrize(
    ("missing", "down", "workers", "bus", "why"),
    [
        ("", "", 1, "vcan", "vcan0 and vcan1 can be opened"),
        ("vcan1", "", 1, "hub", "there is no vcan1"),
        ("", "vcan0", 1, "hub", "bus socketcan:vcan0: Network is down"),
        ("", "", 2, "hub", "vcan holds one rig at a time, and 2 processes run tests"),
    ],
)
def test_auto_is_vcan_where_that_can_be_opened_else_the_hub(
    missing: str, down: str, workers: int, bus: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The best bus available; an interface that is down is none."""

    class Interface(Channel):
        def receive(self) -> list[Arrival]:
            state = PortState(0, ErrorState.DOWN, 0, 0, "Network is down")
            return [Arrival(0, None, state)] if down and down in self.name else []

        def close(self) -> None:
            pass

    def open_one(name: BusName) -> Channel:
        if missing == name.channel:
            raise CanopenExoError(f"there is no {missing}")
        return Interface(str(name))

    monkeypatch.setattr("canopen_exo.bus.interfaces.open_channel", open_one)
    assert best_bus(workers) == (bus, why)


@pytest.mark.parametrize("found", ["hub", "vcan"])
def test_header_says_what_auto_has_chosen_and_the_rig_is_there(
    found: str, pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And why; the rig itself is not started here."""
    monkeypatch.setattr("testbench.plugin.hooks.best_bus", lambda workers: (found, "so"))
    buses = named_buses(found)
    pytester.makepyfile(f"def test_it(exo):\n    assert exo._setup.buses == {buses!r}\n")
    result = run(pytester, "--exo-bus=auto")
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines([f"exo-hil: bus {found} (auto: so)"])


def test_every_test_has_its_own_rig(pytester: pytest.Pytester) -> None:
    """Nothing of one test is left for the next."""
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.parametrize("number", [1, 2])
        def test_rig(exo, number):
            assert (exo.time_ns, exo.rows, exo.gateway.listing()) == (0, [], [])
            exo.gateway.inject(target={"bus": "to_drives", "pdo": "RPDO1"}, fault={"type": "drop"})
            exo.run_for("10 ms")
            assert exo.rows
        """
    )
    run(pytester, FAST).assert_outcomes(passed=2)


# ---- failure reports ------------------------------------------------------------------------------------------------

FAILING = """
import pytest

@pytest.mark.requirement("SAFE-1")
def test_fails(exo):
    exo.gateway.inject(target={"bus": "to_drives", "pdo": "RPDO1"}, fault={"type": "drop"}, name="silence")
    exo.run_for("0.52 s")
    exo.expect(0x456, within="10 ms")
"""


def logs(text: list[str]) -> list[Path]:
    """The paths of the candump logs in a report."""
    return [Path(line) for line in text if line.endswith((f"{Path('/')}controller.log", f"{Path('/')}drive.log"))]


@pytest.mark.long
def test_a_failed_test_shows_the_last_frames_of_both_buses_and_its_logs(pytester: pytest.Pytester) -> None:
    """Issue of every HIL run: what was on the bus. The logs are read here by python-can."""
    pytester.makepyfile(FAILING)
    result = run(pytester, FAST)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "E*AssertionError: no frame 456 on the drive bus within 10 ms, until 0.530000 s*",
            "*exo-hil: last frames of the controller bus*",
            "*    0.5????? s  77F  05                       heartbeat of the controller",
            "*exo-hil: last frames of the drive bus*",
            "*heartbeat left_hip",
            "*exo-hil: candump logs*",
            "*exo-hil: rig*",
            "scenario rig on lockstep, 0.530000 s after power-up",
            "master operational, controller silent",
            "silence  active    1 activations, * changed",
        ]
    )
    frames = [line for line in result.outlines if line[:12].strip().replace(".", "").isdigit() and line[12:14] == " s"]
    assert len(frames) == 2 * 20
    controller, drive = logs(result.outlines)
    for path in (controller, drive):
        messages = list(can.LogReader(str(path)))
        assert len(messages) > 100
        assert {message.channel for message in messages} == {path.stem}
    shown = [line.split()[2] for line in frames[20:]]
    assert shown == [f"{message.arbitration_id:03X}" for message in messages[-20:]]


def test_a_fixture_that_fails_is_reported_too_and_a_test_that_passes_leaves_no_log(pytester: pytest.Pytester) -> None:
    """The rig may fail on its way to the motion; what passes writes nothing."""
    pytester.makepyfile(
        """
        import pytest

        @pytest.fixture
        def walking(exo):
            exo.gateway.inject(target={"bus": "to_controller", "cob_id": 0x705}, fault={"type": "drop"})
            exo.run_until_motion()

        def test_set_up_fails(walking):
            pass

        def test_passes(exo):
            exo.run_for("10 ms")

        @pytest.mark.xfail
        def test_may_fail(exo):
            assert False
        """
    )
    result = run(pytester, FAST, f"--basetemp={pytester.path / 'temporary'}")
    result.assert_outcomes(passed=1, errors=1, xfailed=1)
    result.stdout.fnmatch_lines(["E*AssertionError: the motion has not begun until*boot-up message*"])
    assert result.stdout.str().count("exo-hil: last frames of the drive bus") == 1
    assert len(list((pytester.path / "temporary").glob("exo_*[0-9]"))) == 1


def test_a_log_that_cannot_be_written_is_said(pytester: pytest.Pytester) -> None:
    """A full disk must not hide why the test failed."""
    pytester.makeconftest(
        """
        import testbench.plugin.exo

        def full(self, folder):
            raise OSError(28, "No space left on device")

        def pytest_configure(config):
            config.mended = testbench.plugin.exo.Exo.write_logs
            testbench.plugin.exo.Exo.write_logs = full

        def pytest_unconfigure(config):
            testbench.plugin.exo.Exo.write_logs = config.mended
        """
    )
    pytester.makepyfile("def test_fails(exo):\n    assert False")
    result = run(pytester)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*cannot be written: *No space left on device*"])


# ---- requirement ids ------------------------------------------------------------------------------------------------


def properties(report: Path) -> dict[str, list[tuple[str, str]]]:
    """Properties of each test in a junit file."""
    return {
        str(case.get("name")): [(str(one.get("name")), str(one.get("value"))) for one in case.iter("property")]
        for case in ET.parse(report).iter("testcase")
    }


@pytest.mark.parametrize("family", ["xunit1", "xunit2"])
def test_junit_properties_name_the_requirements_whatever_the_outcome(pytester: pytest.Pytester, family: str) -> None:
    """One property for each id; of module, class and test, each once."""
    pytester.makepyfile(
        """
        import pytest

        pytestmark = pytest.mark.requirement("ALL")

        @pytest.mark.requirement("CLASS", "ALL")
        class TestThem:
            @pytest.mark.requirement("A-1", "A-2")
            def test_passes(self): pass

        @pytest.mark.requirement("B")
        def test_fails(): assert False

        @pytest.mark.skip
        @pytest.mark.requirement("C")
        def test_skipped(): pass
        """
    )
    result = run(pytester, "--junitxml=report.xml", "-o", f"junit_family={family}", "--strict-markers")
    result.assert_outcomes(passed=1, failed=1, skipped=1)
    found = properties(pytester.path / "report.xml")
    assert {name: {value for _, value in them} for name, them in found.items()} == {
        "test_passes": {"A-1", "A-2", "CLASS", "ALL"},
        "test_fails": {"B", "ALL"},
        "test_skipped": {"C", "ALL"},
    }
    assert len(found["test_passes"]) == 4
    assert {key for them in found.values() for key, _ in them} == {"requirement"}


@pytest.mark.parametrize("marker", ["requirement", "requirement()", "requirement(12)", "requirement(id='A')"])
def test_a_requirement_without_an_id_ends_the_run(pytester: pytest.Pytester, marker: str) -> None:
    """A test that was to verify something must not pass for nothing."""
    pytester.makepyfile(f"import pytest\n@pytest.mark.{marker}\ndef test_other(): pass")
    result = run(pytester)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: *::test_other: requirement: give one or more ids as texts*"])


# ---- pytest-xdist ---------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_reports_and_properties_come_through_xdist(pytester: pytest.Pytester) -> None:
    """Sections and properties travel from the worker."""
    pytester.makepyfile(FAILING + "\ndef test_passes(exo):\n    exo.run_for('10 ms')\n")
    result = run_apart(pytester, "-p", "xdist", "-n2", FAST, "--junitxml=report.xml")
    result.assert_outcomes(passed=1, failed=1)
    assert len(logs(result.outlines)) == 2
    assert all(path.exists() for path in logs(result.outlines))
    found = properties(pytester.path / "report.xml")["test_fails"]
    assert [key for key, _ in found] == ["requirement", "exo_candump_log", "exo_candump_log"]


@pytest.mark.long
def test_a_named_bus_holds_one_rig_at_a_time(pytester: pytest.Pytester) -> None:
    """Two rigs on one interface would answer each other."""
    pytester.makepyfile("def test_one(exo): pass\ndef test_other(): pass")
    result = run_apart(pytester, "-p", "xdist", "-n2", "--exo-bus=vcan")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*exo: --exo-bus vcan: one rig at a time fits on it; run without -n, or with -n 1"])


# ---- against the clock ----------------------------------------------------------------------------------------------

REAL = """
def test_real(exo):
    exo.run_until_motion()
    fault = exo.gateway.inject(
        target={"bus": "to_controller", "node": "right_knee", "signal": "position"},
        fault={"type": "bias", "value": "0.05 rad"},
        duration="0.2 s",
    )
    exo.run_until(lambda: fault.row.manifested > 5, within="2 s")
    difference = exo.controller.drives["right_knee"].position_rad - exo.drives["right_knee"].position_rad
    print("timing", exo.timing)
    exo.run_until(lambda: not fault.is_active, within="2 s")
    exo.send(0x123, bytes(2), bus="drive")
    exo.expect(0x123, within="1 s", bus="controller")
    assert 0 < exo.deviation("right_knee").rmse_position_rad < 0.1
    assert 0.01 < difference < 0.1  # 0.05 and what the knee moved between two frames
    try:
        exo.plant
    except Exception as error:
        assert "only lock-step" in str(error)
"""


@pytest.mark.realtime
def test_the_same_words_drive_a_rig_on_the_hub(pytester: pytest.Pytester, patience: Patience) -> None:
    """Injection, expectation, sending, golden comparison on processes; a busy machine skips, it does not fail."""
    pytester.makepyfile(REAL)

    def attempt() -> Late | None:
        result = run_apart(pytester, "--exo-bus=hub", FAST)
        if result.ret == pytest.ExitCode.OK:
            return None
        late = told_late(result.stdout.str(), 10.0)
        assert late, result.stdout.str()
        return Late("; ".join(late))

    patience.until_punctual(attempt)


@pytest.mark.realtime
def test_a_bus_that_is_not_there_fails_the_test_in_a_line(pytester: pytest.Pytester) -> None:
    """One line that says what is missing, and nothing of a rig that never was."""
    pytester.makepyfile("def test_rig(exo):\n    exo.run_for('1 s')")
    result = run_apart(pytester, "--exo-bus=socketcan:exo_none0,exo_none1")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        ["*= FAILURES =*", "*_ test_rig _*", "bus socketcan:exo_none0: *", "*= short test*"], consecutive=True
    )


def test_the_plug_in_is_no_burden_to_a_process_without_pytest() -> None:
    """`exo-hil` itself never loads it."""
    code = "import sys, testbench.cli; assert 'pytest' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("asked", [False, True])
def test_fifo_is_asked_for_where_the_command_line_says_so(pytester: pytest.Pytester, asked: bool) -> None:
    """`--exo-fifo` reaches the processes of the rig; the rig itself is not started here."""
    pytester.makepyfile(f"def test_it(exo):\n    assert exo._setup.fifo is {asked}\n")
    run(pytester, "--exo-bus", "hub", *(["--exo-fifo"] if asked else [])).assert_outcomes(passed=1)


def test_control_frames_of_the_command_line_reach_the_rig(pytester: pytest.Pytester) -> None:
    """`--exo-control-frames`, on every kind of bus; wrong ones fail the test in a line."""
    pytester.makepyfile("def test_it(exo):\n    assert exo._setup.control_frames == 'drive'\n")
    run(pytester, "--exo-bus=hub", "--exo-control-frames=drive").assert_outcomes(passed=1)
    pytester.makepyfile("def test_it(exo):\n    assert exo._injectors._frames.command_id == 0x6C2\n")
    run(pytester, "--exo-control-frames=drive:0x6C2,0x6C3").assert_outcomes(passed=1)
    wrong = run(pytester, "--exo-control-frames=middle")
    wrong.assert_outcomes(errors=1)
    wrong.stdout.fnmatch_lines(["*allowed is controller or drive*"])


@pytest.mark.long
def test_a_rig_that_was_late_is_warned_of_though_its_test_has_passed(pytester: pytest.Pytester) -> None:
    """The limits of the scenario, as a run has them; whoever wants a failure makes an error of the warning."""
    pytester.makeconftest("from testbench.plugin.lockstep import LockStepExo\nLockStepExo.lateness = 'too late'")
    pytester.makepyfile("def test_it(exo): pass")
    result = run_apart(pytester)
    result.assert_outcomes(passed=1, warnings=1)
    result.stdout.fnmatch_lines(["*LateRigWarning: too late"])
    run_apart(pytester, "-W", "error::testbench.plugin.hooks.LateRigWarning").assert_outcomes(passed=1, errors=1)
