"""SDO server and client: CiA 301, 7.2.4.3."""

import copy
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canopen_exo.bus.node import MS, NEVER, SECOND
from canopen_exo.errors import CanopenExoError
from canopen_exo.od import (
    ABORT_DEVICE_STATE,
    ABORT_NO_OBJECT,
    ABORT_NO_SUB_INDEX,
    ABORT_READ_ONLY,
    ABORT_TOO_LONG,
    ABORT_TOO_SHORT,
    ABORT_VALUE_HIGH,
    ABORT_WRITE_ONLY,
    DOMAIN,
    VISIBLE_STRING,
    Entry,
    ObjectDictionary,
    WriteObserver,
)
from canopen_exo.sdo import (
    ABORT_COMMAND,
    ABORT_MEMORY,
    ABORT_TIMEOUT,
    ABORT_TOGGLE,
    LARGEST,
    SdoClient,
    SdoServer,
    abort_text,
)

NAME = b"exo-hil joint controller"  # 24 bytes: 7 + 7 + 7 + 3
UPLOAD_NAME = b"\x40\x08\x10\x00\0\0\0\0"
NEXT = (b"\x60" + bytes(7), b"\x70" + bytes(7))


def dictionary() -> ObjectDictionary:
    return ObjectDictionary(
        [
            Entry(0x1008, 0, "name", VISIBLE_STRING, "const", text=NAME),
            Entry(0x1009, 0, "empty", VISIBLE_STRING, "const"),
            Entry(0x100A, 0, "seven", VISIBLE_STRING, "const", text=b"1234567"),
            Entry(0x1018, 0, "count", 0x05, "const", default=4, plain=False),
            Entry(0x2000, 0, "u8", 0x05, "rw", default=0x11, high=0x7F),
            Entry(0x2001, 0, "u16", 0x06, "rw", default=0x2211),
            Entry(0x2002, 0, "u24", 0x16, "rw", default=0x332211),
            Entry(0x2003, 0, "u32", 0x07, "rw", default=0x44332211),
            Entry(0x2004, 0, "u64", 0x1B, "rw", default=0x8877665544332211),
            Entry(0x2005, 0, "file", DOMAIN, "rw"),
            Entry(0x2006, 0, "secret", 0x05, "wo"),
        ]
    ).copy_for_node(5)


def make_server() -> SdoServer:
    return SdoServer(dictionary(), 5)


def abort(index: int, sub: int, code: int) -> bytes:
    return struct.pack("<BHBI", 0x80, index, sub, code)


def transfer(client: SdoClient, server: SdoServer, first: bytes) -> list[bytes]:
    """Run a transfer to its end; every payload on the wire, requests and answers."""
    wire: list[bytes] = []
    request: bytes | None = first
    while request is not None:
        wire.append(request)
        answer = server.request(0, request)
        if answer is None:
            break
        wire.append(answer)
        request = client.answer(0, answer)
    return wire


@pytest.mark.parametrize(
    ("index", "answer"),
    [
        (0x2000, "4f00200011000000"),
        (0x2001, "4b01200011220000"),
        (0x2002, "4702200011223300"),
        (0x2003, "4303200011223344"),
        (0x2004, "4104200008000000"),
        (0x1008, "4108100018000000"),
        (0x1009, "4109100000000000"),
    ],
)
def test_upload_is_expedited_up_to_four_bytes(index: int, answer: str) -> None:
    """CiA 301, SDO upload initiate: e and s set with n unused bytes up to 4 bytes; else the size in bytes."""
    assert make_server().request(0, struct.pack("<BHB4x", 0x40, index, 0)) == bytes.fromhex(answer)


def test_segmented_upload_sends_seven_bytes_at_a_time_and_alternates_the_toggle() -> None:
    """CiA 301, SDO upload segment: t as requested, n unused bytes, c with the last one."""
    server = make_server()
    server.request(0, UPLOAD_NAME)
    answers = [server.request(0, NEXT[k % 2]) for k in range(4)]
    assert answers == [
        b"\x00" + NAME[:7],
        b"\x10" + NAME[7:14],
        b"\x00" + NAME[14:21],
        b"\x19" + NAME[21:] + bytes(4),
    ]
    assert server.request(0, NEXT[0]) == abort(0, 0, ABORT_COMMAND)


