"""Bad input: exit 2, the place, what was found and what is allowed; nothing written, no traceback, nothing run.

In the table the sign § stands before the character that the complaint must point at; it is not part of the file.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import testbench.run
from testbench.cli import main

BASE = """\
name: freeze
rig: {plant: suspended, stops: off, rate: 500 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 7 s}
seed: 2020
injectors:
  freeze:
    target: {bus: to_controller, node: right_knee, signal: position}
    fault: {type: stuck_at}
    event: {type: at, time: 3 s}
    effect: {type: constant_time, duration: 0.3 s}
  zero:
    target: {bus: to_controller, node: right_knee, signal: velocity}
    fault: {type: stuck_at_value, value: 0 rpm}
    event: {type: never}
    effect: {type: constant_time, duration: 0.3 s}
    trigger: {any: [freeze], on: activated}
expect:
  - failures == 0
"""

INJECTORS = BASE[BASE.index("injectors:") :]

# what is wrong; what of BASE is changed, and into what; words of the complaint
TABLE: list[tuple[str, ...]] = [
    # --- keys
    ("unknown key", "seed:", "§sede: 1\nseed:", "sede: unknown key", "did you mean 'seed'", "allowed: name, rig"),
    ("misspelt key", "at, time", "at, §tiem", "tiem: at has no such key", "did you mean 'time'", "type, time, times"),
    ("key missing", "rig: {plant: suspended, stops: off,", "§rig: {plant: suspended,", "rig.stops", "plant, stops"),
    ("key given twice", "seed: 2020", "seed: 2020\n§seed: 2021", "seed: given twice", "first at 4:1"),
    ("injector given twice", "  zero:", "  §freeze:", "injectors.freeze: given twice", "first at 6:3"),
    ("key of a later version", "{plant:", "{§file: rig.yaml, plant:", "file: not available yet", "plant, stops"),
    # --- quantities
    ("wrong unit", "duration: 7 s", "duration: §7 deg", "'7 deg' is an angle", "a duration is wanted", "s, ms, us"),
    ("unknown unit", "rate: 500 Hz", "rate: §500 herz", "unknown unit 'herz'", "Hz, kHz"),
    ("missing unit", "stride: 1.5 s", "stride: §1.5", "1.5 has no unit", "s, ms, us, ns, min"),
    ("missing unit of a signal", "value: 0 rpm", "value: §0", "velocity of right_knee", "0 has no unit", "rpm"),
    ("missing unit in an expectation", "failures == 0", "§golden.tracking_rmse < 0.01", "'0.01' has no unit", "rad"),
    ("not a number: .nan", "stride: 1.5 s", "stride: §.nan", ".nan is not a finite number"),
    ("not a number: .inf", "seed: 2020", "seed: §.inf", ".inf is not a finite number"),
    ("not a number: -.inf", "value: 0 rpm", "value: §-.Inf", "-.Inf is not a finite number"),
    ("not a number: 1e999", "seed: 2020", "seed: §1e999", "1e999 is not a finite number"),
    ("not a number: nan s", "duration: 0.3 s", "duration: §nan s", "'nan s' is not a duration", "for example '0.3 s'"),
    ("not a number: inf rpm", "value: 0 rpm", "value: §inf rpm", "'inf rpm' is not an angular velocity", "deg/s, rpm"),
    # --- ranges
    ("beyond the signal", "value: 0 rpm", "value: §1e9 rpm", "1e9 rpm is more than", "allowed -102944..102944 rad/s"),
    ("no length", "duration: 0.3 s", "duration: §0 s", "'0 s' is not a length of time", "more than 0 s"),
    ("negative length", "duration: 7 s", "duration: §-7 s", "'-7 s' is not a length of time", "more than 0 s"),
    ("negative time", "time: 3 s", "time: §-1 ms", "'-1 ms' is negative", "from 0 s up"),
    ("stride too short", "stride: 1.5 s", "stride: §0.4 s", "0.4 s given", "0.5 s..20 s"),
    ("stride of no whole cycles", "stride: 1.5 s", "stride: §1501 ms", "control cycles of 2 ms", "1.5 s or 1.502 s"),
    ("negative seed", "seed: 2020", "seed: §-1", "got -1", "whole number 0..9223372036854775807"),
    ("fractional seed", "seed: 2020", "seed: §1.5", "got 1.5", "whole number 0.."),
    ("share above 1", "at, time: 3 s}", "failure_probability, p: §2, per: 1 ms}", "2 is not a probability", "0..1"),
    # --- the rig
    ("too much for the bus", "rate: 500 Hz", "rate: §1000 Hz", "load 153 %", "at most 100 %", "lower the rate"),
    ("rate off the grid", "rate: 500 Hz", "rate: §333 Hz", "'333 Hz'", "500, 250, 200, 125, 100, 62.5 or 50 Hz"),
    ("plant of a later version", "suspended", "§walking", "'walking' is not available yet", "available: suspended"),
    # --- targets, faults, triggers
    ("unknown joint", "right_knee", "§right_kne", "unknown joint 'right_kne'", "did you mean 'right_knee'", "left_hip"),
    ("unknown signal", "position", "§positoin", "unknown signal 'positoin'", "did you mean 'position'", "velocity"),
    ("signal the other way", "to_controller", "§to_drives", "position of right_knee does not travel to_drives"),
    ("unknown direction", "to_controller", "§to_master", "unknown bus 'to_master'", "to_controller, to_drives, both"),
    ("unknown fault", "stuck_at}", "§stuckat}", "unknown fault 'stuckat'", "did you mean 'stuck_at'", "bit_flip"),
    ("payload fault on a bus", "{bus: to_controller,", "{wire: §drive, bus: both,", "only wire faults (bit_error"),
    ("whole-frame fault on a signal", "stuck_at}", "§drop}", "drop loses whole frames", "give pdo instead of position"),
    ("unknown trigger", "[freeze]", "[§freze]", "no injector is called 'freze'", "did you mean 'freeze'", "zero"),
    (
        "circle of triggers",
        "fault: {type: stuck_at}",
        "trigger: {any: §[zero]}\n    fault: {type: stuck_at}",
        "triggers go round in a circle: freeze -> zero -> freeze",
    ),
    ("injector that triggers itself", "[freeze]", "§[zero]", "triggers go round in a circle: zero -> zero"),
    # --- types
    ("injectors as a list", INJECTORS, "injectors: §[a, b]\n", "expected a mapping of names", "got a list"),
    ("injectors as a word", INJECTORS, "injectors: §none\n", "expected a mapping of names", "got 'none'"),
    ("injectors without any", INJECTORS, "injectors:§\n", "expected a mapping of names", "got nothing"),
    ("fault as a word", "{type: stuck_at}", "§stuck_at", "expected a mapping with type", "stuck_at | stuck_at_value"),
    ("expectations as a word", "expect:\n  - ", "expect: §", "expected a list", "got 'failures == 0'"),
    ("text for a switch", "trigger:", "enabled: §yes\n    trigger:", "expected true or false", "got 'yes'"),
    ("a list as the file", BASE, "§- a\n", "expected a mapping with name, rig, motion", "got a list"),
    ("a word as the file", BASE, "§hello\n", "expected a mapping with name, rig, motion", "got 'hello'"),
    # --- YAML
    ("bracket not closed", "2020\ninjectors:", "[2020\ninjectors§:", "the '[' of line", "is not closed"),
    ("two colons", "seed: 2020", "seed: a§: b", "a second ': ' in one line", "quotes"),
    ("tab", "seed: 2020", "§\tseed: 2020", "a tab", "indent with spaces"),
    ("two documents", "  - failures == 0\n", "  - failures == 0\n§---\nname: b\n", "a second document", "one document"),
    ("anchor", "seed: 2020", "seed: §&a 2020", "anchors (&a) are not used here"),
    ("empty file", BASE, "§", "the file is empty"),
    ("only comments", BASE, "§# nothing here\n", "the file is empty"),
]


def changed(*pairs: tuple[str, str]) -> str:
    """BASE with changes, each at the first place of what it changes."""
    text = BASE
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


@pytest.fixture(autouse=True)
def nothing_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Bad input is refused before the simulation; the working directory is an empty one."""

    def run(*arguments: object) -> None:
        raise AssertionError("the scenario was run")

    monkeypatch.setattr(testbench.run, "run_scenario", run)
    monkeypatch.chdir(tmp_path)


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """stderr of a command line that must be refused as bad input."""
    before = {path: path.read_bytes() if path.is_file() else b"" for path in Path().rglob("*")}
    code = main(arguments)
    captured = capsys.readouterr()
    assert code == 2
    assert captured.out == ""
    assert "Traceback" not in captured.err
    assert {path: path.read_bytes() if path.is_file() else b"" for path in Path().rglob("*")} == before
    return captured.err


