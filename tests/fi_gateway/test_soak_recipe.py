"""The soak recipe: it runs, and sees what it is there for."""

import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).resolve().parents[2]

# ---- the soak recipe ----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_soak_recipe_runs() -> None:
    """`make soak` in small: a gateway in a process of its own, 50 000 frames, every record compared with its due."""
    command = [sys.executable, "-m", "benchmarks.soak", "--frames", "50000", "--seconds", "0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "50000 frames" in done.stdout
    assert "5000 frames over busy buses" in done.stdout


@pytest.mark.parametrize("towards_controller", [False, True])
@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda records: records[:5] + records[6:], "1 frames lost or overtaken"),
        (lambda records: [*records[:6], records[5], *records[6:]], "doubled or changed"),
        (lambda records: [*records[:5], records[6], records[5], *records[7:]], "lost or overtaken"),
        (lambda records: [*records[:5], records[5][:-1] + b"x", *records[6:]], "doubled or changed"),
    ],
)
def test_the_soak_recipe_sees_what_it_is_there_for(
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[list[bytes]], list[bytes]],
    complaint: str,
    towards_controller: bool,
) -> None:
    """Lost, doubled, out of order, changed: each ends the run with the number of the frame."""
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks.soak import Stream

    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for _ in range(2)]
    for pair in pairs:
        for end in pair:
            end.setblocking(False)
    stream = Stream(pairs[0][0], pairs[1][1], towards_controller, 20)
    for _ in range(20):
        stream.send()
    records = [pairs[0][1].recv(72) for _ in range(20)]
    for record in change(records):
        pairs[1][0].send(record)
    with pytest.raises(SystemExit, match=complaint):
        stream.receive()
    for pair in pairs:
        for end in pair:
            end.close()
