"""Names of buses."""

import os
import subprocess
import sys
from pathlib import Path

import can.util
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.interfaces import BusName, bus_identity, configured_bus, open_channel, parse_bus, same_bus
from canopen_exo.errors import CanopenExoError


@pytest.mark.parametrize(
    ("text", "interface", "channel", "bitrate"),
    [
        ("socketcan:vcan0", "socketcan", "vcan0", None),
        ("socketcan:can0@500000", "socketcan", "can0", 500_000),
        ("hub:drive", "hub", "drive", None),
        ("hub:127.0.0.1:29536/drive@1000000", "hub", "127.0.0.1:29536/drive", 1_000_000),
        ("hub:[::1]:29536/drive", "hub", "[::1]:29536/drive", None),
        ("kvaser:0", "kvaser", "0", None),
        ("slcan:/dev/ttyACM0@1", "slcan", "/dev/ttyACM0", 1),
        ("udp_multicast:ff15:7079::6173", "udp_multicast", "ff15:7079::6173", None),
    ],
)
def test_name_has_interface_channel_and_bit_rate(text: str, interface: str, channel: str, bitrate: int | None) -> None:
    """`INTERFACE:CHANNEL[@bitrate]`, and it is written again as it was read."""
    name = parse_bus(text)
    assert (name.interface, name.channel, name.bitrate) == (interface, channel, bitrate)
    assert str(name) == text


@pytest.mark.parametrize(
    "text", ["", ":", "vcan0", "socketcan:", ":vcan0", "socketcan:@500000", "socket can:vcan0", "a:b c"]
)
def test_text_of_another_form_is_refused_with_an_example(text: str) -> None:
    """What was given, what is allowed."""
    with pytest.raises(CanopenExoError, match=r"INTERFACE:CHANNEL\[@bitrate\], such as socketcan:can0") as failure:
        parse_bus(text)
    assert repr(text) in str(failure.value)


@pytest.mark.parametrize("bits", ["", "0", "1000001", "-1", "500k", "5e5", "\u0665"])
def test_bit_rate_is_a_whole_number_up_to_1_mbit(bits: str) -> None:
    """ISO 11898-2: 1 Mbit/s at most (the arbitration phase, for CAN FD)."""
    with pytest.raises(CanopenExoError, match=r"allowed 1\.\.1000000 bit/s"):
        parse_bus(f"pcan:PCAN_USBBUS1@{bits}")


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("hub:drive", "hub:127.0.0.1:29536/drive", True),
        ("hub:drive", "hub:drive@500000", True),
        ("hub:0.0.0.0:5000/drive", "hub:127.0.0.1:5000/drive", True),
        ("hub:127.0.0.1:5000/drive", "hub:drive", False),
        ("hub:127.0.0.2:29536/drive", "hub:drive", False),
        ("hub:controller", "hub:drive", False),
        ("socketcan:can0", "socketcan:can0@500000", True),
        ("socketcan:can0", "socketcan:can1", False),
        ("socketcan:can0", "virtual:can0", False),
        ("pcan:PCAN_USBBUS1@1000000", "pcan:PCAN_USBBUS1@500000", True),
    ],
)
def test_a_bus_is_the_same_however_it_is_written(one: str, other: str, same: bool) -> None:
    """Interface, address of the hub, channel; the bit rate makes no other bus of it."""
    first, second = parse_bus(one), parse_bus(other)
    assert (same_bus(first, second), same_bus(second, first)) == (same, same)
    assert (bus_identity(first) == bus_identity(second)) == same


def test_a_device_file_is_known_by_where_its_links_lead(tmp_path: Path) -> None:
    """/dev/serial/by-id/... and /dev/ttyACM0."""
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyACM0")
    assert same_bus(parse_bus(f"slcan:{tmp_path}/by-id"), parse_bus(f"slcan:{tmp_path}/ttyACM0@500000"))


@given(st.text(max_size=30))
def test_any_text_gives_a_name_or_a_message(text: str) -> None:
    """No other error reaches the user."""
    try:
        name = parse_bus(text)
    except CanopenExoError:
        return
    assert parse_bus(str(name)) == name


@pytest.fixture
def home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """No configuration but what a test makes: a can.conf of its own, and no CAN_ variable."""
    for key in list(os.environ):
        if key.startswith("CAN_"):
            monkeypatch.delenv(key)
    path = tmp_path / "can.conf"
    monkeypatch.setattr(can.util, "CONFIG_FILES", [str(path)])
    return path