@pytest.mark.parametrize("row", TABLE, ids=[row[0] for row in TABLE])
def test_bad_file_is_refused_at_its_place(capsys: pytest.CaptureFixture[str], row: tuple[str, ...]) -> None:
    """`path:line:col`, what was found, what is allowed; the same from run and check."""
    _, old, new, *said = row
    text = changed((old, new))
    at = text.index("§")
    line, column = text.count("\n", 0, at) + 1, at - text.rfind("\n", 0, at)
    Path("bad.yaml").write_text(text.replace("§", ""), encoding="utf-8")
    message = refused(capsys, "check", "bad.yaml")
    pointed = [one for one in message.splitlines() if one.startswith(f"bad.yaml:{line}:{column}: ")]
    assert pointed, message
    for words in said:
        assert words in pointed[0]
    assert refused(capsys, "run", "bad.yaml") == message


def test_bases_of_the_table_are_good(capsys: pytest.CaptureFixture[str]) -> None:
    """What the table changes is refused for the change alone."""
    for text in (BASE, BASE.replace(INJECTORS, "")):
        Path("good.yaml").write_text(text, encoding="utf-8")
        assert main(["check", "good.yaml"]) == 0
        assert capsys.readouterr().err == ""


def test_all_that_is_wrong_with_a_file_is_told_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    """One complaint a line, in the order of the file, whatever kind of mistake."""
    text = changed(
        ("rate: 500 Hz", "rate: 1000 Hz"),
        ("stride: 1.5 s", "stride: 1.5"),
        ("seed: 2020", "seed: -1"),
        ("node: right_knee, signal: position", "node: knee, signal: position"),
        ("{type: at, time: 3 s}", "{type: at, tiem: 3 s}"),
        ("value: 0 rpm", "value: 0 N m"),
        ("any: [freeze]", "any: [thaw]"),
        ("failures == 0", "failures == none"),
    )
    Path("bad.yaml").write_text(text, encoding="utf-8")
    rows = refused(capsys, "check", "bad.yaml").splitlines()
    places = [re.match(r"bad\.yaml:(\d+):(\d+): ([\w.]+): ", row) for row in rows]
    assert all(places), rows
    assert [place[3] for place in places if place] == [
        "rig.rate",
        "motion.stride",
        "seed",
        "injectors.freeze.target.node",
        "injectors.freeze.event.tiem",
        "injectors.zero.fault.value",
        "injectors.zero.trigger.any.0",
        "expect.0",
    ]
    order = [(int(place[1]), int(place[2])) for place in places if place]
    assert order == sorted(order)


