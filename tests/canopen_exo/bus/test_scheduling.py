"""What is asked of the operating system's scheduler."""

import os

import pytest

from canopen_exo.bus.scheduling import release_fifo, request_fifo, sharpen_timers


def test_refused_fifo_gives_one_line_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    """`--fifo` where it is not permitted: a clear message, and the run goes on."""

    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    message = request_fifo()
    assert message is not None
    assert "\n" not in message
    assert "--fifo" in message
    assert "ulimit -r" in message


def test_granted_fifo_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """SCHED_FIFO with a priority below the kernel's interrupt threads (50)."""
    asked: list[tuple[int, int, int]] = []
    monkeypatch.setattr(os, "SCHED_FIFO", 1, raising=False)
    monkeypatch.setattr(os, "sched_param", int, raising=False)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *parts: asked.append(parts), raising=False)
    assert request_fifo() is None
    assert [(pid, policy) for pid, policy, _ in asked] == [(0, 1)]
    assert 1 <= asked[0][2] < 50


def test_system_without_fifo_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """macOS and Windows."""
    monkeypatch.delattr(os, "sched_setscheduler", raising=False)
    message = request_fifo()
    assert message is not None
    assert "no SCHED_FIFO" in message


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="this system has no SCHED_FIFO")
def test_what_was_granted_is_given_back() -> None:
    """Real: asked for where it is permitted, and normal afterwards either way."""
    granted = request_fifo() is None
    assert os.sched_getscheduler(0) == (os.SCHED_FIFO if granted else os.SCHED_OTHER)
    release_fifo()
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_timers_can_be_sharpened_any_number_of_times() -> None:
    """Every run of the loop asks again."""
    sharpen_timers()
    sharpen_timers()
