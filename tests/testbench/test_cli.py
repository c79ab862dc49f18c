"""The command line seen from outside: what is printed where, exit codes, the result folder, help."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from PIL import Image

from testbench.cli import main
from testbench.scenario import JOINT_NAMES, load_scenario
from testbench.store import FILES, default_folder
from tests.testbench.command_line import GOLDEN, KNEE, PROGRAM, RESULT, ROOT, SHORT, exo_hil, forbid_runs, names


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """A short faulted run, printed as JSON, into the default place: the directory it began in, and the process."""
    folder = tmp_path_factory.mktemp("short")
    return folder, exo_hil(folder, "run", KNEE, "--json", *SHORT)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def nothing_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    forbid_runs(monkeypatch)


# --- what is printed -----------------------------------------------------------------------------------------------


def refuse_constant(text: str) -> float:
    raise AssertionError(f"{text} is not JSON")


@pytest.mark.run
def test_stdout_is_one_strict_json_document_and_stderr_the_talk(
    short: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    """Design: stdout = result (`--json`: one JSON document), stderr = talk; no NaN, no Infinity."""
    folder, done = short
    document = json.loads(done.stdout, parse_constant=refuse_constant)
    assert isinstance(document, dict)
    assert done.stdout.endswith("}\n")
    assert done.stderr == f"result folder: {folder / 'results' / RESULT}\n"


HASH = re.compile(r"[0-9a-f]{64}")
NUMBER = (int, float)
JOINT_KEYS = (
    *("rmse_position_rad", "rmse_velocity_rad_s", "rmse_torque_nm"),
    *("min_angle_deg", "max_angle_deg", "max_speed_rpm", "max_torque_nm"),
)


def check_types(entry: dict[str, object], types: dict[str, type | tuple[type, ...]]) -> None:
    """Every key is there with its type; a switch is no number."""
    for key, kind in types.items():
        assert isinstance(entry[key], kind), key
        assert kind is bool or not isinstance(entry[key], bool), key


@pytest.mark.run
def test_document_has_the_keys_of_the_design(short: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    """Design, "Command line": the keys that `run --json` prints at least, with their types."""
    document = json.loads(short[1].stdout)
    check_types(document, {"scenario": str, "seed": int, "valid": bool, "verdict": str, "outcome": str})
    check_types(document, dict.fromkeys(("sim_time_s", "wall_time_s", "x_realtime"), NUMBER))
    check_types(document, dict.fromkeys(("bus", "trace_hash", "joints", "golden"), dict))
    check_types(document, dict.fromkeys(("injections", "errors", "failures"), list))
    assert document["verdict"] in ("pass", "fail")
    assert document["x_realtime"] == pytest.approx(document["sim_time_s"] / document["wall_time_s"])
    assert set(document["bus"]) == {"controller", "drive"}
    for bus in document["bus"].values():
        check_types(bus, {"frames": int, "load": float})
    assert set(document["trace_hash"]) == {"golden", "faulted"}
    assert all(HASH.fullmatch(text) for text in document["trace_hash"].values())
    assert list(document["joints"]) == list(JOINT_NAMES)
    for joint in document["joints"].values():
        check_types(joint, dict.fromkeys(JOINT_KEYS, NUMBER))
    check_types(document["golden"]["tracking_rmse_rad"], dict.fromkeys(JOINT_NAMES, NUMBER))
    assert len(document["injections"]) == 2
    for injection in document["injections"]:
        check_types(injection, {"injector": str, "signal": str, "cause": str, "frames": int})
        check_types(injection, {"start_s": NUMBER, "end_s": NUMBER})


@pytest.mark.run
def test_errors_and_failures_have_the_keys_of_the_design(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """errors: joint, kind, time, value, limit; failures the same; a failure ends in exit code 1."""
    monkeypatch.chdir(tmp_path)
    freeze = [*SHORT, "--set", "injectors.freeze_position.event.time=0.7s", "--set", "motion.duration=1.2s"]
    longer = [f"injectors.{name}.effect.duration=0.4s" for name in ("freeze_position", "zero_velocity")]
    assert main(["run", KNEE, "--json", *freeze, "--set", longer[0], "--set", longer[1], "--out", "r"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert (document["verdict"], document["outcome"]) == ("fail", "failure")
    assert document["errors"]
    assert document["failures"]
    for entry in (*document["errors"], *document["failures"]):
        check_types(entry, {"joint": str, "kind": str, "time_s": NUMBER, "value": NUMBER, "limit": NUMBER})
        assert entry["joint"] in JOINT_NAMES
        assert 0 <= entry["time_s"] <= 1.2
    assert {entry["kind"] for entry in document["errors"]} <= {"torque", "speed"}
    assert {entry["kind"] for entry in document["failures"]} <= {"min_angle", "max_angle"}


@pytest.mark.run
def test_seed_and_set_change_what_is_run(short: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    """`--seed N` instead of the scenario's; `--set` by dotted path, injectors by name, for run as for the record."""
    folder, done = short
    document = json.loads(done.stdout)
    assert document["seed"] == 7
    assert document["duration_s"] == 0.5
    for injection in document["injections"]:
        assert injection["start_s"] == pytest.approx(0.1, abs=1e-9)  # times are whole ns, told in s
        assert injection["end_s"] == pytest.approx(0.3, abs=1e-9)
        assert injection["frames_seen"] == 100  # 0.2 s at 500 Hz
    read = load_scenario(folder / "results" / RESULT / "scenario.yaml")
    assert read == load_scenario(KNEE, ["seed=7", *SHORT[3::2]])
    assert read.injectors["freeze_position"].effect.words() == "for 0.2 s"


