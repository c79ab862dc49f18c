"""Object dictionary: CiA 301, 7.4 (objects), table 22 (abort codes), 7.3.2 (what a reset restores)."""

import copy

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.errors import CanopenExoError
from canopen_exo.od import (
    ABORT_DEVICE_STATE,
    ABORT_NO_DATA,
    ABORT_NO_OBJECT,
    ABORT_NO_SUB_INDEX,
    ABORT_READ_ONLY,
    ABORT_TOO_LONG,
    ABORT_TOO_SHORT,
    ABORT_VALUE,
    ABORT_VALUE_HIGH,
    ABORT_VALUE_LOW,
    ABORT_WRITE_ONLY,
    BITS,
    DOMAIN,
    SIGNED,
    VISIBLE_STRING,
    Entry,
    ObjectDictionary,
    WriteObserver,
)

PLAIN, LIMITED, TEXT, COB_ID, RATED = 0x200000, 0x200100, 0x100800, 0x140001, 0x607600
INDICES = [0x1003, 0x1008, 0x1400, 0x2000, 0x2001, 0x2003, 0x2004, 0x2005, 0x6071]


def entries() -> list[Entry]:
    return [
        Entry(0x1003, 0, "number of errors", 0x05, "rw", high=8, plain=False),
        Entry(0x1003, 1, "error field 1", 0x07, "ro", plain=False),
        Entry(0x1003, 2, "error field 2", 0x07, "ro", plain=False),
        Entry(0x1008, 0, "device name", VISIBLE_STRING, "const", text=b"joint"),
        Entry(0x1400, 0, "highest sub-index", 0x05, "const", default=2, plain=False),
        Entry(0x1400, 1, "COB-ID", 0x07, "rw", default=0x80000200, relative=True, plain=False),
        Entry(0x2000, 0, "plain", 0x06, "rw", default=0x1234),
        Entry(0x2001, 0, "limited", 0x03, "rw", default=-2, low=-5, high=7),
        Entry(0x2003, 0, "secret", 0x05, "wo"),
        Entry(0x2004, 0, "file", DOMAIN, "rw"),
        Entry(0x2005, 0, "switch", 0x01, "rw"),
        Entry(0x6071, 0, "target torque", 0x03, "rww", pdo=True),
        Entry(0x6076, 0, "rated torque", 0x07, "ro", has_default=False),
    ]


def dictionary() -> ObjectDictionary:
    return ObjectDictionary(entries()).copy_for_node(3, {RATED: 72900})


class Recorder(WriteObserver):
    def __init__(self, abort: int) -> None:
        self.abort = abort
        self.checked: list[tuple[int, int]] = []
        self.wrote: list[tuple[int, int]] = []

    def check(self, key: int, raw: int) -> int:
        self.checked.append((key, raw))
        return self.abort

    def written(self, key: int, raw: int) -> None:
        self.wrote.append((key, raw))


@pytest.mark.parametrize(
    ("index", "sub", "abort"),
    [
        (0x2002, 0, ABORT_NO_OBJECT),
        (0x2002, 1, ABORT_NO_OBJECT),
        (0x0000, 0, ABORT_NO_OBJECT),
        (0xFFFF, 255, ABORT_NO_OBJECT),
        (0x2000, 1, ABORT_NO_SUB_INDEX),
        (0x2000, 255, ABORT_NO_SUB_INDEX),
        (0x1400, 2, ABORT_NO_SUB_INDEX),
        (0x2000, 0, 0),
        (0x1400, 1, 0),
    ],
)
@pytest.mark.parametrize("writing", [False, True])
def test_missing_object_and_missing_sub_index_have_their_own_aborts(
    index: int, sub: int, abort: int, writing: bool
) -> None:
    """Table 22: 06020000 no object; 06090011 no sub-index, also for a sub-index other than 0 on a plain variable."""
    assert dictionary().check_access(index, sub, writing) == abort


