"""Faults in files: what each key does on the wire, what is refused and why, and how it is said in words."""

from typing import Final

import pytest
from numpy.random import PCG64, Generator

from canopen_exo.bus.frame import Frame
from canopen_exo.bus.node import MS, SECOND
from canopen_exo.plan import BusPlan, JointNode
from fi_gateway.boundary import dump, validate
from fi_gateway.fault_specs import FAULTS, WireFaultSpec
from fi_gateway.faults import Fault
from fi_gateway.marked_yaml import FileErrors, parse
from fi_gateway.schema import InjectorSpec, check_injectors
from fi_gateway.target import resolve
from tests.fi_gateway.faults.bench import Taken

NAMES: Final = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
PLAN: Final = BusPlan(tuple(JointNode(name, number, 54_900, 131_072) for number, name in enumerate(NAMES, 1)))
"""131072 counts a revolution: 1 deg is 364.09 counts, 1 rpm 2184.53 counts/s."""

POSITION: Final = "{bus: to_controller, node: right_knee, signal: position}"
VELOCITY: Final = "{bus: to_controller, node: right_knee, signal: velocity}"
TORQUE: Final = "{bus: to_controller, node: right_knee, signal: torque}"
PHASE: Final = "{bus: to_drives, signal: HLC_status.phase}"
WORD: Final = "{bus: to_controller, node: right_knee, signal: statusword}"
TPDO1: Final = "{bus: to_controller, node: right_knee, pdo: TPDO1}"
EVERY_TPDO1: Final = "{bus: to_controller, pdo: TPDO1}"
UNKNOWN: Final = "{bus: both, cob_id: 0x123}"


def spec(fault: str, target: str = POSITION) -> InjectorSpec:
    """The injector with that fault, checked; raises FileErrors."""
    text = f"a: {{target: {target}, fault: {fault}, event: {{type: never}}, effect: {{type: infinite}}}}\n"
    document = parse(text, "s.yaml")
    assert isinstance(document.data, dict)
    found = validate(InjectorSpec, document.data["a"], ("a",), document)
    check_injectors(document.data, PLAN, document.report)
    document.raise_problems()
    assert found is not None
    return found


def begun(fault: str, target: str = POSITION) -> Fault:
    """The engine's fault, active from 0 ns on; 1 and 2 were the last position and velocity."""
    found = spec(fault, target)
    one = found.fault.build(resolve(found.target, PLAN))
    assert one.begin(0, {0x185: Frame(0x185, bytes.fromhex("0100000002000000"))}, Generator(PCG64(1)))
    return one


def outcome(fault: str, target: str, data: str, now: int) -> Frame | None:
    return begun(fault, target).apply(now, Frame(0x185, bytes.fromhex(data)), Taken())


