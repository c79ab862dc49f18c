"""The README shows real files and real output: what it prints is what the commands print today.

`python tests/test_readme.py` writes the present output into the README and renews its picture.
"""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from testbench.scenario import parse_scenario

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
CONSOLE = re.compile(r"```console\n\$ (.*)\n((?:(?!```).*\n)*)```")
YAML = re.compile(r"`(scenarios/[a-z_]+\.yaml)`[^`]*```yaml\n(.*?)```", re.DOTALL)
MACHINE_TIME = re.compile(r"in \d+\.\d+ s \(\d+\.\d+ x real time\)")
PLACE = re.compile(r"result folder: .*/(results/)")


def examples() -> list[tuple[str, str]]:
    """(command, output as shown) of every console block."""
    return CONSOLE.findall(README.read_text(encoding="utf-8"))


def output(command: str, work: Path) -> str:
    """What the command prints, stdout then stderr, run in a folder with the repository's files."""
    for name in ("scenarios", "campaigns", "docs"):
        if not (work / name).exists():
            (work / name).symlink_to(ROOT / name)
    words = shlex.split(command)
    assert words[0] == "exo-hil"
    done = subprocess.run(
        [sys.executable, "-m", "testbench.cli", *words[1:]], cwd=work, capture_output=True, text=True, timeout=300
    )
    return done.stdout + PLACE.sub(r"result folder: \1", done.stderr)


def settled(text: str) -> str:
    """Without what the machine's speed decides."""
    return MACHINE_TIME.sub("in # s (# x real time)", text)


def test_the_readme_has_examples() -> None:
    """A pattern that finds nothing would hold nothing."""
    assert len(examples()) >= 4
    assert YAML.search(README.read_text(encoding="utf-8"))


@pytest.mark.run
@pytest.mark.parametrize(("command", "shown"), examples(), ids=[command[:60] for command, _ in examples()])
def test_the_output_shown_is_the_output(command: str, shown: str, tmp_path: Path) -> None:
    """Every console block of the README, run."""
    assert settled(output(command, tmp_path)) == settled(shown)


def test_the_scenario_shown_is_the_file() -> None:
    """A scenario printed in the README is the one that is shipped."""
    for name, text in YAML.findall(README.read_text(encoding="utf-8")):
        assert (ROOT / name).read_text(encoding="utf-8") == text


def test_the_injector_shown_in_the_reference_reads() -> None:
    """docs/scenarios.md: its YAML is an injector of a scenario."""
    shown = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs" / "scenarios.md").read_text(encoding="utf-8"), re.DOTALL)
    head = "name: shown\nrig: {plant: suspended, stops: off}\nmotion: {gait: walking, stride: 1.5 s, duration: 7 s}\n"
    assert shown
    for text in shown:
        assert parse_scenario(head + text).injectors


def renew() -> None:
    """Write the present output into the README, and the picture of `make demo`."""
    work = ROOT / "build" / "readme"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    text = README.read_text(encoding="utf-8")
    text = CONSOLE.sub(lambda block: f"```console\n$ {block[1]}\n{output(block[1], work)}```", text)
    README.write_text(text, encoding="utf-8")
    output("exo-hil run scenarios/knee_freeze.yaml --out results/demo", work)
    shutil.copy(work / "results" / "demo" / "fault.png", ROOT / "docs" / "images" / "knee_freeze.png")


if __name__ == "__main__":
    renew()