# --- the result folder ---------------------------------------------------------------------------------------------


@pytest.mark.run
def test_result_folder_holds_what_the_design_lists(short: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    """scenario.yaml, summary.json, a candump log per bus, joint traces as Parquet, plots as PNG; nothing beside it."""
    folder, done = short
    result = folder / "results" / RESULT
    assert done.returncode == 0, done.stderr
    assert names(folder) == ["results"]
    assert names(folder / "results") == [RESULT]
    assert set(names(result)) == FILES
    assert (result / "summary.json").read_text(encoding="utf-8") == done.stdout
    for path in result.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
        with Image.open(path) as image:
            image.verify()
    for path in result.glob("*.parquet"):
        data = path.read_bytes()
        assert data[:4] == data[-4:] == b"PAR1"
    for path in result.glob("*.log"):
        assert path.read_text(encoding="ascii").startswith("(")


# --- exit codes ----------------------------------------------------------------------------------------------------


@pytest.mark.run
@pytest.mark.parametrize(
    ("expectation", "code", "verdict", "why"),
    [("injections == 0", 0, "PASS", ""), ("injections == 1", 1, "FAIL", "; 1 of 1 expectations not met")],
)
def test_exit_code_is_the_verdict(
    place: Path, capsys: pytest.CaptureFixture[str], expectation: str, code: int, verdict: str, why: str
) -> None:
    """0 pass, 1 fail, as for an `expect:` line that is met or not; without --json the text says so first."""
    short = ["--set", "motion.duration=0.1s", "--set", f"expect=[{expectation}]"]
    assert main(["run", GOLDEN, *short]) == code
    captured = capsys.readouterr()
    assert captured.out.startswith(f"{verdict}  golden, seed 2020: no fault was activated{why}\n")
    folder = default_folder("golden", 2020, short[1::2])
    assert folder != default_folder("golden", 2020)  # a changed scenario does not replace the result of the file
    assert captured.err == f"result folder: {place / folder}\n"


DEAF = """\
name: deaf
rig: {plant: suspended, stops: off}
motion: {gait: walking, stride: 1.5 s, duration: 0.1 s}
injectors:
  silence:
    from: power_up
    target: {bus: to_controller, cob_id: COB_ID}
    fault: {type: drop}
    event: {type: at, time: 0 s}
    effect: {type: infinite}
"""


@pytest.mark.run
@pytest.mark.parametrize(
    ("cob_id", "said"),
    [
        ("0x585", "right_knee (node 5): no SDO answer within 0.5 s while reading device type (1000:00)"),
        ("0x705", "right_knee (node 5): no boot-up message within"),
        ("0x285", "right_knee: not in Operation enabled after 2 s: no statusword (TPDO2) came"),
    ],
    ids=["SDO answers", "boot-up", "statusword"],
)
def test_rig_that_cannot_start_is_invalid_and_names_the_drive(
    place: Path, capsys: pytest.CaptureFixture[str], cob_id: str, said: str
) -> None:
    """Exit 3: nothing was proved; which drive did not answer, to what, and in which of the two runs. No result."""
    (place / "deaf.yaml").write_text(DEAF.replace("COB_ID", cob_id))
    assert main(["run", "deaf.yaml", "--json"]) == 3
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("deaf: run invalid: faulted run: the motion never began: ")
    assert said in captured.err
    assert captured.err.count("\n") == 1
    assert names(place) == ["deaf.yaml"]


# --- check, help -------------------------------------------------------------------------------------------


def test_check_says_what_a_scenario_will_do_and_runs_nothing(
    place: Path, capsys: pytest.CaptureFixture[str], nothing_runs: None
) -> None:
    """`check FILE`: in words, with overrides applied; warnings go to stderr."""
    late = "injectors.freeze_position.event.time=9s"
    assert main(["check", KNEE, "--set", "injectors.zero_velocity.effect.duration=0.5s"]) == 0
    captured = capsys.readouterr()
    assert "position of right_knee (0x185, to_controller) held at its last value for 0.3 s" in captured.out
    assert "reads 0 rpm for 0.5 s; starts when freeze_position is activated" in captured.out
    assert captured.err == ""
    assert main(["check", KNEE, "--set", late]) == 0
    warnings = capsys.readouterr().err.splitlines()
    assert warnings[0] == "warning: injectors.freeze_position.event: 9 s comes after the motion has ended at 7 s"
    assert warnings[1].startswith("warning: injectors.zero_velocity: will stay silent")
    assert names(place) == []


def shown(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return captured.out


@pytest.mark.parametrize(
    ("verb", "words"),
    [
        ("run", ["SCENARIO.yaml", "--seed N", "--out DIR", "--set KEY=VALUE", "--json", "results/NAME-SEED"]),
        ("check", ["FILE", "--set KEY=VALUE"]),
        ("export", ["eds", "dbc", "schema"]),
    ],
)
def test_help_of_a_verb_names_all_it_takes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, verb: str, words: list[str]
) -> None:
    """`exo-hil VERB --help`: every option with what it is for; `exo-hil --help` lists the verb and the exit codes."""
    monkeypatch.setenv("COLUMNS", "100")
    text = shown(capsys, verb, "--help")
    assert f"exo-hil {verb}" in text
    for word in words:
        assert word in text
    rows = re.findall(r"^  (\S.*)$", text, re.MULTILINE)
    assert all(re.search(r"\S  +\S", row) or len(row) > 22 for row in rows), rows  # no option without a word about it
    general = shown(capsys, "--help")
    assert re.search(rf"^    {verb} +\w", general, re.MULTILINE)
    assert "0 pass, 1 verdict fail, 2 usage or bad file, 3 run invalid" in " ".join(general.split())


def test_version_is_the_projects(capsys: pytest.CaptureFixture[str]) -> None:
    """`exo-hil --version` says what is installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert shown(capsys, "--version") == f"exo-hil {project['version']}\n"


@pytest.mark.long
def test_reader_that_has_left_changes_nothing(place: Path) -> None:
    """`exo-hil export schema | head -1`: no traceback, the exit code of the verb."""
    command = [sys.executable, "-c", PROGRAM, "export", "schema"]
    process = subprocess.Popen(command, cwd=place, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == ""
    process.stderr.close()
    assert process.wait(timeout=60) == 0


def test_a_bit_rate_of_a_hub_without_bit_time_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """docs/hub.md: not silently ignored."""
    assert main(["hub", "--listen", "127.0.0.1:0", "--bitrate", "500000"]) == 2
    assert "add --timed" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["up", "campaign run", "fault list"])
def test_an_option_that_a_verb_does_not_know_shows_what_it_takes(
    capsys: pytest.CaptureFixture[str], verb: str
) -> None:
    """Its own usage, not that of the whole program."""
    with pytest.raises(SystemExit) as raised:
        main([*verb.split(), "x", "--rate=100Hz"])
    said = capsys.readouterr().err
    assert raised.value.code == 2
    assert said.startswith(f"usage: exo-hil {verb.split()[0]}")
    assert f"unrecognized arguments: --rate=100Hz; `exo-hil {verb.split()[0]}" in said


def test_options_of_real_time_are_refused_by_the_names_that_were_given(capsys: pytest.CaptureFixture[str]) -> None:
    """And no others."""
    assert main(["run", GOLDEN, "--without", "hlc", "--fifo"]) == 2
    assert capsys.readouterr().err == "--without, --fifo: are of real time; add --realtime\n"


@pytest.mark.parametrize(
    ("word", "done", "said"),
    [
        ("trigger x", True, "x: triggered\n"),
        ("trigger x", False, "x: not triggered, it is active, or waits for a value, already\n"),
        ("arm x", True, "x: armed\n"),
        ("disarm x", True, "x: disarmed\n"),
        ("start", True, "time 0 is now\n"),
        ("stop", True, "injection is stopped, every frame passes; `exo-hil fault resume` resumes\n"),
        ("resume", True, "injection goes on\n"),
    ],
)
def test_each_word_of_live_control_says_what_it_did(
    word: str, done: bool, said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also that a trigger was ignored."""
    monkeypatch.setattr("fi_gateway.control_socket.ask", lambda *given: {"ok": True, "done": done})
    assert main(["fault", *word.split()]) == 0
    assert capsys.readouterr().out == said


def test_run_of_a_campaign_names_the_command_for_it(capsys: pytest.CaptureFixture[str]) -> None:
    """One line with the remedy, not a list of keys that a scenario does not have."""
    path = str(ROOT / "campaigns" / "bit_flips.yaml")
    assert main(["run", path]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"{path}: this is a campaign; `exo-hil campaign run {path}` runs it\n")