@pytest.mark.parametrize(
    ("fault", "target", "now", "data", "result"),
    [
        ("{type: package_drop, value: 0 deg}", POSITION, 0, "05000000 06000000", "00000000 06000000"),
        ("{type: package_drop, value: -1 counts/s}", VELOCITY, 0, "05000000 06000000", "05000000 FFFFFFFF"),
        ("{type: time_delay, lag: 5 ms}", POSITION, MS, "05000000 06000000", "01000000 06000000"),
        ("{type: gain, factor: 120 %}", POSITION, 0, "0A000000 06000000", "0C000000 06000000"),
        ("{type: gain, factor: -1}", VELOCITY, 0, "05000000 06000000", "05000000 FAFFFFFF"),
        ("{type: drift, slope: 1 deg/s}", POSITION, SECOND, "00000000 06000000", "6C010000 06000000"),
        ("{type: drift, slope: 0.001 deg/ms}", POSITION, SECOND, "00000000 06000000", "6C010000 06000000"),
        ("{type: drift, slope: 1 rpm}", POSITION, SECOND, "00000000 06000000", "89080000 06000000"),
        ("{type: drift, slope: 60 counts/min}", POSITION, SECOND, "00000000 06000000", "01000000 06000000"),
        ("{type: drift, slope: 2.5 counts/s}", POSITION, 2 * SECOND, "00000000 00000000", "05000000 00000000"),
        ("{type: drift, slope: 1 rpm/s}", VELOCITY, SECOND, "05000000 00000000", "05000000 89080000"),
        ("{type: drift, slope: 3 rad/s^2}", VELOCITY, SECOND, "05000000 00000000", "05000000 76F40000"),
        ("{type: drift, slope: 3 rad/s/s}", VELOCITY, SECOND, "05000000 00000000", "05000000 76F40000"),
        ("{type: drift, slope: -7 counts/s/s}", VELOCITY, SECOND, "05000000 00000000", "05000000 F9FFFFFF"),
        ("{type: drift, slope: 5.49 N m/s}", TORQUE, SECOND, "0000 0000 0000", "0000 6400 0000"),
        ("{type: drift, slope: 3 /s}", WORD, SECOND, "0000 0000 0000", "0300 0000 0000"),
        ("{type: bit_stuck, positions: [0, 31], level: 1}", POSITION, 0, "00000000 06000000", "01000080 06000000"),
        ("{type: bit_stuck, positions: [63], level: 0}", TPDO1, 0, "05000000 FFFFFFFF", "05000000 FFFFFF7F"),
        ("{type: corrupt_dlc, dlc: 3}", TPDO1, 0, "05000000 06000000", "050000"),
        ("{type: duplicate}", TPDO1, 0, "05000000 06000000", "05000000 06000000"),
        ("{type: replay, frames: 3}", TPDO1, 0, "05000000 06000000", "05000000 06000000"),
        ("{type: insert, payload: '02 05', cob_id: 0x000}", TPDO1, 0, "05000000 06000000", "05000000 06000000"),
    ],
)
def test_a_fault_in_a_file_does_what_it_says(fault: str, target: str, now: int, data: str, result: str) -> None:
    """Values in units of the file become the right bits on the wire, `now` ns after the start."""
    found = outcome(fault, target, data, now)
    assert found is not None
    assert found.data == bytes.fromhex(result)


@pytest.mark.parametrize(
    ("fault", "phase"),
    [
        ("stuck_at_value, value: 0.25 stride", 0x4000),
        ("stuck_at_value, value: 25 %", 0x4000),
        ("stuck_at_value, value: 16384 counts", 0x4000),
        ("package_drop, value: 12.5%", 0x2000),
        ("bias, value: -25 %", 0x4000),
        ("bias, value: 0.25 stride", 0xC000),
        ("drift, slope: 0.25 stride/s", 0xC000),
        ("drift, slope: 0.025 %/ms", 0xC000),
        ("drift, slope: 2.5 counts/s", 0x8003),
    ],
)
def test_the_gait_phase_is_written_in_strides_or_per_cent(fault: str, phase: int) -> None:
    """HLC_status.phase, u16 of 1/65536 stride, behind state and cycle; half a stride came in, 1 s after the start."""
    result = begun(f"{{type: {fault}}}", PHASE).apply(SECOND, Frame(0x2FF, bytes.fromhex("0200000080")), Taken())
    assert result is not None
    assert result.data == bytes.fromhex("020000") + phase.to_bytes(2, "little")


@pytest.mark.parametrize(("amount", "most"), [("1 %", 655), ("0.01 stride", 655), ("655 counts", 655)])
def test_noise_of_the_gait_phase_has_its_amount_in_strides(amount: str, most: int) -> None:
    """Uniform: up to that amount, rounded."""
    fault = begun(f"{{type: noise, uniform: {amount}}}", PHASE)
    results = [fault.apply(0, Frame(0x2FF, bytes.fromhex("0200000080")), Taken()) for _ in range(2000)]
    errors = [abs(int.from_bytes(one.data[3:], "little") - 0x8000) for one in results if one is not None]
    assert 0.98 * most < max(errors) <= most


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("stuck_at_value, value: 0.25", "0.25 has no unit; a gait phase needs one (units: stride, %; for example"),
        ("stuck_at_value, value: 3", "3 has no unit"),
        ("stuck_at_value, value: 100 %", "100 % is more than phase of controller can carry; allowed 0..0.999985 str"),
        ("stuck_at_value, value: 5 deg", "'5 deg' is an angle; a gait phase is wanted"),
        ("drift, slope: 3 /s", "phase of controller changes in stride per time, such as '10 %/s'; got '3 /s'"),
        ("noise, normal: 1", "1 has no unit"),
    ],
)
def test_a_plain_number_is_no_gait_phase(fault: str, message: str) -> None:
    """3 could be strides, per cent or counts."""
    with pytest.raises(FileErrors) as caught:
        spec(f"{{type: {fault}}}", PHASE)
    (said,) = caught.value.messages
    assert message in said