@pytest.mark.parametrize(
    ("index", "reading", "writing"),
    [
        (0x1008, 0, ABORT_READ_ONLY),  # const
        (0x6076, 0, ABORT_READ_ONLY),  # ro
        (0x2003, ABORT_WRITE_ONLY, 0),  # wo
        (0x2000, 0, 0),  # rw
        (0x6071, 0, 0),  # rww
    ],
)
def test_access_type_decides_who_may_read_and_write(index: int, reading: int, writing: int) -> None:
    """Table 22: 06010001 reading a write-only object, 06010002 writing a read-only one."""
    od = dictionary()
    assert od.check_access(index, 0, False) == reading
    assert od.check_access(index, 0, True) == writing


@pytest.mark.parametrize(
    ("access", "rpdo", "tpdo"),
    [
        ("ro", False, True),
        ("const", False, True),
        ("rw", True, True),
        ("wo", True, False),
        ("rww", True, False),
        ("rwr", False, True),
    ],
)
def test_access_type_decides_the_pdo_direction(access: str, rpdo: bool, tpdo: bool) -> None:
    """CiA 306: rww may be written by a PDO, rwr may be read by one."""
    entry = Entry(0x2000, 0, "x", 0x05, access, pdo=True)
    assert (entry.rpdo_mappable, entry.tpdo_mappable) == (rpdo, tpdo)
    off = Entry(0x2000, 0, "x", 0x05, access)
    assert not off.rpdo_mappable
    assert not off.tpdo_mappable


@pytest.mark.parametrize(
    ("size", "abort"),
    [(0, ABORT_TOO_SHORT), (1, ABORT_TOO_SHORT), (2, 0), (3, ABORT_TOO_LONG), (4, ABORT_TOO_LONG), (9, ABORT_TOO_LONG)],
)
def test_write_of_the_wrong_length_is_refused(size: int, abort: int) -> None:
    """Table 22: 06070012 too long, 06070013 too short."""
    od = dictionary()
    assert od.write(0x2000, 0, bytes(size)) == abort
    assert od.value(PLAIN) == (0x1234 if abort else 0)


@pytest.mark.parametrize(
    ("raw", "abort"),
    [
        (-32768, ABORT_VALUE_LOW),
        (-6, ABORT_VALUE_LOW),
        (-5, 0),
        (0, 0),
        (7, 0),
        (8, ABORT_VALUE_HIGH),
        (32767, ABORT_VALUE_HIGH),
    ],
)
def test_write_outside_the_limits_is_refused(raw: int, abort: int) -> None:
    """Table 22: 06090031 too high, 06090032 too low; the limits themselves are allowed."""
    od = dictionary()
    assert od.write(0x2001, 0, raw.to_bytes(2, "little", signed=True)) == abort
    assert od.value(LIMITED) == (-2 if abort else raw)


@pytest.mark.parametrize(("raw", "abort"), [(0, 0), (1, 0), (2, ABORT_VALUE_HIGH), (255, ABORT_VALUE_HIGH)])
def test_boolean_takes_one_byte_with_0_or_1(raw: int, abort: int) -> None:
    """CiA 301, table 44: BOOLEAN is one bit."""
    assert dictionary().write(0x2005, 0, bytes((raw,))) == abort


@pytest.mark.parametrize(("raw", "kept"), [(-100, -5), (-6, -5), (-5, -5), (7, 7), (8, 7), (100, 7)])
def test_the_device_itself_writes_clipped(raw: int, kept: int) -> None:
    """Raw values that do not fit saturate; nothing wraps."""
    od = dictionary()
    od.set(LIMITED, raw)
    assert od.value(LIMITED) == kept


def test_the_device_itself_may_write_read_only_objects() -> None:
    """`set` has no access check and does not call the observer."""
    od = dictionary()
    od.observer = Recorder(ABORT_DEVICE_STATE)
    od.set(0x100301, 0x8130)
    assert od.value(0x100301) == 0x8130


def test_observer_may_refuse_a_write() -> None:
    """A veto keeps the old value, its code is the abort, and `written` is not called."""
    od = dictionary()
    observer = Recorder(ABORT_DEVICE_STATE)
    od.observer = observer
    assert od.write(0x2000, 0, b"\x01\x00") == ABORT_DEVICE_STATE
    assert od.value(PLAIN) == 0x1234
    assert observer.wrote == []


