"""Wire faults in files: what they are called, what they act on, what is refused, and who cannot do them."""

from typing import Final

import pytest

from canopen_exo.bus.frame import Frame
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import dump, validate
from fi_gateway.errors import FaultError
from fi_gateway.fault_specs import FAULTS, WireFaultSpec
from fi_gateway.marked_yaml import FileErrors, parse
from fi_gateway.on_wire import Disturbed
from fi_gateway.schema import InjectorSpec, build_injectors, check_injectors, describe_injectors, refuse_wire_faults

NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))


def spec(fault: str, target: str, more: str = "event: {type: never}, effect: {type: infinite}") -> InjectorSpec:
    """The injector, checked; raises FileErrors."""
    document = parse(f"a: {{target: {target}, fault: {fault}, {more}}}\n", "s.yaml")
    assert isinstance(document.data, dict)
    found = validate(InjectorSpec, document.data["a"], ("a",), document)
    check_injectors(document.data, PLAN, document.report)
    document.raise_problems()
    assert found is not None
    return found


WORDS: Final = [
    ("{type: bit_error, field: data, bit: 3}", "{node: right_knee, pdo: TPDO1}",
     "TPDO1 of right_knee (0x185, both ways) on the drive bus has bit 3 of its data seen inverted until",
     "right_knee.TPDO1@drive"),
    ("{type: bit_error, field: crc, receivers: [left_hip, gateway]}", "{bus: to_drives, kind: sync}",
     "SYNC (0x080, to_drives) on the drive bus has bit 0 of its crc seen inverted by left_hip and gateway alone until",
     "SYNC 0x080@drive"),
    ("{type: stuck_dominant}", "{wire: controller}", "the controller bus is held dominant until", "controller bus"),
    ("{type: no_ack}", "{wire: controller, node: controller}",
     "controller on the controller bus is not acknowledged by anybody until", "controller.controller bus"),
    ("{type: no_ack, receivers: [gateway]}", "{node: left_hip}",
     "left_hip on the drive bus is not acknowledged by gateway until", "left_hip.drive bus"),
    ("{type: bit_error_rate, rate: 1e-5}", "{wire: drive}",
     "the drive bus has each bit seen inverted with probability 1e-05 until", "drive bus"),
    ("{type: gilbert_elliott, enter: 1 %, leave: 3 %, rate_bad: 5 %}", "{}",
     "the drive bus has bits seen inverted in bursts of 33.3333 bits on average, 25 % of the time, "
     "with probability 0.05 in them and 0 else until", "drive bus"),
    ("{type: bus_off, restart: 20 ms}", "{node: gateway}",
     "gateway on the drive bus is bus-off (and asked to restart 20 ms after that) until", "gateway.drive bus"),
    ("{type: babbling_idiot, cob_id: 0x001, payload: '02 FF'}", "{wire: controller}",
     "the controller bus is kept busy with frames 001#02FF of a further node until", "controller bus"),
]  # fmt: skip


@pytest.mark.parametrize(("fault", "target", "words", "name"), WORDS)
def test_a_wire_fault_is_said_in_words_written_back_and_built(fault: str, target: str, words: str, name: str) -> None:
    """`exo-hil check` names bus and nodes; the resolved file reads as an equal injector; records name the place."""
    found = spec(fault, target)
    (line,) = describe_injectors({"a": found}, PLAN, 10**9)
    assert line.startswith(f"a: {words}")
    assert validate(InjectorSpec, dump(InjectorSpec, found), (), None) == found
    (one,) = build_injectors({"a": found}, PLAN, 1, 0)
    assert one.wire is not None
    assert one.wire.bus == ("controller" if "controller" in target else "drive")
    assert one.target.name == name


def test_every_wire_fault_is_in_these_tables() -> None:
    """None without words."""
    types = {row[0].removeprefix("{type: ").split(",")[0].rstrip("}") for row in WORDS}
    assert types == {word for word, found in FAULTS.built_in.items() if issubclass(found, WireFaultSpec)}