@pytest.mark.parametrize(
    ("fault", "late", "inserted"),
    [
        ("{type: delay, time: 5 ms}", [(5 * MS, "185", True)], []),
        ("{type: delay, time: 5 ms, reorder: true}", [(5 * MS, "185", False)], []),
        ("{type: delay, time: 1 ms, law: {type: normal, mean: 2 ms, sd: 0 s}}", [(3 * MS, "185", True)], []),
        ("{type: delay, law: {type: normal, mean: 2 ms, sd: 0 s}}", [(2 * MS, "185", True)], []),
        ("{type: resequence, span: 4 ms}", [(8 * MS, "185", False)], []),
        ("{type: duplicate, copies: 2}", [], ["185", "185"]),
        ("{type: duplicate, copies: 2, gap: 1 ms}", [(MS, "185", False), (2 * MS, "185", False)], []),
        ("{type: insert, payload: '02 05', cob_id: 0}", [], ["000"]),
        ("{type: insert, payload: '02 05'}", [], ["185"]),
        ("{type: masquerade, as: 0x182, copy: true}", [], ["182"]),
    ],
)
def test_a_fault_in_a_file_sends_what_it_says(
    fault: str, late: list[tuple[int, str, bool]], inserted: list[str]
) -> None:
    """Times and identities reach the outlet, for a frame at 0 ns."""
    out = Taken()
    begun(fault, TPDO1).apply(0, Frame(0x185, bytes(8)), out)
    assert [(at, f"{one.can_id:03X}", in_order) for at, one, in_order in out.late] == late
    assert [f"{one.can_id:03X}" for one in out.inserted] == inserted


def test_the_other_way_to_insert_is_periodic() -> None:
    """`every`: on its own, from the start on."""
    fault, out = begun("{type: insert, payload: '', cob_id: 0x080, every: 5 ms}", TPDO1), Taken()
    assert fault.wake_at == 0
    fault.wake(0, out)
    assert (fault.wake_at, out.inserted) == (5 * MS, [Frame(0x080, b"")])


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        ("{type: noise, relative: 20 %}", "RelativeNoise"),
        ("{type: noise, relative: 1.5}", "RelativeNoise"),
        ("{type: noise, uniform: 2 deg}", "UniformNoise"),
        ("{type: noise, normal: 0.5 deg}", "NormalNoise"),
        ("{type: noise, normal: 0.3 counts}", "NormalNoise"),
    ],
)
def test_noise_comes_in_three_kinds(fault: str, kind: str) -> None:
    """One of three keys; amounts in the unit of the signal, or relative to its value."""
    assert type(begun(fault)).__name__ == kind


def test_amounts_of_noise_are_in_the_unit_of_the_signal() -> None:
    """2 deg are 728.2 counts: the largest of 2000 uniform draws comes within 1 % of it, and not beyond."""
    fault = begun("{type: noise, uniform: 2 deg}")
    errors = []
    for _ in range(2000):
        result = fault.apply(0, Frame(0x185, bytes(8)), Taken())
        assert result is not None
        errors.append(abs(int.from_bytes(result.data[:4], "little", signed=True)))
    assert 720 < max(errors) <= 728


