"""The gateway as a process: two interfaces, live control over a socket and, where asked for, over the bus.

The first SIGINT stops injecting and frames pass on until `exo-hil fault resume`; the second one, or SIGTERM, ends it.
It says what it stands between when it is ready, what is lost when that first happens, and what went through it, by
direction, at its end. A controller that sends SYNC at another rate than the faults count by is told at once, and once
more by exit code 3.
On Linux a second gateway between the same two buses is refused: with two, every frame would go round for ever.
Needs neither MuJoCo nor the controller.
"""

import errno
import hashlib
import logging
import socket
import sys
from collections.abc import Collection
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from canopen_exo.bus.interfaces import BusName, bus_identity
from canopen_exo.bus.node import NEVER, SECOND
from canopen_exo.talk import show
from fi_gateway.bus_control import DEFAULT_COMMAND_ID, DEFAULT_STATUS_ID, BusControl
from fi_gateway.control import (
    ARM,
    DISARM,
    RESUME,
    START,
    STOP,
    TRIGGER,
    LiveControl,
    changes_text,
    latency_text,
    statistics,
    statistics_text,
)
from fi_gateway.control_socket import ControlServer
from fi_gateway.errors import FaultError
from fi_gateway.gateway import CONTROLLER_PORT, DRIVE_PORT, Gateway
from testbench.errors import BenchError
from testbench.pairing import is_request
from testbench.process import DONE, INVALID, ProcessOptions, Session, say, session

if TYPE_CHECKING:
    from fi_gateway.addition import Additions
    from testbench.fault_file import FaultFile

_DONE: Final = {
    ARM: "{name}: armed",
    DISARM: "{name}: disarmed",
    TRIGGER: "{name}: triggered",
    START: "time 0 is now",
    STOP: "injection is stopped, every frame passes; `exo-hil fault resume` resumes",
    RESUME: "injection goes on",
}
_IGNORED: Final = "{name}: not triggered, it is active, or waits for a value, already"
"""What `exo-hil fault` says when it has asked."""

_LOOK_NS: Final = SECOND
"""How often it looks at the rate of SYNC."""

SIDES: Final = {"controller": CONTROLLER_PORT, "drive": DRIVE_PORT}


@dataclass(frozen=True, slots=True)
class ControlFrames:
    """Live control over the bus. port: the side of the gateway; COB-IDs of command and status."""

    port: int
    command_id: int = DEFAULT_COMMAND_ID
    status_id: int = DEFAULT_STATUS_ID


@dataclass(frozen=True, slots=True)
class GatewayOptions:
    """faults: with the file's injectors; control: address of the control socket, "" for none."""

    faults: bool = True
    control: str = ""
    frames: ControlFrames | None = None


def gateway_main(
    faults: "FaultFile", buses: tuple[BusName, BusName], options: ProcessOptions, given: GatewayOptions
) -> int:
    """The gateway between two buses, until told to end. Raises BenchError, FaultError.

    INVALID: faults that count control cycles had another length of them than the controller.
    """
    from fi_gateway.addition import Additions
    from fi_gateway.schema import refuse_wire_faults

    if given.faults:
        refuse_wire_faults(faults.injectors, "exo-hil gateway")
    additions = Additions(faults.injectors if given.faults else {}, faults.plan, faults.seed)
    if given.control:
        additions.prepare()
    gateway = Gateway(additions.built(), faults.plan.cycle_ns)
    control = LiveControl(gateway, additions)
    if given.frames is not None:
        gateway.attach(BusControl(control, given.frames.port, given.frames.command_id, given.frames.status_id))
    with claimed(buses), session("gateway", gateway, list(buses), [0, 1], options) as process:
        server = _server(given.control, control, process)
        with closing(server) if server is not None else nullcontext():
            if server is not None:
                server.listen()
                server.attach(process.loop)
                say("gateway", f"live control at {server.address}")
                if server.is_exposed:
                    say("gateway", f"warning: {server.address} can be reached from other machines")
            say("gateway", f"between {buses[0]} (controller) and {buses[1]} (drives); {_injectors_text(gateway)}")
            is_valid = _serve(process, control, server, server is not None or given.frames is not None, additions)
        gateway.finish(process.end_ns)
        if options.part is not None:
            _leave_part(options, process, control)
        directions = statistics(gateway, process.loop.latency, process.loop.losses_by_channel())
        for text in (statistics_text(directions), changes_text(directions), latency_text(directions)):
            for line in text.splitlines():
                say("gateway", line)
    return DONE if is_valid else INVALID


def claimed(buses: tuple[BusName, BusName]) -> AbstractContextManager[object]:
    """No other gateway between the same two buses while this lasts, as far as this machine's network reaches.

    A Unix socket in the abstract name space (unix(7), Linux) is the sign: it belongs to the network name space, as
    interfaces and loopback ports do, and goes with its process. Raises BenchError. Left out: other systems, other
    machines, other programs; python-can's `virtual` buses, which end at their process.
    """
    if sys.platform != "linux" or any(bus.interface == "virtual" for bus in buses):
        return nullcontext()
    pair = " ".join(sorted(bus_identity(bus) for bus in buses))
    sign = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        sign.bind(b"\0exo-hil gateway " + hashlib.sha256(pair.encode()).hexdigest().encode())
    except OSError as error:
        sign.close()
        if error.errno != errno.EADDRINUSE:
            raise
        raise BenchError(
            f"gateway: another one stands between {buses[0]} and {buses[1]} already, and with two every frame would go "
            "round for ever; end that one, or name other buses"
        ) from error
    return closing(sign)