@pytest.mark.parametrize(
    ("fault", "target", "message"),
    [
        ("{type: bit_error, field: data, bit: 64}", "{pdo: TPDO1}", "a.fault.bit: there is no bit 64; data of TPDO1"),
        ("{type: bit_error, field: data, bit: 8}", "{kind: sync}", "on the drive bus has bits 0..7"),
        ("{type: bit_error, field: eof, bit: 7}", "{}", "eof of the drive bus has bits 0..6"),
        ("{type: bit_error, field: data}", "{cob_id: 0x185, bits: {start: 0, length: 1}}", "leave bits out"),
        ("{type: bit_error, field: tail}", "{}", "a.fault.field"),
        ("{type: bit_error, field: crc, receivers: [controller]}", "{}", "'controller' is not on the drive bus"),
        ("{type: no_ack, receivers: [left_hip]}", "{wire: controller}", "not on the controller bus (there are"),
        ("{type: no_ack}", "{node: left_nee}", "'left_nee' is not on the drive bus; did you mean 'left_knee'"),
        ("{type: no_ack}", "{bus: to_controller, kind: sync}", "SYNC does not travel to_controller"),
        ("{type: no_ack}", "{bus: to_drives, node: left_hip}", "left_hip on the drive bus sends nothing to_drives"),
        ("{type: stuck_dominant}", "{node: left_hip}", "stuck_dominant acts on a whole bus"),
        ("{type: bit_error_rate, rate: 1e-5}", "{pdo: TPDO1}", "bit_error_rate acts on a whole bus"),
        ("{type: bit_error_rate, rate: 0}", "{}", "a.fault.rate: 0 given"),
        ("{type: gilbert_elliott, enter: 0, leave: 1, rate_bad: 1}", "{}", "a.fault.enter: 0 given"),
        ("{type: babbling_idiot}", "{bus: to_drives}", "babbling_idiot acts on a whole bus"),
        ("{type: bus_off}", "{}", "bus_off acts on a node; give node alone"),
        ("{type: bus_off}", "{node: left_hip, pdo: TPDO1}", "bus_off acts on a node; give node alone"),
        ("{type: stuck_at}", "{bus: both, wire: drive, cob_id: 0x185}", "a.target.wire: only wire faults (bit_error"),
    ],
)
def test_what_cannot_be_is_refused_with_the_remedy(fault: str, target: str, message: str) -> None:
    """At its key, with what is allowed."""
    with pytest.raises(FileErrors) as found:
        spec(fault, target)
    assert message in str(found.value)


@pytest.mark.parametrize("fault", ["bus_off, restrt: 1 s", "no_ack, receivers: 5", "bit_error, field: tail"])
def test_a_wire_fault_with_a_wrong_key_is_told_of_that_key_alone(fault: str) -> None:
    """Its target needs no direction of travel: the type says that it is a wire fault, whatever else is wrong."""
    with pytest.raises(FileErrors) as found:
        spec(f"{{type: {fault}}}", "{node: right_knee}")
    (message,) = found.value.messages
    assert "a.fault." in message


def test_events_that_count_frames_need_frames_in_the_target() -> None:
    """A bus as a whole has none that pass the gateway; a wire fault has no payload to repair."""
    more = "event: {type: every, n: 5}, effect: {type: once}"
    with pytest.raises(FileErrors, match=r"a\.event: counts target frames"):
        spec("{type: stuck_dominant}", "{wire: drive}", more)
    assert spec("{type: no_ack}", "{pdo: TPDO1}", more)


def test_a_direction_leaves_the_frames_of_that_side() -> None:
    """Port 0 of both buses is the controller's side."""
    masks = []
    for target in ("{bus: to_drives}", "{bus: to_controller}", "{node: left_hip}", "{}"):
        (one,) = build_injectors({"a": spec("{type: no_ack}", target)}, PLAN, 1, 0)
        assert isinstance(one.wire, Disturbed)
        fault = one.wire.disturbance
        fault.begin(0)
        masks.append([bool(fault.errors(0, 1, 1000, Frame(0x185, b""), port)) for port in range(3)])
    assert masks == [[True, False, False], [False, True, True], [False, True, False], [True, True, True]]


def test_what_has_no_emulated_bus_refuses_them_with_the_reason_and_who_can() -> None:
    """One line."""
    specs = {"ok": spec("{type: drop}", "{bus: both, cob_id: 0x185}"), "bad": spec("{type: no_ack}", "{}")}
    with pytest.raises(FaultError) as found:
        refuse_wire_faults(specs, "exo-hil gateway")
    text = str(found.value)
    assert text.startswith("injectors.bad.fault: exo-hil gateway cannot do no_ack: ")
    assert "exo-hil run" in text
    assert "exo-hil hub --timed --errors" in text
    assert "\n" not in text
    refuse_wire_faults({"ok": specs["ok"]}, "exo-hil gateway")
