"""The CiA 402 state machine, against tables written from the standard (CiA 402-2, IEC 61800-7-201)."""

import itertools

import pytest

from canopen_exo.cia402 import (
    TRANSITIONS,
    DriveCommand,
    DriveState,
    DriveStateMachine,
    decode_controlword,
    decode_statusword,
    enabling_controlword,
)

STATES = {
    "not ready": DriveState.NOT_READY_TO_SWITCH_ON,
    "disabled": DriveState.SWITCH_ON_DISABLED,
    "ready": DriveState.READY_TO_SWITCH_ON,
    "on": DriveState.SWITCHED_ON,
    "enabled": DriveState.OPERATION_ENABLED,
    "quick stop": DriveState.QUICK_STOP_ACTIVE,
    "reaction": DriveState.FAULT_REACTION_ACTIVE,
    "fault": DriveState.FAULT,
}

COMMANDS = {
    "shutdown": DriveCommand.SHUTDOWN,
    "switch on": DriveCommand.SWITCH_ON,
    "enable": DriveCommand.ENABLE_OPERATION,
    "voltage off": DriveCommand.DISABLE_VOLTAGE,
    "quick stop": DriveCommand.QUICK_STOP,
    "reset": DriveCommand.FAULT_RESET,
}

FIGURE = """
             shutdown  switch on  enable   voltage off  quick stop  reset
not ready    -         -          -        -            -           -
disabled     ready     -          -        -            -           -
ready        -         on         enabled  disabled     disabled    -
on           ready     -          enabled  disabled     disabled    -
enabled      ready     on         -        disabled     quick stop  -
quick stop   -         -          enabled  disabled     -           -
reaction     -         -          -        -            -           -
fault        -         -          -        -            -           disabled
"""
"""The power drive system's state figure, a row per state, a column per command; "-": nothing happens.

Ready to switch on with "enable operation" is transitions 3 and 4 in one command, which the standard allows.
"""


def figure() -> dict[tuple[str, str], str]:
    rows = [line for line in FIGURE.splitlines() if line.strip()]
    columns = [(name, rows[0].index(name)) for name in COMMANDS]
    starts = [at for _, at in columns] + [len(rows[0]) + 20]
    table = {}
    for row in rows[1:]:
        for (name, at), end in zip(columns, starts[1:], strict=True):
            cell = row[at:end].strip()
            table[row[:13].strip(), name] = row[:13].strip() if cell == "-" else cell
    return table


def machine_in(state: DriveState) -> DriveStateMachine:
    machine = DriveStateMachine()
    machine.state = state
    return machine


# --- states and commands -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("state", "command"), list(itertools.product(STATES, COMMANDS)))
def test_command_leads_where_the_figure_says(state: str, command: str) -> None:
    """Every state with every command; the return value tells a change."""
    after = figure()[state, command]
    machine = machine_in(STATES[state])
    assert machine.command(COMMANDS[command]) == (after != state)
    assert machine.state is STATES[after]


def test_table_has_no_further_transitions() -> None:
    """Style: transitions live in one table; it is the figure, no more and no less."""
    expected = {
        (STATES[state], COMMANDS[command]): STATES[after]
        for (state, command), after in figure().items()
        if after != state
    }
    assert expected == TRANSITIONS


CODING = [
    # bits 7 3 2 1 0 of the controlword (None: not looked at), command
    ((0, None, 1, 1, 0), DriveCommand.SHUTDOWN),
    ((0, 0, 1, 1, 1), DriveCommand.SWITCH_ON),
    ((0, 1, 1, 1, 1), DriveCommand.ENABLE_OPERATION),
    ((0, None, None, 0, None), DriveCommand.DISABLE_VOLTAGE),
    ((0, None, 0, 1, None), DriveCommand.QUICK_STOP),
]
"""The standard's table of command coding; disable operation is coded as switch on, fault reset is an edge."""


