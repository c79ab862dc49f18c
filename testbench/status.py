"""The live status line of a running rig: one line, rewritten in place, on a terminal only.

What the terminal is too narrow for is cut off, names of faults first: a line that wraps could not be rewritten.
"""

import os
from collections.abc import Callable
from typing import Final, TextIO, final

from canopen_exo.bus.node import MS, NEVER, ErrorState
from canopen_exo.plan import STATUS_MOTION, STATUS_STARTING, STATUS_STOPPED
from canopen_exo.talk import put
from testbench.watch import Watch, states_text

EVERY_NS: Final = 250 * MS

_MOTION: Final = {0: "starting", STATUS_STARTING: "fading in", STATUS_MOTION: "walking", STATUS_STOPPED: "stopped"}


@final
class StatusLine:
    """Shows a Watch. faults: names of the active injectors, asked for at every line; nothing when no terminal."""

    def __init__(self, watch: Watch, stream: TextIO, faults: Callable[[], list[str]]) -> None:
        self._watch: Final[Watch] = watch
        self._stream: Final[TextIO] = stream
        self._faults: Final[Callable[[], list[str]]] = faults
        self._is_on: Final[bool] = stream.isatty()
        self._next_ns: int = -NEVER
        self._shown_ns: int = 0
        self._bits: list[int] = [0, 0]

    def show(self, now: int) -> None:
        """Rewrite the line when it is time."""
        if not self._is_on or now < self._next_ns:
            return
        put(self._stream, f"\r\x1b[K{_cut(self.text(now), self._width())}")
        self._next_ns = now + EVERY_NS

    def _width(self) -> int:
        """Columns of the terminal; 0 where it does not tell."""
        try:
            return os.get_terminal_size(self._stream.fileno()).columns
        except (OSError, ValueError):
            return 0

    def clear(self) -> None:
        """Make room for another line."""
        if self._is_on:
            put(self._stream, "\r\x1b[K")
            self._next_ns = -NEVER

    def text(self, now: int) -> str:
        """The line; loads are those since the last one."""
        watch = self._watch
        elapsed = max(now - self._shown_ns, 1)
        loads = [
            100 * (bits - before) * 1e9 / watch.plan.bitrate / elapsed
            for bits, before in zip(watch.bits, self._bits, strict=True)
        ]
        self._bits, self._shown_ns = list(watch.bits), now
        parts = [f"{_MOTION.get(watch.motion, 'unknown')} {_since(watch, now)}".rstrip()]
        for name, state in zip(("controller bus", "drive bus"), watch.ports, strict=True):
            if state is not ErrorState.ERROR_ACTIVE:
                parts.append(f"{name} {state.value.replace('_', ' ')}")
        parts += [
            states_text(watch.states.values()).replace("operation enabled", "enabled"),
            f"load {loads[0]:.0f}, {loads[1]:.0f} %",
            f"late {watch.late}/{watch.cycles}, {watch.offsets.worst_ns / 1e6:.1f} ms",
        ]
        faults = self._faults()
        if faults:
            parts.append(f"{len(faults)} {'fault' if len(faults) == 1 else 'faults'}: {', '.join(faults)}")
        return " | ".join(parts)


def _since(watch: Watch, now: int) -> str:
    return f"{(now - watch.time_zero) / 1e9:.1f} s" if watch.time_zero != NEVER else ""


def _cut(text: str, width: int) -> str:
    """The text in less than `width` columns, so that the cursor stays in its line."""
    if not width or len(text) < width:
        return text
    return text[: max(width - 4, 0)] + "..."[: width - 1]