def test_observer_is_told_after_the_value_is_stored() -> None:
    """Type, access and limits are checked first; then check, store, written."""
    od = dictionary()
    seen: list[int] = []

    class Reader(WriteObserver):
        def check(self, key: int, raw: int) -> int:
            seen.append(od.value(key))
            return 0

        def written(self, key: int, raw: int) -> None:
            seen.append(od.value(key))

    od.observer = Reader()
    assert od.write(0x2001, 0, b"\x03\x00") == 0
    assert od.write(0x2001, 0, b"\x08\x00") == ABORT_VALUE_HIGH
    assert seen == [-2, 3]


@pytest.mark.parametrize(("count", "readable"), [(0, 0), (1, 1), (2, 2)])
def test_error_history_above_its_count_cannot_be_read(count: int, readable: int) -> None:
    """CiA 301, object 1003: 08000024 for entries that hold no error."""
    od = dictionary()
    od.set(0x100300, count)
    for sub in (1, 2):
        assert od.check_access(0x1003, sub, False) == (0 if sub <= readable else ABORT_NO_DATA)


@pytest.mark.parametrize(("raw", "abort"), [(0, 0), (1, ABORT_VALUE), (8, ABORT_VALUE), (255, ABORT_VALUE)])
def test_error_history_can_only_be_cleared(raw: int, abort: int) -> None:
    """CiA 301, object 1003: writing anything but 0 to :0 is refused with 06090030."""
    od = dictionary()
    od.set(0x100300, 2)
    assert od.write(0x1003, 0, bytes((raw,))) == abort
    assert od.value(0x100300) == (2 if abort else 0)


def test_node_id_is_resolved_for_each_unit() -> None:
    """CiA 306: $NODEID in a default is the unit's node id."""
    pattern = ObjectDictionary(entries())
    left, right = pattern.copy_for_node(1, {RATED: 1}), pattern.copy_for_node(127, {RATED: 2})
    assert (left.value(COB_ID), right.value(COB_ID)) == (0x80000201, 0x8000027F)
    left.set(PLAIN, 9)
    assert right.value(PLAIN) == pattern.value(PLAIN) == 0x1234
    left.reset()
    assert (left.value(COB_ID), left.value(RATED)) == (0x80000201, 1)


@pytest.mark.parametrize("node_id", [-1, 0, 128, 255])
def test_node_id_outside_1_to_127_is_refused(node_id: int) -> None:
    """CiA 301: node ids are 1..127."""
    with pytest.raises(CanopenExoError, match=rf"node id {node_id} given, allowed 1\.\.127"):
        ObjectDictionary(entries()).copy_for_node(node_id, {RATED: 1})


def test_a_property_of_the_unit_must_be_given() -> None:
    """An object without a default has no neutral value."""
    with pytest.raises(CanopenExoError, match=r"6076:00 .rated torque.: no value given for node 3"):
        ObjectDictionary(entries()).copy_for_node(3)


@pytest.mark.parametrize("unit", [{RATED: 1, 0x999900: 1}, {RATED: 1, TEXT: 1}, {RATED: 1, LIMITED: 8}, {RATED: -1}])
def test_a_wrong_property_of_the_unit_is_refused(unit: dict[int, int]) -> None:
    """Programming errors raise."""
    with pytest.raises(CanopenExoError, match="object"):
        ObjectDictionary(entries()).copy_for_node(3, unit)


def test_reset_node_restores_everything() -> None:
    """CiA 301, 7.3.2: reset application and communication; the unit's own values are its defaults."""
    od = dictionary()
    for key in (PLAIN, LIMITED, COB_ID, RATED):
        od.set(key, 1)
    od.reset()
    assert [od.value(key) for key in (PLAIN, LIMITED, COB_ID, RATED)] == [0x1234, -2, 0x80000203, 72900]


def test_reset_communication_restores_1000_to_1fff_only() -> None:
    """CiA 301, 7.3.2: reset communication restores the communication profile area."""
    od = dictionary()
    od.set(PLAIN, 1)
    od.set(COB_ID, 1)
    od.reset(communication_only=True)
    assert (od.value(PLAIN), od.value(COB_ID)) == (1, 0x80000203)


