"""The way to vcan itself: what runs there comes back whole, and nothing of it stays behind."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.vcan import uml
from tests.vcan.conftest import CACHE
from tests.vcan.inside.peers import wait_until

Inside = Callable[..., tuple[int, str]]


@pytest.fixture
def inside(tmp_path: Path) -> Inside:
    """`inside(command, timeout_s=60, **environment)`: with `tmp_path` as the current folder."""
    try:
        if not uml.native_vcan_available():
            uml.fetch(CACHE)
    except uml.VcanError as error:
        pytest.skip(f"no SocketCAN for this test: {error}")

    def run(command: list[str], timeout_s: float = 60, **environment: str) -> tuple[int, str]:
        return uml.run(command, tmp_path, timeout_s, environment, cache=CACHE)

    return run


@pytest.fixture
def booted() -> None:
    """For what only holds in User Mode Linux."""
    if uml.native_vcan_available():
        pytest.skip("this kernel has vcan itself, User Mode Linux is not used")


def test_both_interfaces_are_up(inside: Inside) -> None:
    """vcan0 and vcan1, and loopback."""
    code, text = inside(["sh", "-c", "cat /sys/class/net/lo/flags /sys/class/net/vcan[01]/flags"])
    assert code == 0
    assert [int(line, 16) & 1 for line in text.split()] == [1, 1, 1]  # IFF_UP


def test_exit_code_and_both_streams_come_back(inside: Inside) -> None:
    """In the order written."""
    assert inside(["sh", "-c", "echo out; echo err >&2; exit 7"]) == (7, "out\nerr\n")


def test_signal_that_ended_the_command_is_a_negative_code(inside: Inside) -> None:
    """As in subprocess."""
    assert inside(["sh", "-c", "kill -9 $$"])[0] == -9


def test_program_that_is_not_there_is_named(inside: Inside) -> None:
    """The shell's exit code for it."""
    code, text = inside(["/no/such/program"])
    assert code == 127
    assert "/no/such/program" in text


def test_arguments_environment_and_folder_arrive(inside: Inside, tmp_path: Path) -> None:
    """Whatever is in them."""
    command = ["sh", "-c", 'echo "$1|$X"; pwd; echo made > file', "sh", "a b 'c' \"d\" é\n--"]
    assert inside(command, X="1 2=3") == (0, f"a b 'c' \"d\" é\n--|1 2=3\n{tmp_path}\n")
    assert (tmp_path / "file").read_text() == "made\n"


def test_only_the_current_folder_can_be_written(inside: Inside, booted: None) -> None:
    """Tests in User Mode Linux cannot harm the files of the machine."""
    code, text = inside(["sh", "-c", f"touch {Path(__file__).parent}/made-inside; touch here && echo cwd"])
    assert (code, "Read-only" in text, text.endswith("cwd\n")) == (0, True, True)


def test_time_out_keeps_what_was_printed(inside: Inside) -> None:
    """And says which command it was."""
    with pytest.raises(uml.CommandTimeoutError, match=r"(?s)sleep 100.*0.5 s.*part"):
        inside(["sh", "-c", "echo part; sleep 100"], 0.5)


def test_kernel_that_does_not_end_is_killed(inside: Inside, booted: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing hangs: what the command may take and a little more is the limit."""
    monkeypatch.setattr(uml, "BOOT_LIMIT_S", -48.0)
    with pytest.raises(uml.VcanError, match="was killed after"):
        inside(["sleep", "100"], 50)


def test_boot_that_fails_shows_the_console(inside: Inside, booted: None, tmp_path: Path) -> None:
    """What the kernel said last is all there is to go by."""
    with pytest.raises(uml.VcanError, match=r"(?s)mem=16M.*console:"):
        uml.run(["true"], tmp_path, 10, cache=CACHE, mem="16M")


def test_packages_that_cannot_be_fetched_name_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reason and remedy, which become the reason of the skip."""
    monkeypatch.setenv("PATH", str(tmp_path))
    remedy = r"kernel that has vcan.*Debian package source.*dpkg -x.*apt-get: .*No such file"
    with pytest.raises(uml.VcanError, match=remedy):
        uml.fetch(tmp_path / "cache")
    assert sorted(path.name for path in (tmp_path / "cache").iterdir()) == ["lock"]


def test_nothing_stays_behind(inside: Inside, tmp_path: Path) -> None:
    """No process, no file, no folder of the kernel's own in the home folder."""
    home = Path.home() / ".uml"
    was_there = home.exists()
    command = f"sleep 1000.{os.getpid()}"
    code, _ = inside(["sh", "-c", f"{command} & true"])
    assert code == 0
    assert home.exists() == was_there
    assert list(tmp_path.iterdir()) == []
    wait_until(lambda: orphans(command) == [], f"nothing runs any more: {orphans(command)}")


def orphans(command: str) -> list[str]:
    """Processes of a run whose folder is gone, or of its command; other runs may be going on."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = entry.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:  # it has ended
            continue
        folder = re.search(r"uml_dir=(\S+)/", line)
        if command in line or (folder is not None and not Path(folder[1]).exists()):
            found.append(line)
    return found