@pytest.mark.parametrize("controlword", range(32))
def test_controlword_is_decoded_as_the_table_says(controlword: int) -> None:
    """Bits 0..3; bit 4 belongs to the mode and plays no part."""
    bits = [controlword >> 7 & 1, *(controlword >> at & 1 for at in (3, 2, 1, 0))]
    found = [
        command
        for pattern, command in CODING
        if all(want is None or want == bit for want, bit in zip(pattern, bits, strict=True))
    ]
    assert len(found) == 1
    assert decode_controlword(controlword) is found[0]


@pytest.mark.parametrize("other", [1 << at for at in (4, 5, 6, 8, 9, 11, 12, 13, 14, 15)])
@pytest.mark.parametrize("word", [0x00, 0x02, 0x06, 0x07, 0x0F])
def test_other_bits_do_not_change_the_command(word: int, other: int) -> None:
    """Bits 4-6, 8, 9 belong to the mode, 11-15 to the manufacturer."""
    assert decode_controlword(word | other) is decode_controlword(word)


@pytest.mark.parametrize(("state", "word"), list(itertools.product(STATES, (0x00, 0x02, 0x06, 0x07, 0x0F))))
def test_controlword_does_what_its_command_does(state: str, word: int) -> None:
    """From the wire: `controlword` is decoding and the table."""
    one, other = machine_in(STATES[state]), machine_in(STATES[state])
    command = decode_controlword(word)
    assert command is not None
    assert one.controlword(word) == other.command(command)
    assert one.state is other.state


def test_shutdown_then_enable_operation_goes_in_one_step() -> None:
    """Device rules: real masters send 0x06 and then 0x0F without 0x07."""
    machine = DriveStateMachine()
    assert machine.controlword(0x06)
    assert machine.controlword(0x0F)
    assert machine.state is DriveState.OPERATION_ENABLED


def test_drive_is_enabled_and_disabled_step_by_step() -> None:
    """Transitions 2, 3, 4, 5, 6, 7 in turn."""
    machine = DriveStateMachine()
    seen = []
    for word in (0x06, 0x07, 0x0F, 0x07, 0x06, 0x00):
        machine.controlword(word)
        seen.append(machine.state)
    names = ["ready", "on", "enabled", "on", "ready", "disabled"]
    assert seen == [STATES[name] for name in names]


def test_enable_operation_alone_does_nothing_in_switch_on_disabled() -> None:
    """Without shutdown first there is no way up."""
    machine = DriveStateMachine()
    for word in (0x0F, 0x07, 0x0F):
        assert not machine.controlword(word)
    assert machine.state is DriveState.SWITCH_ON_DISABLED


# --- faults ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", STATES)
def test_fault_ends_in_fault_from_every_state(state: str) -> None:
    """Transitions 13 and 14: the reaction is over within one step."""
    machine = machine_in(STATES[state])
    machine.fault()
    assert machine.state is DriveState.FAULT


@pytest.mark.parametrize("word", [0x80, 0x86, 0x8F, 0xFF, 0xFFFF])
def test_fault_is_reset_on_the_edge_of_bit_7(word: int) -> None:
    """Transition 15: 0 -> 1, whatever the other bits."""
    machine = DriveStateMachine()
    machine.fault()
    assert not machine.controlword(word & ~0x80)
    assert machine.controlword(word)
    assert machine.state is DriveState.SWITCH_ON_DISABLED


def test_fault_is_not_reset_by_a_bit_7_that_was_set_before() -> None:
    """Transition 15 needs the edge: a level would reset every fault at once."""
    machine = DriveStateMachine()
    machine.controlword(0x80)
    machine.fault()
    assert not machine.controlword(0x80)
    assert machine.state is DriveState.FAULT
    machine.controlword(0x00)
    assert machine.controlword(0x80)


@pytest.mark.parametrize("word", range(0x80))
def test_fault_stays_without_bit_7(word: int) -> None:
    """No other command leaves Fault."""
    machine = DriveStateMachine()
    machine.fault()
    assert not machine.controlword(word)
    assert machine.state is DriveState.FAULT


