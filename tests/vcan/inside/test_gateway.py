"""`exo-hil gateway` as a process between vcan0 (controller side) and vcan1 (drive side)."""

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import can
import pytest

from canopen_exo.bus.channel import Channel
from canopen_exo.bus.node import ErrorState
from fi_gateway.control_socket import ask, ask_listing
from tests.vcan import uml
from tests.vcan.inside.peers import (
    BUS_OFF,
    EIGHT,
    KINDS,
    LIMIT_S,
    PASSIVE,
    RAW_DLC,
    RESTARTED,
    Candump,
    fields,
    frames,
    next_message,
    program,
    python_can,
    receive,
    run,
    send_error,
    wait_until,
)
from tests.vcan.inside.programs import Program, await_passage, flush, our_processes

SCENARIO: Final = """\
name: deaf
rig: {plant: suspended, stops: off, rate: 100 Hz}
motion: {gait: walking, stride: 1.5 s, duration: 2 s}
injectors:
  lose_samples:
    target: {bus: to_controller, node: right_knee, pdo: TPDO1}
    fault: {type: drop, probability: 100 %}
    event: {type: never}
    effect: {type: constant_time, duration: 1000 s}
"""

Start = Callable[..., Program]


@pytest.fixture
def control(tmp_path: Path) -> str:
    """Where live control is."""
    return str(tmp_path / "control")


@pytest.fixture
def start(tmp_path: Path, control: str, peer: can.BusABC, far_peer: can.BusABC) -> Iterator[Start]:
    """`start(drive="vcan1")`: a gateway, with the scenario above, that passes frames already; both peers are empty."""
    started: list[Program] = []
    scenario = tmp_path / "deaf.yaml"
    scenario.write_text(SCENARIO)

    def start_one(drive: str = "vcan1") -> Program:
        buses = ["--controller-bus", "socketcan:vcan0", "--drive-bus", f"socketcan:{drive}"]
        started.append(Program(["gateway", str(scenario), *buses, "--control", control], tmp_path))
        await_passage(started[-1], "vcan0", drive)
        for bus in (peer, far_peer):
            while bus.recv(0) is not None:
                pass
        return started[-1]

    yield start_one
    for one in started:
        one.close()
    assert our_processes() == []


# --- transparency ----------------------------------------------------------------------------------------------------


def test_every_kind_of_frame_passes_unchanged_once_and_never_comes_back(
    start: Start, candump: Callable[[str], Candump], peer: can.BusABC, far_peer: can.BusABC
) -> None:
    """Extended, remote, FD: unchanged and in order, both ways; no reflection, own traffic is not forwarded again."""
    gateway = start()
    near, far = candump("vcan0"), candump("vcan1")
    wanted = [fields(kind.of_python_can()) for kind in KINDS]
    texts = [kind.text for kind in KINDS]
    flush(peer, far_peer)
    flush(far_peer, peer)
    for sender, receiver in ((peer, far_peer), (far_peer, peer)):
        for kind in KINDS:
            sender.send(kind.of_python_can())
        assert [fields(next_message(receiver)) for _ in KINDS] == wanted
    for number in range(3):  # anything that went back and forth would be in between
        run("cansend", f"vcan{number % 2}", f"7E6#0{number}")
        (far_peer, peer)[number % 2].recv(LIMIT_S)
    for log in (near, far):
        assert log.until("7E6#02") == ["7E5#0E", "7E5#0E", *texts, *texts, "7E6#00", "7E6#01"]
    assert gateway.end() == 0


def test_raw_dlc_above_8_passes_unchanged(start: Start, opened: Callable[[str], Channel]) -> None:
    """Classical frames of 8 bytes that say 9..15 on the wire."""
    start()
    near, far = opened("socketcan:vcan0"), opened("socketcan:vcan1")
    for frame in RAW_DLC:
        assert near.send(frame)
    assert frames(receive(far, len(RAW_DLC))) == list(RAW_DLC)
    for frame in RAW_DLC:
        assert far.send(frame)
    assert frames(receive(near, len(RAW_DLC))) == list(RAW_DLC)


