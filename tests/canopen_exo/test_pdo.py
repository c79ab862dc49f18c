"""Process data objects configured by the object dictionary (CiA 301, 7.2.2; objects 1400.., 1600.., 1800.., 1A00..)."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.node import MS, NEVER
from canopen_exo.eds import load_eds
from canopen_exo.errors import CanopenExoError
from canopen_exo.od import ObjectDictionary
from canopen_exo.pdo import INVALID, ReceivePdo, TransmitPdo, key_of, mapping_abort

PATTERN = ObjectDictionary(load_eds())

CONTROLWORD, MODE, TARGET_TORQUE, MAX_TORQUE = 0x60400010, 0x60600008, 0x60710010, 0x60720010
"""Mapping entries: index, sub-index, bits."""
STATUSWORD, POSITION, VELOCITY, TORQUE, REGISTER = 0x60410010, 0x60640020, 0x606C0020, 0x60770010, 0x10010008

NOT_MAPPABLE, TOO_LONG = 0x06040041, 0x06040042


def dictionary() -> ObjectDictionary:
    return PATTERN.copy_for_node(5, {0x607600: 54900})


def configured(index: int, kind: int = 1, start: int = 0, mapping: tuple[int, ...] | None = None) -> ObjectDictionary:
    """A dictionary with one PDO set up; index: of its communication parameters."""
    od = dictionary()
    od.set(key_of(index, 1), 0x185 if index >= 0x1800 else 0x205)
    od.set(key_of(index, 2), kind)
    if index >= 0x1800:
        od.set(key_of(index, 6), start)
    if mapping is not None:
        for sub, entry in enumerate(mapping, 1):
            od.set(key_of(index + 0x200, sub), entry)
        od.set(key_of(index + 0x200, 0), len(mapping))
    return od


def sent_on(pdo: TransmitPdo, counters: list[int]) -> list[int]:
    """Which of these SYNCs send the PDO, by their place."""
    return [at for at, counter in enumerate(counters) if pdo.on_sync(counter)]


def counted(first: int, count: int, overflow: int = 240) -> list[int]:
    """SYNC counters from `first` on."""
    return [(first - 1 + at) % overflow + 1 for at in range(count)]


# --- transmit ----------------------------------------------------------------------------------------------------


def test_default_pdos_are_those_of_the_bus_plan() -> None:
    """Design, bus plan: TPDO1 every SYNC, TPDO2 every tenth from the node id on, RPDO1; the rest does not exist."""
    od = dictionary()
    tpdos = [TransmitPdo(od, number) for number in range(4)]
    assert [(pdo.active, pdo.cob_id, pdo.every, pdo.start) for pdo in tpdos[:2]] == [
        (True, 0x185, 1, 0),
        (True, 0x285, 10, 5),
    ]
    assert not any(pdo.active for pdo in tpdos[2:])
    rpdos = [ReceivePdo(od, number) for number in range(4)]
    assert (rpdos[0].active, rpdos[0].cob_id, rpdos[0].synchronous) == (True, 0x205, True)
    assert not any(pdo.active for pdo in rpdos[1:])


@pytest.mark.parametrize("with_counter", [True, False])
def test_every_transmission_type_sends_on_each_nth_sync(with_counter: bool) -> None:
    """CiA 301, 18xx:2, types 1..240: on every n-th SYNC, with and without a counter."""
    for every in range(1, 241):
        pdo = TransmitPdo(configured(0x1800, every), 0)
        counters = counted(1, 3 * every) if with_counter else [0] * (3 * every)
        assert sent_on(pdo, counters) == [every - 1, 2 * every - 1, 3 * every - 1]


@pytest.mark.parametrize("every", [1, 2, 3, 10, 239, 240])
@pytest.mark.parametrize("start", [1, 2, 6, 239, 240])
@pytest.mark.parametrize("first", [1, 2, 5, 6, 7, 240])
def test_start_value_sets_the_sync_that_is_sent_first(every: int, start: int, first: int) -> None:
    """CiA 301, 18xx:6: counting begins with the SYNC that carries this counter, whichever SYNC is seen first."""
    pdo = TransmitPdo(configured(0x1800, every, start), 0)
    begin = (start - first) % 240
    length = begin + 2 * every + 1
    assert sent_on(pdo, counted(first, length)) == [begin, begin + every, begin + 2 * every]


def test_start_value_beyond_the_overflow_never_comes() -> None:
    """CiA 301, object 1019: the counter runs up to the overflow value only."""
    pdo = TransmitPdo(configured(0x1800, 1, 11), 0)
    assert sent_on(pdo, counted(1, 100, overflow=10)) == []


@pytest.mark.parametrize("every", [1, 2, 10])
def test_start_value_is_ignored_without_a_counter(every: int) -> None:
    """CiA 301, 18xx:6: as with start value 0, on every n-th SYNC."""
    pdo = TransmitPdo(configured(0x1800, every, 5), 0)
    assert sent_on(pdo, [0] * (2 * every)) == [every - 1, 2 * every - 1]


def test_six_nodes_with_their_id_as_start_value_never_share_a_sync() -> None:
    """Design: TPDO2 is staggered by 1801:6 = node id."""
    pdos = [TransmitPdo(PATTERN.copy_for_node(node_id, {0x607600: 54900}), 1) for node_id in range(1, 7)]
    for counter in counted(1, 480):
        assert sum(pdo.on_sync(counter) for pdo in pdos) <= 1


@pytest.mark.parametrize(("start", "expected"), [(0, [9]), (5, [4, 14])])
def test_counting_starts_anew_with_operational(start: int, expected: list[int]) -> None:
    """`restart`: what was counted before does not matter."""
    pdo = TransmitPdo(configured(0x1800, 10, start), 0)
    sent_on(pdo, counted(1, 7))
    pdo.restart()
    assert sent_on(pdo, counted(1, 15)) == expected


@pytest.mark.parametrize(
    ("cob_id", "kind", "mapping"),
    [
        (INVALID | 0x185, 1, (POSITION,)),
        (INVALID | 0x40000185, 1, (POSITION,)),
        (0x185, 1, ()),
        (0x185, 0, (POSITION,)),
        (0x185, 255, (POSITION,)),
    ],
)
def test_tpdo_that_does_not_exist_or_is_empty_is_not_active(cob_id: int, kind: int, mapping: tuple[int, ...]) -> None:
    """CiA 301, 18xx:1 bit 31; device rules: an enabled PDO with 0 entries is legal and sends nothing."""
    od = configured(0x1802, kind, 0, mapping)
    od.set(key_of(0x1802, 1), cob_id)
    assert not TransmitPdo(od, 2).active


def test_bit_30_does_not_keep_a_tpdo_from_being_sent() -> None:
    """CiA 301, 18xx:1 bit 30: no remote frames allowed; the PDO exists."""
    od = configured(0x1800, 1)
    od.set(key_of(0x1800, 1), 0x40000000 | 0x185)
    pdo = TransmitPdo(od, 0)
    assert (pdo.active, pdo.cob_id) == (True, 0x185)


@given(
    status=st.integers(0, 0xFFFF),
    position=st.integers(-(2**31), 2**31 - 1),
    torque=st.integers(-32768, 32767),
    register=st.integers(0, 255),
)
def test_tpdo_carries_the_present_values_in_mapping_order(
    status: int, position: int, torque: int, register: int
) -> None:
    """CiA 301, 7.4.7: little endian, the first mapped object first; one object may be mapped alone."""
    od = configured(0x1800, 1, 0, (TORQUE, REGISTER, POSITION, REGISTER))
    for index, value in ((0x6041, status), (0x6064, position), (0x6077, torque), (0x1001, register)):
        od.set(key_of(index, 0), value)
    assert TransmitPdo(od, 0).frame(od.values).data == struct.pack("<hBiB", torque, register, position, register)
    od = configured(0x1800, 1, 0, (STATUSWORD,))
    od.set(key_of(0x6041, 0), status)
    frame = TransmitPdo(od, 0).frame(od.values)
    assert (frame.can_id, frame.data) == (0x185, struct.pack("<H", status))


# --- receive -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "synchronous"), [(0, True), (1, True), (240, True), (254, False), (255, False)])
def test_receive_type_tells_whether_sync_applies_the_value(kind: int, synchronous: bool) -> None:
    """CiA 301, 14xx:2: 0..240 with the next SYNC, 254 and 255 at once."""
    assert ReceivePdo(configured(0x1400, kind), 0).synchronous == synchronous


def test_nothing_is_applied_before_something_came() -> None:
    """`apply` says whether there was anything."""
    od = configured(0x1400)
    assert not ReceivePdo(od, 0).apply(od)


@pytest.mark.parametrize(("size", "code"), [(0, 0x8210), (1, 0x8210), (3, 0x8210), (4, 0), (5, 0x8220), (8, 0x8220)])
def test_length_is_checked(size: int, code: int) -> None:
    """CiA 301, table 26: too short is 8210 and not processed, too long is 8220 and processed."""
    od = configured(0x1400)
    pdo = ReceivePdo(od, 0)
    assert pdo.received(0, bytes((1, 2, 3, 4, 5, 6, 7, 8))[:size]) == code
    assert pdo.apply(od) == (code != 0x8210)
    applied = (0, 0) if code == 0x8210 else (0x0201, 0x0403)
    assert (od.value(0x604000), od.value(0x607100)) == applied


def test_value_is_applied_once() -> None:
    """What was applied does not pend any more."""
    od = configured(0x1400)
    pdo = ReceivePdo(od, 0)
    pdo.received(0, bytes(4))
    assert pdo.apply(od)
    assert not pdo.apply(od)


def test_last_value_before_sync_wins() -> None:
    """CiA 301, 7.2.2.2: the value received last is applied."""
    od = configured(0x1400)
    pdo = ReceivePdo(od, 0)
    pdo.received(0, struct.pack("<Hh", 6, 100))
    pdo.received(1, struct.pack("<Hh", 15, -200))
    assert pdo.apply(od)
    assert (od.value(0x604000), od.value(0x607100)) == (15, -200)


def test_short_pdo_does_not_take_the_place_of_a_good_one() -> None:
    """8210: not processed, so the value before it stays the last one."""
    od = configured(0x1400)
    pdo = ReceivePdo(od, 0)
    pdo.received(0, struct.pack("<Hh", 15, 100))
    pdo.received(1, b"\0")
    assert pdo.apply(od)
    assert od.value(0x607100) == 100


@pytest.mark.parametrize(("mode", "applied"), [(0, 0), (10, 10), (11, 7), (127, 7), (-1, 7), (-128, 7)])
def test_value_out_of_its_limits_is_left_out(mode: int, applied: int) -> None:
    """As an SDO write of it would be refused; the other values of the PDO count."""
    od = configured(0x1400, 1, 0, (CONTROLWORD, MODE, TARGET_TORQUE))
    od.set(0x606000, 7)
    pdo = ReceivePdo(od, 0)
    pdo.received(0, struct.pack("<Hbh", 15, mode, -3))
    assert pdo.apply(od)
    assert (od.value(0x604000), od.value(0x606000), od.value(0x607100)) == (15, applied, -3)


def test_stopped_rpdo_forgets_what_pends() -> None:
    """Not operational: nothing pends, nothing is watched."""
    od = configured(0x1400)
    od.set(key_of(0x1400, 5), 20)
    pdo = ReceivePdo(od, 0)
    pdo.received(0, bytes(4))
    pdo.stop()
    assert (pdo.apply(od), pdo.deadline) == (False, NEVER)


@pytest.mark.parametrize(("cob_id", "mapping"), [(INVALID | 0x205, (CONTROLWORD,)), (0x205, ())])
def test_rpdo_that_does_not_exist_or_is_empty_is_not_active(cob_id: int, mapping: tuple[int, ...]) -> None:
    """CiA 301, 14xx:1 bit 31; device rules: 0 entries are legal."""
    od = configured(0x1401, 1, 0, mapping)
    od.set(key_of(0x1401, 1), cob_id)
    assert not ReceivePdo(od, 1).active


# --- the deadline of an RPDO -------------------------------------------------------------------------------------


def woken_through(pdo: ReceivePdo, until: int) -> list[int]:
    """Wake the PDO whenever it asks for it; the times at which it reported its silence."""
    late = []
    while pdo.deadline <= until:
        now = pdo.deadline
        if pdo.wake(now):
            late.append(now)
        assert pdo.deadline > now
    return late


@given(gaps=st.lists(st.integers(1, 60 * MS), min_size=1, max_size=30))
def test_deadline_passes_exactly_after_the_silence(gaps: list[int]) -> None:
    """CiA 301, 14xx:5: every gap longer than the event timer is one timeout, at its end to the nanosecond."""
    od = configured(0x1400)
    od.set(key_of(0x1400, 5), 20)
    pdo = ReceivePdo(od, 0)
    now, found, expected = 0, [], []
    pdo.received(0, bytes(4))
    for gap in gaps:
        if gap > 20 * MS:
            expected.append(now + 20 * MS)
        now += gap
        found += woken_through(pdo, now - 1)
        pdo.received(now, bytes(4))
    assert found == expected


def test_deadline_starts_with_the_first_reception() -> None:
    """CiA 301, 14xx:5: not before the PDO was received once."""
    od = configured(0x1400)
    od.set(key_of(0x1400, 5), 20)
    assert ReceivePdo(od, 0).deadline == NEVER


@pytest.mark.parametrize("size", [0, 3])
def test_short_pdo_does_not_feed_the_deadline(size: int) -> None:
    """It is not processed, so the command is as old as before."""
    od = configured(0x1400)
    od.set(key_of(0x1400, 5), 20)
    pdo = ReceivePdo(od, 0)
    pdo.received(0, bytes(4))
    pdo.received(19 * MS, bytes(size))
    assert woken_through(pdo, 100 * MS) == [20 * MS]


def test_without_an_event_timer_nothing_is_watched() -> None:
    """CiA 301, 14xx:5 = 0."""
    pdo = ReceivePdo(configured(0x1400), 0)
    pdo.received(0, bytes(4))
    assert pdo.deadline == NEVER


# --- mapping -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("index", "mapping", "abort"),
    [
        (0x1A00, (), 0),
        (0x1A00, (POSITION,), 0),
        (0x1A00, (POSITION, VELOCITY), 0),
        (0x1A00, (REGISTER,) * 8, 0),
        (0x1A00, (POSITION, VELOCITY, REGISTER), TOO_LONG),
        (0x1A00, (POSITION,) * 3, TOO_LONG),
        (0x1A00, (0x60640010,), NOT_MAPPABLE),  # half of the position
        (0x1A00, (0x60640120,), NOT_MAPPABLE),  # no such sub-index
        (0x1A00, (0x50000020,), NOT_MAPPABLE),  # no such object
        (0x1A00, (0x00000000,), NOT_MAPPABLE),
        (0x1A00, (0x10080000,), NOT_MAPPABLE),  # a string
        (0x1A00, (0x10180120,), NOT_MAPPABLE),  # not mappable at all
        (0x1A00, (POSITION, CONTROLWORD), NOT_MAPPABLE),  # receive only
        (0x1600, (CONTROLWORD, TARGET_TORQUE, MAX_TORQUE, MODE, MODE), 0),
        (0x1600, (CONTROLWORD,) * 5, TOO_LONG),
        (0x1600, (CONTROLWORD, STATUSWORD), NOT_MAPPABLE),  # transmit only
        (0x1600, (0x10170010,), NOT_MAPPABLE),
    ],
)
def test_mapping_is_checked(index: int, mapping: tuple[int, ...], abort: int) -> None:
    """CiA 301, table 22: 06040041 not mappable, 06040042 longer than 8 bytes; the length must be the object's."""
    od = dictionary()
    for sub, entry in enumerate(mapping, 1):
        od.set(key_of(index, sub), entry)
    assert mapping_abort(od, index, len(mapping)) == abort


def test_only_the_entries_counted_are_checked() -> None:
    """What stands beyond :0 does not matter."""
    od = dictionary()
    od.set(key_of(0x1A00, 3), 0xFFFFFFFF)
    assert mapping_abort(od, 0x1A00, 2) == 0
    assert mapping_abort(od, 0x1A00, 3) == NOT_MAPPABLE


@pytest.mark.parametrize("index", [0x1400, 0x1800])
def test_mapping_an_object_that_is_not_there_is_a_programming_error(index: int) -> None:
    """The device checks before it takes a mapping; the message names the entry and the object."""
    od = configured(index, 1, 0, (0x50010210,))
    with pytest.raises(CanopenExoError, match=rf"{index + 0x200:04X}:1: object 5001:2 is not in the object dictionary"):
        TransmitPdo(od, 0) if index >= 0x1800 else ReceivePdo(od, 0)