def test_strings_and_domains_are_bytes_of_any_length() -> None:
    """CiA 301, table 44: VISIBLE_STRING and DOMAIN have no fixed length."""
    od = dictionary()
    assert od.read(0x1008, 0) == b"joint"
    assert od.read(0x2004, 0) == b""
    assert od.write(0x2004, 0, b"x" * 300) == 0
    assert od.read(0x2004, 0) == b"x" * 300
    od.reset()
    assert od.read(0x2004, 0) == b""


def test_unknown_key_raises_with_its_index() -> None:
    """Programming errors raise and say what was asked for."""
    od = dictionary()
    with pytest.raises(CanopenExoError, match="object 6064:00: not in the object dictionary"):
        od.value(0x606400)
    with pytest.raises(CanopenExoError, match="object 6064:00"):
        od.set(0x606400, 1)
    with pytest.raises(CanopenExoError, match="object 1008:00"):
        od.set(TEXT, 1)
    with pytest.raises(CanopenExoError, match="2003:00: not readable, SDO abort 06010001"):
        od.read(0x2003, 0)


def test_an_entry_that_contradicts_itself_is_refused() -> None:
    """A default or a limit outside the range is a mistake in the EDS."""
    with pytest.raises(CanopenExoError, match=r"default 9 given, allowed 0\.\.8"):
        Entry(0x2000, 0, "x", 0x05, "rw", default=9, high=8)
    with pytest.raises(CanopenExoError, match=r"limits 0\.\.256 given"):
        Entry(0x2000, 0, "x", 0x05, "rw", high=256)
    with pytest.raises(CanopenExoError, match="data type 0x0008 given"):
        Entry(0x2000, 0, "x", 0x08, "rw")
    with pytest.raises(CanopenExoError, match="access 'rx' given, allowed ro, rw"):
        Entry(0x2000, 0, "x", 0x05, "rx")
    with pytest.raises(CanopenExoError, match="2000:00: given twice"):
        ObjectDictionary([Entry(0x2000, 0, "x", 0x05, "rw"), Entry(0x2000, 0, "y", 0x05, "rw")])


def test_a_deep_copy_lives_on_alone() -> None:
    """Snapshots: values are copied, entries shared, and an observer that holds the dictionary holds the copy."""

    class Owner(WriteObserver):
        def __init__(self, od: ObjectDictionary) -> None:
            self.od = od

        def __deepcopy__(self, memo: dict[int, object]) -> "Owner":
            return Owner(copy.deepcopy(self.od, memo))

    od = dictionary()
    owner = Owner(od)
    od.observer = owner
    twin = copy.deepcopy(od)
    od.set(PLAIN, 1)
    assert twin.value(PLAIN) == 0x1234
    assert twin.entries is od.entries
    assert isinstance(twin.observer, Owner)
    assert twin.observer.od is twin
    twin.reset()
    assert twin.value(COB_ID) == 0x80000203


@given(st.data())
def test_every_integer_of_every_type_survives_write_and_read(data: st.DataObject) -> None:
    """CiA 301, 7.1.4: little endian, two's complement; the bytes read are the bytes written."""
    code = data.draw(st.sampled_from(sorted(BITS)))
    bits = BITS[code]
    signed = code in SIGNED
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    raw = data.draw(st.integers(low, high) | st.sampled_from([low, high]))
    od = ObjectDictionary([Entry(0x2000, 0, "x", code, "rw")]).copy_for_node(1)
    wire = (raw % (1 << bits)).to_bytes((bits + 7) // 8, "little")
    assert od.write(0x2000, 0, wire) == 0
    assert od.value(PLAIN) == raw
    assert od.read(0x2000, 0) == wire


@given(st.integers(0, 0xFFFF) | st.sampled_from(INDICES), st.integers(0, 3), st.binary(max_size=5))
def test_no_write_from_the_bus_raises(index: int, sub: int, data: bytes) -> None:
    """Bad bytes from the wire are data: an abort code, or stored as they are."""
    od = dictionary()
    if od.write(index, sub, data) == 0 and od.check_access(index, sub, False) == 0:
        assert od.read(index, sub) == data