def test_random_frames_of_all_kinds_pass_at_full_speed(start: Start, candump: Callable[[str], Candump]) -> None:
    """cangen to candump on the other side: none lost, doubled, changed or out of order."""
    start()
    near, far = candump("vcan0"), candump("vcan1")
    run("cangen", "vcan0", "-g", "0", "-n", "1500", "-m")
    run("cansend", "vcan0", "7E6#01")
    sent = near.until("7E6#01")
    assert len(sent) == 1500
    assert far.until("7E6#01") == sent


def test_traffic_in_both_directions_at_once_keeps_its_order(
    start: Start, candump: Callable[[str], Candump], control: str
) -> None:
    """Two senders at full speed: each direction complete and in order; the statistics count the same frames."""
    start()
    before = [one.frames for one in ask_listing(control).directions]
    near, far = candump("vcan0"), candump("vcan1")
    count = 1500
    cangen = [program("cangen"), "-g", "0", "-n", str(count), "-L", "8", "-D", "i"]
    senders = [subprocess.Popen([*cangen, "-I", number, interface])
               for interface, number in (("vcan0", "100"), ("vcan1", "200"))]
    assert [sender.wait(60) for sender in senders] == [0, 0]
    run("cansend", "vcan0", "7E6#01")
    far_log = far.until("7E6#01")
    run("cansend", "vcan1", "7E6#02")
    near_log = near.until("7E6#02")
    near_log.remove("7E6#01")
    for number in ("100", "200"):
        passed = [text for text in near_log if text.startswith(number)]
        assert len(passed) == count
        assert passed == [text for text in far_log if text.startswith(number)]
        assert len(set(passed)) == count  # cangen counts up in the data
    assert len(near_log) == len(far_log) == 2 * count
    listing = ask_listing(control)
    after = [one.frames for one in listing.directions]
    assert [now - then for now, then in zip(after, before, strict=True)] == [count + 1, count + 1]
    assert [one.lost + one.undelivered for one in listing.directions] == [0, 0]
    for direction in listing.directions:
        assert direction.latency is not None
        assert direction.latency.count == direction.frames


# --- errors ----------------------------------------------------------------------------------------------------------


def test_error_frames_are_counted_and_not_forwarded(
    start: Start, peer: can.BusABC, far_peer: can.BusABC, control: str
) -> None:
    """They belong to the controller of one interface."""
    gateway = start()
    for error in (PASSIVE, BUS_OFF, RESTARTED):
        send_error(peer, error)
    assert flush(peer, far_peer) == []
    to_drives, to_controller = ask_listing(control).directions
    assert (to_drives.notices, to_controller.notices) == (3, 0)
    for state in (ErrorState.ERROR_PASSIVE, ErrorState.BUS_OFF, ErrorState.ERROR_ACTIVE):
        assert f"socketcan:vcan0: {state.value.replace('_', ' ')}" in gateway.printed
    flush(far_peer, peer)
    assert gateway.end() == 0


def test_bus_off_is_survived(start: Start, peer: can.BusABC, far_peer: can.BusABC, control: str) -> None:
    """What is for an interface that is off is not kept for later; when it is back, frames pass again by themselves."""
    start()
    send_error(far_peer, BUS_OFF)
    wait_until(lambda: ask_listing(control).directions[1].notices == 1, "the gateway has noticed")
    before = ask_listing(control).directions[0]
    for number in range(20):
        peer.send(can.Message(arbitration_id=0x201, is_extended_id=False, data=[number]))
    wait_until(lambda: ask_listing(control).directions[0].frames == before.frames + 20, "it has handled them")
    undelivered = ask_listing(control).directions[0].undelivered
    assert undelivered > 0
    send_error(far_peer, RESTARTED)
    wait_until(lambda: ask_listing(control).directions[1].notices == 2, "the gateway has noticed")
    came = flush(peer, far_peer)
    assert len([message for message in came if message.arbitration_id == 0x201]) == 20 - undelivered
    flush(far_peer, peer)


# --- interfaces that go away -----------------------------------------------------------------------------------------