def test_empty_and_exactly_full_segments() -> None:
    """n counts the unused bytes: 7 for an empty value, 0 for a full last segment."""
    server = make_server()
    server.request(0, b"\x40\x09\x10\x00\0\0\0\0")
    assert server.request(0, NEXT[0]) == b"\x0f" + bytes(7)
    server.request(0, b"\x40\x0a\x10\x00\0\0\0\0")
    assert server.request(0, NEXT[0]) == b"\x011234567"


@pytest.mark.parametrize(
    ("request_hex", "abort_code", "stored"),
    [
        ("2f00200042000000", 0, 0x42),  # e, s, 1 byte
        ("2200200042ffffff", 0, 0x42),  # e without s: the object tells the size
        ("2b00200042000000", ABORT_TOO_LONG, 0x11),
        ("2300200042000000", ABORT_TOO_LONG, 0x11),
        ("2f00200080000000", ABORT_VALUE_HIGH, 0x11),
    ],
)
def test_expedited_download_with_and_without_size(request_hex: str, abort_code: int, stored: int) -> None:
    """CiA 301, SDO download initiate: e, s and n; the length must be the object's."""
    server = make_server()
    answer = abort(0x2000, 0, abort_code) if abort_code else bytes.fromhex("6000200000000000")
    assert server.request(0, bytes.fromhex(request_hex)) == answer
    assert server._od.value(0x200000) == stored


@pytest.mark.parametrize(
    ("request_hex", "code"),
    [
        ("4000600000000000", ABORT_NO_OBJECT),
        ("4018100500000000", ABORT_NO_SUB_INDEX),
        ("4000200100000000", ABORT_NO_SUB_INDEX),
        ("4006200000000000", ABORT_WRITE_ONLY),
        ("2f18100001000000", ABORT_READ_ONLY),
        ("2108100018000000", ABORT_READ_ONLY),  # segmented: refused before the data
        ("2f00600001000000", ABORT_NO_OBJECT),
        ("2f01200001000000", ABORT_TOO_SHORT),
        ("2204200001020304", ABORT_TOO_SHORT),  # 8-byte object, expedited
        ("2104200007000000", ABORT_TOO_SHORT),
        ("2104200009000000", ABORT_TOO_LONG),
        ("2105200001000100", ABORT_MEMORY),  # 65537 bytes
        ("a008100014000000", ABORT_COMMAND),  # block upload
        ("c605200020000000", ABORT_COMMAND),  # block download
        ("e008100000000000", ABORT_COMMAND),
    ],
)
def test_refusals_name_the_object_and_the_reason(request_hex: str, code: int) -> None:
    """CiA 301, table 22; block transfer is not served."""
    request = bytes.fromhex(request_hex)
    answer = make_server().request(0, request)
    if request[0] == 0xE0:
        assert answer == abort(0, 0, code)  # an unknown command has no known layout
    else:
        assert answer == abort(request[1] | request[2] << 8, request[3], code)


@pytest.mark.parametrize("size", [0, 1, 2, 3, 4, 7, 9, 64])
def test_a_request_of_other_than_eight_bytes_is_aborted(size: int) -> None:
    """Any DLC but 8: abort 05040001, never silence."""
    answer = make_server().request(0, UPLOAD_NAME.ljust(64, b"\0")[:size])
    assert answer == (abort(0x1008, 0, ABORT_COMMAND) if size >= 4 else abort(0, 0, ABORT_COMMAND))


@pytest.mark.parametrize("segment", [b"\x00" + bytes(7), b"\x70" + bytes(7), b"\x60" + bytes(7)])
def test_a_segment_without_a_transfer_is_aborted(segment: bytes) -> None:
    """Command specifier not valid in this state."""
    assert make_server().request(0, segment) == abort(0, 0, ABORT_COMMAND)