def _server(address: str, control: LiveControl, process: Session) -> ControlServer | None:
    """Live control over a socket, where it is asked for."""
    if not address:
        return None
    return ControlServer(control, address, lambda: process.loop.latency, process.loop.losses_by_channel)


def _injectors_text(gateway: Gateway) -> str:
    names = [one.name for one in gateway.injectors]
    return f"injectors: {', '.join(names)}" if names else "no injectors, every frame passes"


def control_frames(text: str) -> ControlFrames:
    """`SIDE` or `SIDE:COMMAND,STATUS`, as in `drive:0x6C0,0x6C1`; raises BenchError."""
    side, colon, ids = text.partition(":")
    wrong = f"--control-frames {text!r} given, allowed is controller or drive, or with COB-IDs drive:0x6C0,0x6C1"
    if side not in SIDES:
        raise BenchError(wrong)
    if not colon:
        return ControlFrames(SIDES[side])
    try:
        command_id, status_id = (int(one, 0) for one in ids.split(","))
    except ValueError as error:
        raise BenchError(wrong) from error
    return ControlFrames(SIDES[side], command_id, status_id)


def check_control_frames(text: str, without: Collection[str], *, is_judged: bool) -> None:
    """Whether the gateway of a rig can take those frames; raises BenchError. is_judged: the run counts lost frames."""
    if not text:
        return
    frames = control_frames(text)
    if "gateway" in without:
        raise BenchError(f"--control-frames {text}: our gateway reads them, and it is left out; leave out one of them")
    if is_judged and not (is_request(frames.command_id) and is_request(frames.status_id)):
        raise BenchError(
            f"--control-frames {text}: COB-IDs 0x601 to 0x6FF are allowed in a run that is judged; others would count "
            "as frames lost in the gateway"
        )


def fault_main(word: str, name: str, address: str) -> int:
    """`exo-hil fault`: one call of a running gateway's live control. Raises FaultError."""
    from fi_gateway.control import WORDS
    from fi_gateway.control_socket import ask, ask_listing

    if word in WORDS:
        done = ask(address, word, name).get("done") is True
        show((_DONE[word] if done else _IGNORED).format(name=name) + "\n")
    else:
        show(ask_listing(address).text() + "\n")
    return DONE


def active_faults(address: str) -> list[str]:
    """Names of the injectors that act now; empty when the gateway does not say."""
    from fi_gateway.control_socket import ask_listing
    from fi_gateway.phase import Phase

    try:
        listing = ask_listing(address, timeout_s=0.1)
    except FaultError as error:
        logging.getLogger(__name__).debug("%s", error)
        return []
    return [row.name for row in listing.injectors if row.state == Phase.ACTIVE.value]


def _serve(
    process: Session, control: LiveControl, server: ControlServer | None, can_resume: bool, additions: "Additions"
) -> bool:
    """Until told to end; False when what was injected counted cycles of the wrong length.

    can_resume: there is live control to resume injection with; additions: what the injectors were made from.
    """
    interrupted = False
    is_valid = True
    look_at = 0
    how = "`exo-hil fault resume` resumes" if can_resume else "nothing resumes it without --control"

    def judge() -> None:
        nonlocal is_valid
        other = _other_rate(control, additions) if is_valid else ""
        if other:
            is_valid = False
            say("gateway", f"error: {other}")

    def is_over(now: int) -> bool:
        nonlocal interrupted, look_at
        if server is not None:
            server.tidy(now)
        if now >= look_at:
            look_at = now + _LOOK_NS
            judge()
        orders = process.orders
        if orders.interrupts and not interrupted:
            interrupted = True
            control.pass_through(process.loop.now(), "signal")
            say("gateway", f"injection is stopped, frames pass on; {how}, Ctrl-C ends")
        return orders.terminations > 0 or orders.interrupts > 1

    process.run(is_over)
    judge()
    return is_valid


def _other_rate(control: LiveControl, additions: "Additions") -> str:
    """Why the faults act at wrong times, "" when they do not: by the rate of SYNC, where anything hangs on it."""
    gateway = control.gateway
    by_hand = any(row.what == START and not row.refused for row in control.rows)
    by_status = gateway.time_zero != NEVER and not by_hand
    by_cycles = any(spec.event.counts_cycles() for spec in additions.specs.values())
    return gateway.cadence.words() if gateway.injectors and (by_status or by_cycles) else ""


def _leave_part(options: ProcessOptions, process: Session, control: LiveControl) -> None:
    from testbench.parts import ControlNote, GatewayPart, reach_of, write_gateway

    assert options.part is not None
    gateway = control.gateway
    service = process.service()
    for port, count in enumerate(gateway.undelivered):
        if count:
            service.losses[f"that came in on port {port} not delivered, the other interface was away"] = count
    part = GatewayPart(
        service,
        gateway.time_zero,
        {one.name: reach_of(one) for one in gateway.injectors},
        list(gateway.frames),
        list(gateway.lost),
        process.loop.latency,
        gateway.records,
        [ControlNote(row.time_ns, row.what, row.name, row.source, row.refused) for row in control.rows],
        process.loop.trace or [],
    )
    write_gateway(options.part, part)