def test_nothing_configured_is_none(home: Path) -> None:
    """The caller then takes the hub."""
    assert configured_bus() is None
    assert configured_bus("drive") is None


def test_environment_names_the_bus(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """CAN_INTERFACE, CAN_CHANNEL and CAN_BITRATE are honoured."""
    monkeypatch.setenv("CAN_INTERFACE", "socketcan")
    monkeypatch.setenv("CAN_CHANNEL", "can3")
    assert configured_bus() == BusName("socketcan", "can3")
    monkeypatch.setenv("CAN_BITRATE", "250000")
    assert configured_bus() == BusName("socketcan", "can3", 250_000)


def test_can_conf_names_the_bus_and_the_environment_comes_first(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order of python-can: environment, then file."""
    home.write_text("[default]\ninterface = pcan\nchannel = PCAN_USBBUS1\nbitrate = 500000\n")
    assert str(configured_bus()) == "pcan:PCAN_USBBUS1@500000"
    monkeypatch.setenv("CAN_CHANNEL", "PCAN_USBBUS2")
    assert str(configured_bus()) == "pcan:PCAN_USBBUS2@500000"


def test_section_of_can_conf_is_preferred_for_its_bus(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two buses in one file, or by CAN_CHANNEL_drive; a missing key comes from [default]."""
    home.write_text("[default]\ninterface = socketcan\nchannel = can0\n[drive]\nchannel = can1\n")
    assert str(configured_bus("controller")) == "socketcan:can0"
    drive = configured_bus("drive")
    assert drive is not None
    assert (str(drive), drive.context) == ("socketcan:can1", "drive")
    monkeypatch.setenv("CAN_CHANNEL_drive", "can7")
    assert str(configured_bus("drive")) == "socketcan:can7"


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"CAN_INTERFACE": "socketcan"}, "no channel; set CAN_CHANNEL"),
        ({"CAN_CONFIG": "{"}, "configuration cannot be read"),
        ({"CAN_INTERFACE": "socketcan", "CAN_CHANNEL": "can0", "CAN_BITRATE": "fast"}, "bit rate 'fast'"),
    ],
)
def test_half_a_configuration_is_refused(
    home: Path, monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], message: str
) -> None:
    """Never a guess at which bus was meant."""
    for key, value in variables.items():
        monkeypatch.setenv(key, value)
    with pytest.raises(CanopenExoError, match=message):
        configured_bus()


def test_can_conf_that_is_no_ini_file_is_refused(home: Path) -> None:
    """One line, no traceback."""
    home.write_text("interface = pcan\n")
    with pytest.raises(CanopenExoError, match="configuration cannot be read"):
        configured_bus()


def test_any_python_can_interface_opens_as_a_channel(home: Path) -> None:
    """The name as given stays the channel's name."""
    channel = open_channel(parse_bus("virtual:test_interfaces@125000"))
    try:
        assert channel.name == "virtual:test_interfaces@125000"
        assert channel.receive() == []
    finally:
        channel.close()


@pytest.mark.parametrize("text", ["nope:0", "socketcan:no_such_can", "hub:127.0.0.1:1/drive"])
def test_bus_that_cannot_be_opened_is_one_line_that_names_it(text: str) -> None:
    """What is missing and what to run."""
    with pytest.raises(CanopenExoError) as failure:
        open_channel(parse_bus(text))
    message = str(failure.value)
    assert "\n" not in message
    assert parse_bus(text).channel in message


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        ("socketcan:vcan_none@500000", "a virtual interface has none"),
        ("socketcan:can_none@500000", "ip link set"),
        ("hub:127.0.0.1:1/drive@125000", "exo-hil hub --bitrate"),
    ],
)
def test_bit_rate_that_is_not_used_is_told(text: str, remedy: str, caplog: pytest.LogCaptureFixture) -> None:
    """Ignored with a note, not silently."""
    with pytest.raises(CanopenExoError):
        open_channel(parse_bus(text))
    assert remedy in caplog.text


def test_names_are_read_without_importing_python_can() -> None:
    """Lazy imports: `--help` and `check` need neither python-can nor a socket."""
    code = (
        "import sys; from canopen_exo.bus.interfaces import parse_bus; parse_bus('hub:a'); "
        "print([name for name in ('can', 'socket', 'numpy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