@pytest.mark.parametrize(
    ("fault", "lost"),
    [("{type: drop, p: 0 %, r: 50 %}", 0), ("{type: drop, p: 1, r: 0}", 100),
     ("{type: drop, p: 1, r: 0, loss_bad: 0 %}", 0), ("{type: drop, p: 0, r: 1, loss_good: 100 %}", 100)],
)  # fmt: skip
def test_bursts_of_losses_are_given_by_four_probabilities(fault: str, lost: int) -> None:
    """Gilbert-Elliott: p, r, loss_good (default 0), loss_bad (default 1)."""
    one = begun(fault, TPDO1)
    assert sum(one.apply(n, Frame(0x185, bytes(8)), Taken()) is None for n in range(100)) == lost


REFUSED: Final = [
    ("{type: package_drop}", POSITION, ["a.fault.value: missing; needed: type, value"]),
    ("{type: package_drop, value: 0}", POSITION, ["a.fault.value: position of right_knee: 0 has no unit"]),
    ("{type: package_drop, value: 1 rad}", TPDO1, ["a.fault.type: package_drop acts on a signal", "add signal"]),
    ("{type: package_drop, value: 200000 rad}", POSITION, ["a.fault.value", "allowed -102944..102944 rad"]),
    ("{type: time_delay, lag: 5}", POSITION, ["a.fault.lag: 5 has no unit; a duration needs one"]),
    ("{type: time_delay, lag: 0 s}", POSITION, ["a.fault.lag: '0 s' is not a length of time"]),
    ("{type: time_delay, lag: 5 ms}", TPDO1, ["a.fault.type: time_delay acts on a signal"]),
    ("{type: gain}", POSITION, ["a.fault.factor: missing; needed: type, factor"]),
    ("{type: gain, factor: 2 deg}", POSITION, ["a.fault.factor: expected a number such as 1.2", "got '2 deg'"]),
    ("{type: gain, factor: .nan}", POSITION, ["a.fault.factor: .nan is not a finite number"]),
    ("{type: gain, factor: -1.1e9}", POSITION, ["a.fault.factor: -1100000000.0 is too large; allowed up to 1e+09"]),
    ("{type: gain, factor: true}", POSITION, ["a.fault.factor: expected a number such as 1.2", "got true"]),
    ("{type: gain, factor: 2}", TPDO1, ["a.fault.type: gain acts on a signal"]),
    ("{type: drift, slope: 1 deg}", POSITION, ["a.fault.slope: position of right_knee changes in rad per time, such as "
     "'1 deg/s'; got '1 deg'"]),
    ("{type: drift, slope: 1 rad/s}", VELOCITY, ["a.fault.slope", "changes in rad/s per time, such as '10 rpm/s'"]),
    ("{type: drift, slope: 3}", POSITION, ["a.fault.slope", "such as '1 deg/s'; got 3"]),
    ("{type: drift, slope: x/s}", WORD, ["a.fault.slope", "plain numbers per time, such as '3 /s'"]),
    ("{type: drift, slope: 1e25 rad/s}", POSITION, ["a.fault.slope: 1e25 rad/s passes the whole range of position"]),
    ("{type: noise}", POSITION, ["a.fault: noise needs exactly one of relative, uniform, normal"]),
    ("{type: noise, relative: 20 %, normal: 1 deg}", POSITION, ["a.fault.normal: noise needs exactly one of relative, "
     "uniform, normal; got relative and normal"]),
    ("{type: noise, relative: -20 %}", POSITION, ["a.fault.relative: -0.2 is no amount of noise"]),
    ("{type: noise, uniform: 2}", POSITION, ["a.fault.uniform: position of right_knee: 2 has no unit"]),
    ("{type: noise, uniform: 0 deg}", POSITION, ["a.fault.uniform: '0 deg' is no amount of noise"]),
    ("{type: noise, uniform: 0.5 counts}", POSITION, ["not more than half of one count", "would change nothing"]),
    ("{type: noise, normal: 1 deg}", TPDO1, ["a.fault.type: noise acts on a signal"]),
    ("{type: bit_stuck, positions: [3]}", POSITION, ["a.fault.level: missing; needed: type, positions, level"]),
    ("{type: bit_stuck, positions: [3], level: 2}", POSITION, ["a.fault.level: unknown level 2 (allowed: 0, 1)"]),
    ("{type: bit_stuck, positions: [32], level: 1}", POSITION, ["a.fault.positions.0: there is no bit 32", "0..31"]),
    ("{type: bit_stuck, positions: [3, 3], level: 1}", POSITION, ["a.fault.positions.1: bit 3 is given twice"]),
    ("{type: drop, p: 1 %}", TPDO1, ["a.fault.p: losses in bursts need p (good to bad) and r (bad to good)"]),
    ("{type: drop, loss_bad: 1 %}", TPDO1, ["a.fault.loss_bad: losses in bursts need p"]),
    ("{type: drop, p: 1 %, r: 1 %, probability: 1 %}", TPDO1, ["a.fault.probability: losses in bursts are given by"]),
    ("{type: drop, p: 0, r: 0}", TPDO1, ["a.fault.p: p and r are both 0", "give probability instead"]),
    ("{type: drop, p: 2, r: 0}", TPDO1, ["a.fault.p: 2 is not a probability"]),
    ("{type: delay}", TPDO1, ["a.fault: time or law is missing", "time: 5 ms"]),
    ("{type: delay, time: 5}", TPDO1, ["a.fault.time: 5 has no unit; a duration needs one"]),
    ("{type: delay, time: 5 ms}", POSITION, ["a.fault.type: delay holds whole frames back (time_delay lets a signal"]),
    ("{type: delay, law: {type: nomal}}", TPDO1, ["a.fault.law.type: unknown law 'nomal'; did you mean 'normal'?"]),
    ("{type: delay, law: {type: normal, mean: 5, sd: 1 ms}}", TPDO1, ["a.fault.law.mean: 5 has no unit"]),
    ("{type: resequence}", TPDO1, ["a.fault.span: missing; needed: type, span"]),
    ("{type: resequence, span: 4 ms, order: up}", TPDO1, ["a.fault.order: unknown order 'up' (allowed: rev"]),
    ("{type: duplicate, copies: 0}", TPDO1, ["a.fault.copies: 0 is too small; allowed from 1 up"]),
    ("{type: duplicate, copies: 101}", TPDO1, ["a.fault.copies: 101 is too large; allowed up to 100"]),
    ("{type: duplicate}", POSITION, ["a.fault.type: duplicate repeats whole frames", "give pdo instead of position"]),
    ("{type: replay}", TPDO1, ["a.fault.frames: missing; needed: type, frames"]),
    ("{type: replay, frames: 3, mode: mix}", TPDO1, ["a.fault.mode: unknown mode 'mix' (allowed: replace, add)"]),
    ("{type: insert}", TPDO1, ["a.fault.payload: missing; needed: type, payload"]),
    ("{type: insert, payload: 1}", TPDO1, ["a.fault.payload: expected 1 to 8 bytes in hexadecimal", "got 1"]),
    ("{type: insert, payload: '01'}", EVERY_TPDO1, ["a.fault: cob_id is missing", "has 6 of them"]),
    ("{type: insert, payload: '01', every: 5 ms}", UNKNOWN, ["a.fault.every: in which direction?", "bus: both"]),
    ("{type: insert, payload: '01', every: 0 s}", TPDO1, ["a.fault.every: '0 s' is not a length of time"]),
    ("{type: masquerade}", TPDO1, ["a.fault.as: missing; needed: type, as"]),
    ("{type: masquerade, as: 0x185}", TPDO1, ["a.fault.as: 0x185 is the target's own COB-ID"]),
    ("{type: masquerade, as: 0x800}", TPDO1, ["a.fault.as: COB-ID 0x800 is outside 0x0..0x7ff"]),
    ("{type: masquerade, as: 0x182}", POSITION, ["a.fault.type: masquerade changes the COB-ID of whole frames"]),
    ("{type: corrupt_dlc, dlc: 8}", TPDO1, ["a.fault.dlc: TPDO1 of right_knee", "has that DLC already"]),
    ("{type: corrupt_dlc, dlc: 16}", TPDO1, ["a.fault.dlc: 16 is too large; allowed up to 15"]),
    ("{type: corrupt_dlc}", POSITION, ["a.fault.type: corrupt_dlc changes the length of whole frames"]),
]  # fmt: skip


