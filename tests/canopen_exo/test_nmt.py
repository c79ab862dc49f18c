"""NMT: commands on the wire and the slave's states (CiA 301, 7.2.8 and 7.3.2)."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.nmt import ALL_NODES, NmtCommand, NmtSlave, NmtState, decode_nmt, nmt_frame

INIT, PRE, OP, STOP = (NmtState.INITIALISING, NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED)

CODES = {
    0x01: NmtCommand.START,
    0x02: NmtCommand.STOP,
    0x80: NmtCommand.ENTER_PRE_OPERATIONAL,
    0x81: NmtCommand.RESET_NODE,
    0x82: NmtCommand.RESET_COMMUNICATION,
}
"""CiA 301, 7.2.8.3.1: command specifiers."""

FIGURE = {
    NmtCommand.START: {PRE: OP, OP: OP, STOP: OP},
    NmtCommand.STOP: {PRE: STOP, OP: STOP, STOP: STOP},
    NmtCommand.ENTER_PRE_OPERATIONAL: {PRE: PRE, OP: PRE, STOP: PRE},
    NmtCommand.RESET_NODE: {PRE: INIT, OP: INIT, STOP: INIT},
    NmtCommand.RESET_COMMUNICATION: {PRE: INIT, OP: INIT, STOP: INIT},
}
"""CiA 301, figure 46: from every state but Initialising each command leads to one state."""


def slave_in(state: NmtState) -> NmtSlave:
    slave = NmtSlave()
    if state is not INIT:
        slave.initialised()
    if state is OP:
        slave.command(NmtCommand.START)
    elif state is STOP:
        slave.command(NmtCommand.STOP)
    assert slave.state is state
    return slave


def test_state_bytes_are_those_of_the_heartbeat() -> None:
    """CiA 301, 7.2.8.3.2: 0 boot-up, 4 Stopped, 5 Operational, 127 Pre-operational."""
    assert {state: state.value for state in NmtState} == {INIT: 0, STOP: 4, OP: 5, PRE: 127}


def test_slave_starts_initialising_and_goes_on_by_itself() -> None:
    """CiA 301, figure 46: power-on, then automatically Pre-operational."""
    slave = NmtSlave()
    assert slave.state is INIT
    slave.initialised()
    assert slave.state is PRE


@pytest.mark.parametrize(("command", "before"), [(command, state) for command in FIGURE for state in (PRE, OP, STOP)])
def test_command_leads_to_the_state_of_the_figure(command: NmtCommand, before: NmtState) -> None:
    """CiA 301, figure 46; the return value says whether there is something to do."""
    slave = slave_in(before)
    after = FIGURE[command][before]
    assert slave.command(command) == (after is not before)
    assert slave.state is after


@pytest.mark.parametrize("command", list(NmtCommand))
def test_no_command_is_served_while_initialising(command: NmtCommand) -> None:
    """CiA 301, 7.3.2.2: in Initialising only the boot-up message is there."""
    slave = NmtSlave()
    assert not slave.command(command)
    assert slave.state is INIT


@pytest.mark.parametrize("address", [0, 4, 5, 6, 127, 255])
def test_every_command_byte_is_decoded_or_passed_over(address: int) -> None:
    """All 256 specifiers: five are commands, for this node or for all; the rest is data to ignore."""
    for code in range(256):
        expected = CODES.get(code) if address in (ALL_NODES, 5) else None
        assert decode_nmt(bytes((code, address)), 5) is expected, hex(code)


@pytest.mark.parametrize("data", [b"", b"\1", b"\1\0\0", b"\1\5\0\0\0\0\0\0"])
def test_message_of_another_length_is_no_command(data: bytes) -> None:
    """CiA 301, 7.2.8.3.1: two bytes."""
    assert decode_nmt(data, 5) is None


@given(data=st.binary(max_size=8), node_id=st.integers(1, 127))
def test_no_bytes_make_the_decoder_raise(data: bytes, node_id: int) -> None:
    """Style: bad bytes from the wire are data."""
    decode_nmt(data, node_id)


@pytest.mark.parametrize("command", list(NmtCommand))
@pytest.mark.parametrize("node_id", [0, 1, 127])
def test_master_sends_what_the_slave_decodes(command: NmtCommand, node_id: int) -> None:
    """CiA 301, 7.2.8.3.1: COB-ID 0, specifier, node id; node id 0 is all nodes."""
    frame = nmt_frame(command, node_id)
    assert (frame.can_id, frame.flags, len(frame.data)) == (0, 0, 2)
    assert CODES[frame.data[0]] is command
    assert decode_nmt(frame.data, node_id or 99) is command
