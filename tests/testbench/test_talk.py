"""Talk that nobody reads any more: it changes nothing about what a process does, nor about its exit code."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import can
import pytest

PATIENCE_S = 30.0


@contextmanager
def started(*arguments: str, stdout: int | None = None) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """`exo-hil` whose stderr is a pipe; the end to read from is to be closed by whoever uses it."""
    heard, said = os.pipe()
    command = [sys.executable, "-m", "testbench.cli", *arguments]
    with subprocess.Popen(command, stdout=stdout, stderr=said) as process:
        os.close(said)
        try:
            yield process, heard
        finally:
            process.kill()


@pytest.mark.realtime
def test_gateway_whose_talk_nobody_reads_passes_frames_after_an_interrupt() -> None:
    """`exo-hil gateway ... 2>&1 | tee log`: Ctrl-C ends `tee` as well; the gateway stops injecting and goes on."""
    with started("hub", "--listen", "127.0.0.1:0", stdout=subprocess.PIPE) as (hub, hub_talk):
        assert hub.stdout is not None
        place = hub.stdout.readline().decode().split()[-1]
        os.close(hub_talk)  # what the hub says at its end
        sides = ["--controller-bus", f"hub:{place}/c", "--drive-bus", f"hub:{place}/d"]
        with started("gateway", *sides) as (gateway, talk):
            with os.fdopen(talk) as lines:
                assert "every frame passes" in lines.readline()
            with can.Bus(f"{place}/c", "hub") as controller, can.Bus(f"{place}/d", "hub") as drives:
                gateway.send_signal(signal.SIGINT)
                time.sleep(0.3)  # for it to be told
                controller.send(can.Message(arbitration_id=0x123, is_extended_id=False))
                assert drives.recv(PATIENCE_S) is not None
            gateway.send_signal(signal.SIGINT)
            assert gateway.wait(PATIENCE_S) == 0
        hub.terminate()
        assert hub.wait(PATIENCE_S) == 0


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("| true", ""),
        ("> /dev/full", "stdout: No space left on device; the result could not be printed there\n"),
        (">&-", "stdout: it is closed; the result could not be printed there\n"),
    ],
)
@pytest.mark.parametrize("verb", ["export dbc", "fault arm x", "fault list", "--version"])
def test_result_that_cannot_be_printed_is_no_defect(verb: str, where: str, said: str) -> None:
    """The verb has done what it was asked to: its exit code stays, and the reason is one line."""
    code = (
        "import sys; from types import SimpleNamespace\n"
        "from fi_gateway import control_socket; from testbench import cli\n"
        "control_socket.ask = lambda *given: {'done': True}\n"
        "control_socket.ask_listing = lambda *given: SimpleNamespace(text=lambda: 'nothing')\n"
        "sys.exit(cli.main(sys.argv[1:]))"
    )
    shell = f'{sys.executable} -c "{code}" {verb} {where}; exit ${{PIPESTATUS[0]}}'
    done = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, said)


@pytest.mark.parametrize("is_closed", [False, True])
def test_defect_that_cannot_be_told_is_no_verdict(is_closed: bool) -> None:
    """Exit 3 whether the reader of stderr has gone, or stderr was closed from the beginning."""
    code = (
        "import sys; from testbench import cli\n"
        "cli._export = lambda options: 1 // 0\n"
        f"sys.stderr = None if {is_closed} else sys.stderr\n"
        "sys.exit(cli.main(['export', 'eds']))"
    )
    heard, said = os.pipe()
    os.close(heard)
    assert subprocess.run([sys.executable, "-c", code], stderr=said, check=False).returncode == 3
    os.close(said)
