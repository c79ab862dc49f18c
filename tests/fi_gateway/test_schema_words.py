"""`injectors:` in a file, said in words."""

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import NEVER
from fi_gateway.outlet import Tray
from fi_gateway.schema import build_injectors, describe_injectors
from tests.fi_gateway.injector_texts import PLAN, SECOND, TPDO1, VELOCITY, injector, read


def test_the_plan_of_an_injector_is_said_in_words() -> None:
    """The chain of the first experiment, read aloud."""
    length = "{type: constant_time, duration: 0.3 s}"
    specs = read(
        freeze_position=injector(event="{type: failure_probability, p: 0.0005, per: 1 ms}", effect=length),
        zero_velocity=injector(
            "{type: stuck_at_value, value: 0 rpm}", VELOCITY, effect=length, more=", trigger: {any: [freeze_position]}"
        ),
    )
    assert describe_injectors(specs, PLAN, 7 * SECOND) == [
        "freeze_position: position of right_knee (0x185, to_controller) held at its last value for 0.3 s; starts with "
        "probability 0.0005 per 1 ms (0.5/s), about 3.1 activations of freeze_position expected in 7 s, dead time "
        "included",
        "zero_velocity: velocity of right_knee (0x185, to_controller) reads 0 rpm for 0.3 s; starts when "
        "freeze_position is activated",
        "triggers:",
        "  freeze_position",
        "    `-- activated --> zero_velocity",
    ]


def test_chains_are_drawn() -> None:
    """`exo-hil check` draws who starts whom: branches, joins, chains, frames; each injector in full once."""
    specs = read(
        root=injector(event="{type: at, time: 1 s}"),
        left=injector(more=", trigger: {any: [root]}"),
        right=injector(more=", trigger: {any: [root], on: manifested, delay: 10 ms}"),
        join=injector(more=", trigger: {all: [left, right], on: ended, probability: 50 %}"),
        tail=injector(more=", trigger: {any: [join], edge: level}"),
        bus=injector(more=", trigger: {frame: {cob_id: 0x6F0, data: 01 00, mask: FF 00, bus: to_drives}, delay: 1 s}"),
        after=injector(more=", trigger: {any: [bus, tail]}"),
    )
    lines = describe_injectors(specs, PLAN, 7 * SECOND)
    assert lines[lines.index("triggers:") :] == [
        "triggers:",
        "  root",
        "    |-- activated --> left",
        "    |     `-- ended, with right, with probability 0.5 --> join",
        "    |           `-- activated, while it holds --> tail",
        "    |                 `-- activated --> after",
        "    `-- manifested, 10 ms later --> right",
        "          `-- ended, with left, with probability 0.5 --> join (above)",
        "  frame 0x6F0 01 00 (mask FF 00) to_drives",
        "    `-- 1 s later --> bus",
        "          `-- activated --> after (above)",
    ]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (", trigger: {any: [b, c]}", "when b or c is activated"),
        (", trigger: {any: [b], on: manifested}", "when b manifests"),
        (", trigger: {all: [b, c], on: ended}", "when b and c have all ended"),
        (", trigger: {all: [b, c]}", "when b and c are all activated"),
        (", trigger: {any: [b, c], edge: level}", "while b or c is active"),
        (", trigger: {any: [b], edge: level, on: ended, delay: 2 ms}", "while b has ended, 2 ms later"),
        (", trigger: {any: [b], probability: 20 %}", "when b is activated, with probability 0.2"),
        (", trigger: {frame: {cob_id: 0x6F0, data: 0A}}", "with frame 0x6F0 0A"),
        (", report: {frame: {cob_id: 0x6F1, data: '01', bus: to_drives}, on: ended}",
         "sends 0x6F1 01 to_drives when it ends"),
        (", repair: {checksum: {type: crc8_j1850, byte: 7}, counter: {start: 48, length: 4}}",
         "crc8_j1850 in byte 7 and counter in bits 48..51 put right"),
    ],
)  # fmt: skip
def test_triggers_reports_and_repairs_are_said_in_words(more: str, words: str) -> None:
    """What starts it, what it says on the bus, what it puts right."""
    event = "{type: at, time: 1 s}"
    specs = read(a=injector(more=more), b=injector(event=event), c=injector(event=event))
    assert describe_injectors(specs, PLAN, 7 * SECOND)[0].endswith(words)


@pytest.mark.parametrize(
    ("effect", "more", "words"),
    [
        ("once", "", "in one frame, once a run;"),
        ("once", ", rearm: true", "in one frame, again and again;"),
        ("once", ", max_activations: 3", "in one frame, at most 3 times a run;"),
        ("constant_time, duration: 1 s", "", "for 1 s;"),
        ("constant_time, duration: 1 s", ", rearm: false", "for 1 s, once a run;"),
        ("constant_time, duration: 1 s", ", max_activations: 1", "for 1 s, once a run;"),
        ("constant_time, duration: 1 s", ", max_activations: 2", "for 1 s, at most 2 times a run;"),
    ],
)
def test_how_often_is_said_in_words_and_reaches_the_engine(effect: str, more: str, words: str) -> None:
    """`rearm`, `max_activations` override."""
    times = ", ".join(f"{number} s" for number in range(1, 12, 2))
    text = injector("{type: bias, value: 1 deg}", effect=f"{{type: {effect}}}", more=more,
                    event=f"{{type: at, times: [{times}]}}")  # fmt: skip
    specs = read(a=text)
    assert words in describe_injectors(specs, PLAN, 7 * SECOND)[0]
    one = build_injectors(specs, PLAN, 1, 0)[0]
    one.start(0)
    count = 0
    while one.next_ns < NEVER:
        now = one.next_ns
        one.open(now, "event")
        one.act(now, 1, Frame(0x185, bytes(8)), Tray())
        one.close(now + SECOND)
        count += 1
    most = {"once a": 1, "most 3": 3, "most 2": 2}
    assert count == next((number for word, number in most.items() if word in words), 6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (injector("{type: drop}", TPDO1, "{type: at, time: 3 s}"),
         "TPDO1 of right_knee (0x185, to_controller) lost until the end of the run; starts at 3 s"),
        (injector("{type: drop, probability: 0.2}", "{bus: both, pdo: TPDO1}", "{type: at, times: [2 s, 1 s]}"),
         "TPDO1 of every joint (0x181..0x186, both ways) lost with probability 0.2 each, until the end of the run; "
         "starts at 1 s, 2 s"),
        (injector("{type: bias, value: 5 deg}", more=", enabled: false"),
         "(switched off): position of right_knee (0x185, to_controller) shifted by 5 deg until the end of the run; "
         "never starts"),
        (injector("{type: bit_flip}", event="{type: at, time: 50 ms}", effect="{type: once}", more=", from: power_up"),
         "has 1 random bit inverted (drawn anew for every frame) in one frame, once a run; "
         "starts at 50 ms after power-up"),
        (injector("{type: bit_flip, positions: [1, 2]}", event="{type: failure_probability, p: 1e-3, per: sync}"),
         "has bits 1, 2 inverted until the end of the run; starts with probability 0.001 per sync (0.5/s), activated "
         "in 97 % of the runs of 7 s"),
        (injector("{type: stuck_at_value, payload: 00 ff 00 00 00 00 00 00}", TPDO1),
         "replaced by 00 FF 00 00 00 00 00 00 until"),
    ],
)  # fmt: skip
def test_every_kind_of_injector_can_be_read_aloud(text: str, words: str) -> None:
    """What, where, how long, when."""
    (sentence,) = describe_injectors(read(a=text), PLAN, 7 * SECOND)
    assert words in sentence
