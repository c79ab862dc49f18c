"""How far a campaign is, on stderr: a bar on a terminal, else a line now and then."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final, TextIO

from canopen_exo.talk import put
from testbench.campaign.runner import Progress
from testbench.campaign.words import counts_text, time_text

EVERY_S: Final = 30.0
"""Between two lines where there is no terminal."""


@contextmanager
def shown(name: str, stream: TextIO | None = None) -> Iterator[Callable[[Progress], None]]:
    """Gives what is to be told about the progress."""
    stream = sys.stderr if stream is None else stream
    if not stream.isatty():
        yield _Lines(name, stream).tell
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[words]}"))
    with Bar(*columns, console=Console(file=stream), transient=True) as bar:
        task = bar.add_task(name, total=None, words="starting")
        yield lambda far: bar.update(task, completed=far.done, total=far.wanted, words=line(far))


def line(far: Progress) -> str:
    """ "12 of 60 runs, 14.2 runs/min, 3 min left; 9 masked, 3 failure_silent"."""
    rate = f", {far.per_minute:.1f} runs/min, {time_text(far.left_s)} left" if far.made else ""
    return f"{far.done} of {far.wanted} runs{rate}{f'; {counts_text(far.counts)}' if far.counts else ''}"


class _Lines:
    """A line at once, and then every half minute in which something came of it."""

    def __init__(self, name: str, stream: TextIO) -> None:
        self._name, self._stream = name, stream
        self._next = time.monotonic()
        self._told = -1

    def tell(self, far: Progress) -> None:
        if time.monotonic() >= self._next and far.done != self._told:
            self._told, self._next = far.done, time.monotonic() + EVERY_S
            put(self._stream, f"{self._name}: {line(far)}\n")