def test_wrong_toggle_ends_an_upload() -> None:
    """05030000: toggle bit not alternated."""
    server = make_server()
    server.request(0, UPLOAD_NAME)
    server.request(0, NEXT[0])
    assert server.request(0, NEXT[0]) == abort(0x1008, 0, ABORT_TOGGLE)
    assert server.request(0, NEXT[1]) == abort(0, 0, ABORT_COMMAND)
    assert server.deadline == NEVER


def test_wrong_toggle_ends_a_download() -> None:
    """05030000, and nothing is stored."""
    server = make_server()
    server.request(0, bytes.fromhex("2104200008000000"))
    assert server.request(0, b"\x1012345678"[:8]) == abort(0x2004, 0, ABORT_TOGGLE)
    assert server._od.value(0x200400) == 0x8877665544332211


@pytest.mark.parametrize(
    "second", [UPLOAD_NAME, bytes.fromhex("2f00200042000000"), b"\x00" + bytes(7), b"\xa0\x08\x10\0\0\0\0\0", b"\x40"]
)
def test_one_transfer_at_a_time(second: bytes) -> None:
    """Anything but the next segment ends the running transfer with an abort; the server is free again."""
    server = make_server()
    server.request(0, UPLOAD_NAME)
    assert server.request(0, second) == abort(0x1008, 0, ABORT_COMMAND)
    assert server.request(0, UPLOAD_NAME) == bytes.fromhex("4108100018000000")


def test_a_clients_abort_ends_the_transfer_without_an_answer() -> None:
    """CiA 301, SDO abort transfer: not confirmed."""
    server = make_server()
    server.request(0, UPLOAD_NAME)
    assert server.request(0, abort(0x1008, 0, ABORT_TIMEOUT)) is None
    assert server.deadline == NEVER
    assert server.request(0, NEXT[0]) == abort(0, 0, ABORT_COMMAND)


@pytest.mark.parametrize(("announced", "sent", "code"), [(8, 7, ABORT_TOO_SHORT), (8, 9, ABORT_TOO_LONG)])
def test_announced_size_must_be_kept(announced: int, sent: int, code: int) -> None:
    """A segmented download with less or more than its size is refused, and nothing is stored."""
    server = make_server()
    server.request(0, struct.pack("<BHBI", 0x21, 0x2004, 0, announced))
    answer = server.request(0, b"\x01" + bytes(7)) if sent == 7 else server.request(0, bytes(8))
    if sent == 9:
        answer = server.request(0, b"\x1b" + bytes(7))  # toggle, 5 unused, last
    assert answer == abort(0x2004, 0, code)
    assert server._od.value(0x200400) == 0x8877665544332211


@pytest.mark.parametrize("size", [0, 1, 6, 7, 8, 13, 14, 15, 100])
@pytest.mark.parametrize("announced", [True, False])
def test_segmented_download_of_any_length(size: int, announced: bool) -> None:
    """CiA 301, SDO download segment: with the size (s = 1) and without."""
    server, data = make_server(), bytes(range(100))[:size]
    first = struct.pack("<BHBI", 0x21 if announced else 0x20, 0x2005, 0, size if announced else 0)
    assert server.request(0, first) == bytes.fromhex("6005200000000000")
    parts = [data[at : at + 7] for at in range(0, size, 7)] or [b""]
    for k, part in enumerate(parts):
        command = (k & 1) << 4 | (7 - len(part)) << 1 | (k == len(parts) - 1)
        assert server.request(0, bytes((command,)) + part.ljust(7, b"\0")) == bytes((0x20 | (k & 1) << 4,)) + bytes(7)
    assert server._od.read(0x2005, 0) == data
    assert server.deadline == NEVER