def test_drive_does_not_enable_itself_with_the_word_that_resets_the_fault() -> None:
    """Transition 15 leads to Switch on disabled; the way up begins with shutdown."""
    machine = DriveStateMachine()
    machine.fault()
    machine.controlword(0x8F)
    machine.controlword(0x0F)
    assert machine.state is DriveState.SWITCH_ON_DISABLED


# --- statusword --------------------------------------------------------------------------------------------------

STATUS = {
    # state: bits 6 5 3 2 1 0 of the statusword (x: not looked at), the standard's table of state coding
    "not ready": "0x0000",
    "disabled": "1x0000",
    "ready": "010001",
    "on": "010011",
    "enabled": "010111",
    "quick stop": "000111",
    "reaction": "0x1111",
    "fault": "0x1000",
}


def mask_and_value(pattern: str) -> tuple[int, int]:
    """The bits a pattern looks at, and what they must be."""
    mask = value = 0
    for want, bit in zip(pattern, (6, 5, 3, 2, 1, 0), strict=True):
        if want != "x":
            mask |= 1 << bit
            value |= int(want) << bit
    return mask, value


def test_every_statusword_is_decoded_as_the_table_says() -> None:
    """All 65536 words: at most one state fits; a pattern the standard does not define is None; nothing raises."""
    coding = [(STATES[name], *mask_and_value(pattern)) for name, pattern in STATUS.items()]
    for word in range(65536):
        found = [state for state, mask, value in coding if word & mask == value]
        assert len(found) <= 1
        assert decode_statusword(word) is (found[0] if found else None), hex(word)


@pytest.mark.parametrize("state", STATES)
def test_statusword_of_a_state_decodes_to_it(state: str) -> None:
    """What the drive shows is what the master reads."""
    assert decode_statusword(machine_in(STATES[state]).statusword) is STATES[state]


@pytest.mark.parametrize("state", STATES)
def test_statusword_says_remote(state: str) -> None:
    """Bit 9: the controlword is processed, always over the bus."""
    assert machine_in(STATES[state]).statusword & 0x0200


@pytest.mark.parametrize("state", ["ready", "on", "enabled", "quick stop"])
def test_voltage_is_enabled_where_the_power_stage_may_be_fed(state: str) -> None:
    """Bit 4."""
    assert machine_in(STATES[state]).statusword & 0x0010


@pytest.mark.parametrize("state", ["not ready", "fault"])
def test_voltage_is_off_in_fault_and_before_start(state: str) -> None:
    """Bit 4."""
    assert not machine_in(STATES[state]).statusword & 0x0010


# --- the master's side -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [state for state in STATES if state not in ("not ready", "reaction")])
def test_enabling_controlwords_lead_to_operation_enabled(state: str) -> None:
    """From every state a master can leave, within four steps; a fault needs its edge first."""
    machine = machine_in(STATES[state])
    words = []
    while machine.state is not DriveState.OPERATION_ENABLED:
        words.append(enabling_controlword(machine.state))
        assert machine.controlword(words[-1]), f"no way on from {machine.state} with {words[-1]:#x}"
        assert len(words) <= 4
    assert enabling_controlword(machine.state) == 0x0F  # hold it there
    assert not machine.controlword(0x0F)


@pytest.mark.parametrize("state", [DriveState.NOT_READY_TO_SWITCH_ON, DriveState.FAULT_REACTION_ACTIVE, None])
def test_master_only_waits_where_only_waiting_helps(state: DriveState | None) -> None:
    """States the drive leaves by itself, and statuswords nobody knows."""
    assert enabling_controlword(state) == 0


def test_master_enables_in_the_usual_order() -> None:
    """Fault reset, shutdown, switch on, enable operation."""
    machine = machine_in(DriveState.FAULT)
    words = []
    for _ in range(4):
        words.append(enabling_controlword(decode_statusword(machine.statusword)))
        machine.controlword(words[-1])
    assert words == [0x80, 0x06, 0x07, 0x0F]