def test_missing_file_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    """No place in a file that is not there; its name is said."""
    for verb in ("run", "check"):
        assert refused(capsys, verb, "nowhere.yaml") == "nowhere.yaml: no such file\n"


def test_directory_instead_of_a_file_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    """A folder is not read for the files in it."""
    Path("folder").mkdir()
    for verb in ("run", "check"):
        assert refused(capsys, verb, "folder") == "folder: this is a directory; give a YAML file\n"


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\xff\xfe\x00n", "bad.yaml:1:1: byte 0xff is not UTF-8"),
        (b"name: a\nrig: \x07\n", "bad.yaml:2:6: character U+0007 is not allowed in YAML"),
        (b"#" * 1_000_001, "bad.yaml: larger than 1000 kB"),
    ],
    ids=["not UTF-8", "control character", "too large"],
)
def test_file_that_is_no_text_is_told(capsys: pytest.CaptureFixture[str], data: bytes, said: str) -> None:
    """Any bytes may be given by mistake: a log, an archive."""
    Path("bad.yaml").write_bytes(data)
    for verb in ("run", "check"):
        assert refused(capsys, verb, "bad.yaml").startswith(said)


OVERRIDES = [
    ("injectors.freez.effect.duration=0.5s", ["no 'freez' in injectors", "did you mean 'freeze'"]),
    ("injector.freeze.effect.duration=0.5s", ["no 'injector'", "did you mean 'injectors'"]),
    ("injectors.freeze.effect.length=0.5s", ["constant_time has no such key", "type, duration"]),
    ("sede=1", ["unknown key", "did you mean 'seed'"]),
    ("seed.x=1", ["seed is a single value and has no 'x'"]),
    ("expect.5=failures == 0", ["expect has items 0..0", "'5'"]),
    ("injectors.freeze.effect.duration=0.5", ["0.5 has no unit", "s, ms, us, ns, min"]),
    ("motion.duration=", ["expected a duration, got nothing"]),
    ("motion.duration=[", ["YAML syntax"]),
    ("motion.duration=.nan", [".nan is not a finite number"]),
    ("rig.rate=1000 Hz", ["load 153 %", "at most 100 %"]),
    ("seed=-1", ["got -1", "0..9223372036854775807"]),
    ("motion.duration", ["expected key=value", "motion.duration=7s"]),
    ("=1", ["expected key=value"]),
    ("motion..duration=1 s", ["expected key=value"]),
]