def test_interface_down_and_up_is_survived_and_nothing_old_is_sent_then(
    start: Start, peer: can.BusABC, control: str
) -> None:
    """Reported, counted, and frames pass again when it is up; no command from before."""
    gateway = start()
    uml.set_link("vcan1", up=False)
    gateway.says("socketcan:vcan1: down")
    handled = ask_listing(control).directions[0].frames
    for number in range(10):
        peer.send(can.Message(arbitration_id=0x201, is_extended_id=False, data=[number]))
    wait_until(lambda: ask_listing(control).directions[0].frames == handled + 10, "it has handled them")
    uml.set_link("vcan1")
    with python_can("vcan1") as back:
        number, message = 9, None
        while message is None:
            number += 1
            assert number < 255
            peer.send(can.Message(arbitration_id=0x201, is_extended_id=False, data=[number]))
            message = back.recv(0.1)
        assert message.data[0] >= 10
        gateway.says("socketcan:vcan1: error active")
        flush(peer, back)
        flush(back, peer)
    to_drives = ask_listing(control).directions[0]
    assert gateway.end() == 0
    assert to_drives.undelivered <= 10 + number - 9


def test_interface_that_is_removed_and_comes_back_is_used_again(start: Start, spare: str, peer: can.BusABC) -> None:
    """An adapter pulled out and put back; back-off is 1 s at most."""
    gateway = start(spare)
    uml.delete_link(spare)
    gateway.says(f"socketcan:{spare}: down")
    uml.set_link(spare, create_kind="vcan")
    with python_can(spare) as back:
        for _ in range(100):
            peer.send(can.Message(arbitration_id=0x201, is_extended_id=False))
            if back.recv(0.1) is not None:
                break
        gateway.says(f"socketcan:{spare}: error active")
        flush(peer, back)
        flush(back, peer)
    assert gateway.end() == 0


# --- faults ----------------------------------------------------------------------------------------------------------


def samples_pass(far_peer: can.BusABC, peer: can.BusABC) -> bool:
    """Whether TPDO1 of the right knee comes through."""
    far_peer.send(can.Message(arbitration_id=0x185, is_extended_id=False, data=EIGHT))
    return [message.arbitration_id for message in flush(far_peer, peer)] == [0x185]


def test_fault_is_started_from_the_command_line_and_the_first_interrupt_stops_it(
    start: Start, peer: can.BusABC, far_peer: can.BusABC, control: str, tmp_path: Path
) -> None:
    """SIGINT first stops injecting and frames pass until told again; the second one ends the gateway, exit 0."""
    gateway = start()
    assert samples_pass(far_peer, peer)
    ask(control, "start")  # time 0: there is no controller here that says it
    trigger = Program(["fault", "trigger", "lose_samples", "--at", control], tmp_path)
    assert trigger.wait() == 0, trigger.printed
    assert not samples_pass(far_peer, peer)
    gateway.tell(signal.SIGINT)
    gateway.says("injection is stopped")
    assert samples_pass(far_peer, peer)
    ask(control, "resume")
    ask(control, "trigger", "lose_samples")
    assert not samples_pass(far_peer, peer)
    assert ask_listing(control).directions[1].lost == 2
    assert gateway.end(signal.SIGINT) == 0
    assert not os.path.exists(control)


def test_gateway_that_is_killed_leaves_two_separate_buses_and_a_new_one_takes_over(
    start: Start, peer: can.BusABC, far_peer: can.BusABC, candump: Callable[[str], Candump]
) -> None:
    """kill -9: nothing passes any more, and nothing of it passes later."""
    first = start()
    first.tell(signal.SIGKILL)
    assert first.wait() == -signal.SIGKILL
    far = candump("vcan1")
    peer.send(can.Message(arbitration_id=0x201, is_extended_id=False))
    start()
    flush(peer, far_peer)
    assert set(far.until("7E5#0E")) == {"7E0#"}


@pytest.mark.parametrize("side", ["--controller-bus", "--drive-bus"])
def test_missing_interface_is_one_line_and_exit_code_2(side: str, tmp_path: Path) -> None:
    """Without the interface: one line saying what to run."""
    other = "--drive-bus" if side == "--controller-bus" else "--controller-bus"
    gateway = Program(["gateway", side, "socketcan:vcan9", other, "socketcan:vcan0"], tmp_path)
    assert gateway.wait() == 2
    assert gateway.printed.count("\n") == 1
    assert "ip link add dev vcan9 type vcan" in gateway.printed
