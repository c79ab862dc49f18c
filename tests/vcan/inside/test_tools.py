"""can-utils on the other side: cansend, candump, canplayer; and python-can as the reader of candump's log."""

import io
from collections.abc import Callable
from pathlib import Path

import can
import pytest

from canopen_exo.bus.channel import Channel
from canopen_exo.bus.medium import Transmission
from canopen_exo.bus.trace import candump_frame, write_candump
from tests.vcan.inside.peers import KINDS, Candump, Kind, fields, frames, receive, run

each_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)


@each_kind
def test_what_cansend_sends_is_received(channel: Channel, kind: Kind) -> None:
    """Foreign tool to our channel."""
    run("cansend", "vcan0", kind.text)
    assert frames(receive(channel, 1)) == [kind.frame]


def test_what_we_send_candump_prints_as_our_own_log_does(
    channel: Channel, candump: Callable[[str], Candump]
) -> None:
    """Our channel to foreign tool; the log files of a run are in the notation that candump uses itself."""
    log = candump("vcan0")
    for kind in KINDS:
        assert channel.send(kind.frame)
    run("cansend", "vcan0", "7E5#0E")
    assert log.until("7E5#0E") == [kind.text for kind in KINDS] == [candump_frame(kind.frame) for kind in KINDS]


def test_python_can_reads_the_log_that_candump_wrote_of_our_frames(
    channel: Channel, candump: Callable[[str], Candump], tmp_path: Path
) -> None:
    """candump -L to python-can's reader: what went in comes out."""
    log = candump("vcan0")
    for kind in KINDS:
        assert channel.send(kind.frame)
    run("cansend", "vcan0", "7E5#0E")
    text = "".join(f"(0.000000) vcan0 {line}\n" for line in log.until("7E5#0E"))
    read = list(can.CanutilsLogReader(io.StringIO(text)))
    assert [fields(message) for message in read] == [fields(kind.of_python_can()) for kind in KINDS]


def test_canplayer_replays_our_log(channel: Channel, tmp_path: Path) -> None:
    """The log of a run goes back onto a bus with a foreign tool."""
    rows = [Transmission(1000 * number, 0, kind.frame, -1) for number, kind in enumerate(KINDS)]
    write_candump(tmp_path / "drive.log", rows, 0, "drive")
    run("canplayer", "-t", "-I", str(tmp_path / "drive.log"), "vcan0=drive")
    assert frames(receive(channel, len(KINDS))) == [kind.frame for kind in KINDS]


def test_burst_of_cangen_is_received_as_candump_shows_it(
    channel: Channel, candump: Callable[[str], Candump]
) -> None:
    """A thousand random frames of all kinds at full speed: none lost, none changed, in order."""
    log = candump("vcan0")
    run("cangen", "vcan0", "-g", "0", "-n", "1000", "-m")
    run("cansend", "vcan0", "7E5#0E")
    shown = log.until("7E5#0E")
    received = [candump_frame(frame) for frame in frames(receive(channel, 1001))]
    assert received == [*shown, "7E5#0E"]
    assert len(shown) == 1000
    assert (channel.overruns, channel.malformed) == (0, 0)