@pytest.mark.parametrize(("override", "said"), OVERRIDES, ids=[row[0] for row in OVERRIDES])
def test_bad_override_is_told_as_it_was_typed(
    capsys: pytest.CaptureFixture[str], override: str, said: list[str]
) -> None:
    """`--set`: no line to point at, so the option itself is repeated, with what is wrong."""
    Path("good.yaml").write_text(BASE, encoding="utf-8")
    message = refused(capsys, "check", "good.yaml", "--set", override)
    assert message.startswith(f"--set {override}: ")
    for words in said:
        assert words in message
    assert refused(capsys, "run", "good.yaml", "--set", override) == message


@pytest.mark.parametrize("seed", ["-1", "1.5", "1e3", "text", "", "true", "[1]", "9223372036854775808"])
def test_bad_seed_is_told_as_it_was_typed(capsys: pytest.CaptureFixture[str], seed: str) -> None:
    """`--seed`: a whole number from 0; the message speaks of the option that was typed."""
    Path("good.yaml").write_text(BASE, encoding="utf-8")
    message = refused(capsys, "run", "good.yaml", f"--seed={seed}")
    assert message.startswith(f"--seed {seed}: expected a whole number 0..9223372036854775807; got ")


def test_mistakes_in_file_and_options_are_told_together(capsys: pytest.CaptureFixture[str]) -> None:
    """File first, then the options in their order."""
    Path("bad.yaml").write_text(changed(("stride: 1.5 s", "stride: 1.5")), encoding="utf-8")
    rows = refused(capsys, "run", "bad.yaml", "--set", "rig.rate=3", "--seed", "x").splitlines()
    assert [row.split(":")[0] for row in rows] == ["bad.yaml", "--set rig.rate=3", "--seed x"]


def test_override_mends_what_it_replaces(capsys: pytest.CaptureFixture[str]) -> None:
    """A bad value that an option replaces is no longer there."""
    Path("bad.yaml").write_text(changed(("stride: 1.5 s", "stride: .nan")), encoding="utf-8")
    assert main(["check", "bad.yaml", "--set", "motion.stride=1.5s"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.long
@pytest.mark.parametrize(
    "arguments",
    [["run", "bad.yaml"], ["check", "bad.yaml"], ["run", "good.yaml", "--seed", "x"], ["run"], ["walk"], []],
    ids=lambda arguments: " ".join(arguments) or "nothing",
)
def test_process_leaves_with_2_and_a_clean_stdout(tmp_path: Path, arguments: list[str]) -> None:
    """Seen from outside: exit code 2, stdout empty, the reason on stderr, no traceback, no new file."""
    (tmp_path / "good.yaml").write_text(BASE, encoding="utf-8")
    (tmp_path / "bad.yaml").write_text(changed(("seed: 2020", "seed: -1")), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "testbench.cli", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr != ""
    assert "Traceback" not in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.yaml", "good.yaml"]
