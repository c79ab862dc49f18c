"""What a process prints, and to whom."""

import os
import subprocess
import sys
import time

import pytest


@pytest.mark.long
def test_result_waits_for_a_reader_that_is_slow_though_stdout_would_not_block() -> None:
    """Somebody else who has the pipe may have set it so; nothing is cut off and the exit code stays."""
    code = "import os; os.set_blocking(1, False); from canopen_exo.talk import show; show('x' * 1_000_000)"
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, env=environment) as process:
        time.sleep(0.5)
        assert process.stdout is not None
        assert process.stdout.read() == b"x" * 1_000_000
    assert process.returncode == 0