def test_a_download_without_size_has_an_end() -> None:
    """Out of memory, 05040005, above the largest transfer."""
    server = make_server()
    server.request(0, bytes.fromhex("2005200000000000"))
    answers = [server.request(0, bytes(((k & 1) << 4,)) + bytes(7)) for k in range(LARGEST // 7 + 1)]
    assert answers[-2] == bytes((0x20 | ((LARGEST // 7 - 1) & 1) << 4,)) + bytes(7)
    assert answers[-1] == abort(0x2005, 0, ABORT_MEMORY)


def test_observer_veto_is_the_abort() -> None:
    """The device's own refusal reaches the client: 08000022 in an expedited and a segmented download."""

    class Locked(WriteObserver):
        def check(self, key: int, raw: int) -> int:
            return ABORT_DEVICE_STATE

    server = make_server()
    server._od.observer = Locked()
    assert server.request(0, bytes.fromhex("2f00200042000000")) == abort(0x2000, 0, ABORT_DEVICE_STATE)
    server.request(0, bytes.fromhex("2000200000000000"))
    assert server.request(0, b"\x0d\x42" + bytes(6)) == abort(0x2000, 0, ABORT_DEVICE_STATE)


def test_server_time_out_runs_from_the_last_segment() -> None:
    """05040000 at the deadline, not before; an idle or expedited server has none."""
    server = SdoServer(dictionary(), 5, SECOND)
    assert server.deadline == NEVER
    server.request(0, bytes.fromhex("4000200000000000"))
    assert server.deadline == NEVER
    server.request(5, UPLOAD_NAME)
    assert server.deadline == 5 + SECOND
    server.request(7, NEXT[0])
    assert server.deadline == 7 + SECOND
    assert server.expire(7 + SECOND - 1) is None
    assert server.expire(7 + SECOND) == abort(0x1008, 0, ABORT_TIMEOUT)
    assert server.deadline == NEVER
    assert server.expire(NEVER - 1) is None


@given(st.lists(st.binary(max_size=9) | st.binary(min_size=8, max_size=8), max_size=20))
def test_server_answers_eight_bytes_to_any_bytes(requests: list[bytes]) -> None:
    """Never silence but after an abort, never an exception, and free again at the end."""
    server = make_server()
    for request in requests:
        answer = server.request(0, request)
        if len(request) == 8 and request[0] >> 5 == 4:
            assert answer is None
        else:
            assert answer is not None
            assert len(answer) == 8
    server.expire(server.deadline)
    assert server.request(0, UPLOAD_NAME) == bytes.fromhex("4108100018000000")


def test_server_and_client_copies_go_on_alone() -> None:
    """Snapshots: a copy in the middle of a transfer ends it by itself."""
    server, client = make_server(), SdoClient(5)
    request = client.answer(0, server.request(0, client.upload(0, 0x1008, 0)) or b"")
    assert request is not None
    server2, client2 = copy.deepcopy((server, client))
    transfer(client, server, request)
    assert (client.done, client2.done) == (True, False)
    transfer(client2, server2, request)
    assert client.result == client2.result == NAME
    assert server2._od is not server._od


@given(st.binary(max_size=50))
def test_client_and_server_carry_any_bytes_both_ways(data: bytes) -> None:
    """Round trip of a domain: expedited up to 4 bytes, segmented else and when empty."""
    server, client = make_server(), SdoClient(5)
    wire = transfer(client, server, client.download(0, 0x2005, 0, data))
    assert (client.done, client.abort) == (True, 0)
    assert len(wire) == (2 if 1 <= len(data) <= 4 else 2 + 2 * max(1, -(-len(data) // 7)))
    transfer(client, server, client.upload(0, 0x2005, 0))
    assert (client.done, client.abort, client.result) == (True, 0, data)
    assert client.deadline == NEVER


@pytest.mark.parametrize(
    ("index", "data", "code"),
    [(0x9999, b"\1", ABORT_NO_OBJECT), (0x1008, b"x" * 9, ABORT_READ_ONLY), (0x2004, b"x" * 9, ABORT_TOO_LONG)],
)
def test_client_reports_the_servers_abort(index: int, data: bytes, code: int) -> None:
    """`done` with the code, no further request."""
    client = SdoClient(5)
    transfer(client, make_server(), client.download(0, index, 0, data))
    assert (client.done, client.abort, client.result, client.deadline) == (True, code, b"", NEVER)


def test_client_time_out_runs_from_the_last_answer() -> None:
    """05040000 goes to the server when 500 ms have passed without an answer."""
    server, client = make_server(), SdoClient(5)
    client.upload(0, 0x1008, 0)
    assert client.expire(500 * MS - 1) is None
    client.answer(10, server.request(0, UPLOAD_NAME) or b"")
    assert client.deadline == 500 * MS + 10
    assert client.expire(500 * MS) is None
    assert client.expire(500 * MS + 10) == abort(0x1008, 0, ABORT_TIMEOUT)
    assert (client.done, client.abort, client.deadline) == (True, ABORT_TIMEOUT, NEVER)
    assert client.answer(500 * MS + 11, bytes(8)) is None


def test_client_passes_over_the_answer_to_an_earlier_request() -> None:
    """A late initiate answer about another object does not end or fill the present transfer."""
    client = SdoClient(5)
    client.upload(0, 0x2000, 0)
    assert client.answer(0, bytes.fromhex("4301200011220000")) is None
    assert not client.done
    assert client.answer(0, bytes.fromhex("4f00200011000000")) is None
    assert (client.done, client.result) == (True, b"\x11")


@pytest.mark.parametrize(
    ("answers", "code"),
    [
        (["60081000"], ABORT_COMMAND),  # a download's answer
        (["4108100018", "1041"], ABORT_TOGGLE),
        (["4108100018", "60"], ABORT_COMMAND),
        (["4108100003", "00"], ABORT_TOO_LONG),
        (["4108100018", "01"], ABORT_TOO_SHORT),
        (["4108100001000100"], ABORT_MEMORY),
        (["4008100000", "01"], 0),  # without a size: any length
        (["4208100001020304"], 0),  # expedited without a size: four bytes
    ],
)
def test_client_judges_the_servers_answers(answers: list[str], code: int) -> None:
    """Wrong command, toggle or length: the client aborts with the reason, about the object of the transfer."""
    client = SdoClient(5)
    client.upload(0, 0x1008, 0)
    sent = [client.answer(0, bytes.fromhex(text).ljust(8, b"\0")) for text in answers]
    assert (client.done, client.abort) == (True, code)
    assert sent[-1] == (abort(0x1008, 0, code) if code else None)


def test_client_does_one_transfer_at_a_time() -> None:
    """A second one while the first runs is a programming error; after it, it is not."""
    client = SdoClient(5)
    client.upload(0, 0x1008, 0)
    with pytest.raises(CanopenExoError, match="2000:00 asked for while 1008:00 runs"):
        client.download(0, 0x2000, 0, b"\1")
    client.answer(0, abort(0x1008, 0, ABORT_NO_OBJECT))
    client.download(0, 0x2000, 0, b"\1")
    assert not client.done


@given(st.booleans(), st.binary(max_size=20), st.lists(st.binary(max_size=9), max_size=20))
def test_client_takes_any_bytes(upload: bool, data: bytes, answers: list[bytes]) -> None:
    """Never an exception; what it sends has eight bytes; done means no deadline."""
    client = SdoClient(5)
    first = client.upload(0, 0x1008, 0) if upload else client.download(0, 0x1008, 0, data)
    assert len(first) == 8
    for answer in answers:
        request = client.answer(0, answer)
        assert request is None or len(request) == 8
        assert client.done == (client.deadline == NEVER)


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (ABORT_TOGGLE, "05030000 (toggle bit not alternated)"),
        (ABORT_NO_SUB_INDEX, "06090011 (sub-index does not exist)"),
        (0x12345678, "12345678 (not in CiA 301)"),
    ],
)
def test_abort_codes_in_words(code: int, text: str) -> None:
    """CiA 301, table 22."""
    assert abort_text(code) == text


def test_cob_ids_are_the_predefined_ones() -> None:
    """CiA 301, 7.3.5: 600 + id from client to server, 580 + id back."""
    server, client = make_server(), SdoClient(5)
    assert (server.request_id, server.answer_id) == (client.request_id, client.answer_id) == (0x605, 0x585)