@pytest.mark.parametrize(("fault", "target", "message"), REFUSED)
def test_a_fault_that_cannot_be_is_refused(fault: str, target: str, message: list[str]) -> None:
    """What, where, got, allowed, remedy; exactly one message."""
    with pytest.raises(FileErrors) as caught:
        spec(fault, target)
    (said,) = caught.value.messages
    assert said.startswith("s.yaml:1:")
    assert all(words in said for words in message), said


WORDS: Final = [
    ("{type: package_drop, value: 0 deg}", POSITION, "replaced by 0 deg"),
    ("{type: time_delay, lag: 20 ms}", POSITION, "lags by 20 ms"),
    ("{type: gain, factor: 120 %}", POSITION, "multiplied by 1.2"),
    ("{type: drift, slope: 1 deg/s}", POSITION, "drifts by 1 deg/s"),
    ("{type: noise, relative: 20 %}", POSITION, "has uniform noise of up to 20 % of its value"),
    ("{type: noise, uniform: 2 deg}", POSITION, "has uniform noise of up to 2 deg"),
    ("{type: noise, normal: 2 deg}", POSITION, "has normal noise with standard deviation 2 deg"),
    ("{type: bit_stuck, positions: [3, 4], level: 0}", POSITION, "has bits 3, 4 held at 0"),
    ("{type: drop, p: 1 %, r: 25 %}", TPDO1, "lost in bursts (3.85 % of the frames, bad for 4 frames on average)"),
    ("{type: drop, p: 1 %, r: 0}", TPDO1, "lost in bursts (100 % of the frames)"),
    ("{type: delay, time: 5 ms}", TPDO1, "delayed by 5 ms"),
    ("{type: delay, time: 5 ms, law: {type: exponential, mean: 1 ms}, reorder: true}", TPDO1,
     "delayed by 5 ms and a time drawn from exponential (mean 1 ms), in any order,"),
    ("{type: resequence, span: 4 ms, order: random}", TPDO1, "put into random order within every 4 ms"),
    ("{type: duplicate}", TPDO1, "sent twice"),
    ("{type: duplicate, copies: 2, gap: 1 ms}", TPDO1, "sent 3 times, 1 ms apart,"),
    ("{type: replay, frames: 1}", TPDO1, "recorded for 1 frame, then replayed in place of fresh ones"),
    ("{type: replay, frames: 9, mode: add}", TPDO1, "recorded for 9 frames, then replayed besides fresh ones"),
    ("{type: insert, payload: '02 05', cob_id: 0, every: 1 s}", TPDO1, "joined by further frames 000#0205, every 1 s,"),
    ("{type: insert, payload: '02 05'}", TPDO1, "joined by further frames 185#0205, ahead of each,"),
    ("{type: masquerade, as: 0x182}", TPDO1, "passed on as 0x182"),
    ("{type: masquerade, as: 0x182, copy: true}", TPDO1, "also passed on as 0x182"),
    ("{type: corrupt_dlc}", TPDO1, "cut or filled to a random DLC"),
    ("{type: corrupt_dlc, dlc: 4}", TPDO1, "sent with DLC 4"),
]  # fmt: skip


@pytest.mark.parametrize(("fault", "target", "words"), WORDS)
def test_a_fault_can_be_read_aloud_and_written_back(fault: str, target: str, words: str) -> None:
    """`exo-hil check` says it; the resolved file reads as an equal injector."""
    found = spec(fault, target)
    assert found.fault.words(resolve(found.target, PLAN)) == words
    assert validate(InjectorSpec, dump(InjectorSpec, found), (), None) == found


def test_every_new_type_is_in_these_tables() -> None:
    """Each built-in type is read, refused and said in words, here or in the tests of schema and wire faults."""
    wire = {word for word, found in FAULTS.built_in.items() if issubclass(found, WireFaultSpec)}
    elsewhere = {"stuck_at", "stuck_at_value", "bias", "bit_flip"} | wire
    for table in (REFUSED, WORDS):
        types = {str(row[0]).removeprefix("{type: ").split(",")[0].rstrip("}") for row in table}
        assert types == set(FAULTS.built_in) - elsewhere
