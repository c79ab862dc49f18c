"""Files are read with the place of every value, and whatever is odd about them is said at its line and column."""

import copy
import pickle
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fi_gateway.marked_yaml import (
    MAX_BYTES,
    MAX_DEPTH,
    Data,
    FileErrors,
    apply_override,
    load,
    parse,
    write,
)

PLAIN = """\
name: knee
rig: {plant: suspended, stops: off}
list:
  - a
  - b: 1
"""


def errors(text: str) -> tuple[str, ...]:
    """All messages about a text."""
    with pytest.raises(FileErrors) as caught:
        parse(text, "s.yaml").raise_problems()
    return caught.value.messages


def test_values_and_keys_are_marked_from_line_1_and_column_1() -> None:
    """path:line:col counts as editors do."""
    document = parse(PLAIN, "s.yaml")
    assert document.data == {"name": "knee", "rig": {"plant": "suspended", "stops": "off"}, "list": ["a", {"b": 1}]}
    places = {keys: (mark.line, mark.column) for keys, mark in document.values.items()}
    assert places == {
        (): (1, 1),
        ("name",): (1, 7),
        ("rig",): (2, 6),
        ("rig", "plant"): (2, 14),
        ("rig", "stops"): (2, 32),
        ("list",): (4, 3),
        ("list", 0): (4, 5),
        ("list", 1): (5, 5),
        ("list", 1, "b"): (5, 8),
    }
    assert (document.mark(("rig", "stops"), at_key=True).column, document.keys[("list",)].line) == (25, 3)


@pytest.mark.parametrize(
    ("scalar", "value"),
    [
        ("off", "off"), ("on", "on"), ("yes", "yes"), ("no", "no"), ("Off", "Off"), ("y", "y"),
        ("true", True), ("false", False), ("True", True), ("'true'", "true"),
        ("null", None), ("~", None), ("", None), ("''", ""),
        ("2020", 2020), ("-3", -3), ("010", 10), ("0x185", 0x185), ("'5'", "5"),
        ("0.5", 0.5), ("5e-4", 5e-4), ("1e3", 1000.0), (".5", 0.5), ("5.", 5.0),
        ("1:30", "1:30"), ("1_000", "1_000"), ("2020-01-01", "2020-01-01"), ("0.3 s", "0.3 s"), ("0o17", "0o17"),
        ("<<", "<<"), ("=", "="),
    ],
)  # fmt: skip
def test_plain_scalars_follow_the_core_schema_of_yaml_1_2(scalar: str, value: Data) -> None:
    """Only true and false are booleans: `stops: off` is the word "off". No sexagesimal numbers, no dates."""
    document = parse(f"a: {scalar}\n", "s.yaml")
    assert document.data == {"a": value}
    assert type(document.data["a"]) is type(value)
    assert document.problems == []


def test_on_is_a_usable_key() -> None:
    """`trigger: {any: [a], on: activated}`: YAML 1.1 would read the key as true."""
    assert parse("t: {any: [a], on: activated}", "s.yaml").data == {"t": {"any": ["a"], "on": "activated"}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "s.yaml:1:1: the file is empty"),
        ("# only a comment\n", "s.yaml:1:1: the file is empty"),
        ("---\n", "s.yaml:2:1: the file is empty"),
        ("a: 1\n\tb: 2\n", "s.yaml:2:1: a tab stands where YAML wants spaces; indent with spaces"),
        ("a: b: c\n",
         "s.yaml:1:5: YAML syntax: a second ': ' in one line; put quotes around a text that contains ': ', "
         "or { } around keys with their values"),
        ("a: {b: 1\n",
         "s.yaml:2:1: YAML syntax: the '{' of line 1, column 4 is not closed"),
        ("a: 1\nr: {p: s,\n  q: t\nm: 5\n",
         "s.yaml:4:2: YAML syntax: the '{' of line 2, column 4 is not closed, or a ',' is missing, before this ':'"),
        ("e: [{a: b}, [c\nd: 5\n",
         "s.yaml:2:2: YAML syntax: the '[' of line 1, column 13 is not closed, or a ',' is missing, before this ':'"),
        ("a: {b: [c}\n",
         "s.yaml:1:10: YAML syntax: the '[' of line 1, column 8 is not closed, or a ',' is missing, before this '}'"),
        ("a: {b: {c: d}\ne: f\n",
         "s.yaml:2:1: YAML syntax: the '{' of line 1, column 4 is not closed, or a ',' is missing, before this value"),
        ("a: [b,\n", "s.yaml:2:1: YAML syntax: the '[' of line 1, column 4 is not closed"),
        ("a: [b\n---\nc: d\n", "s.yaml:2:1: YAML syntax: the '[' of line 1, column 4 is not closed"),
        ("a: {b: c, - d}\n",
         "s.yaml:1:11: YAML syntax: while parsing a flow node, expected the node content, but found '-'"),
        ("a: 1\na: 2\n", "s.yaml:2:1: a: given twice; first at 1:1"),
        ("x:\n  a: {b: 1}\n  c: 2\n  a: {b: 3}\n", "s.yaml:4:3: x.a: given twice; first at 2:3"),
        ("a: .nan\n", "s.yaml:1:4: a: .nan is not a finite number"),
        ("a: [1, -.inf]\n", "s.yaml:1:8: a.1: -.inf is not a finite number"),
        ("a: 1e999\n", "s.yaml:1:4: a: 1e999 is not a finite number"),
        (f"a: {'9' * 400}\n", "s.yaml:1:4: a: this number is not a finite number"),
        ("a: *b\n", "s.yaml:1:4: a: aliases (*b) are not used here; write the value out"),
        ("a: &b 1\n", "s.yaml:1:4: a: anchors (&b) are not used here; leave it out"),
        ("a: !x 1\n", "s.yaml:1:4: a: tags (!x) are not used here; leave it out"),
        ("a: !!python/object/apply:os.system [ls]\n",
         "s.yaml:1:4: a: tags (tag:yaml.org,2002:python/object/apply:os.system) are not used here; leave it out"),
        ("5: 1\n", "s.yaml:1:1: keys are words; '5' cannot be one without quotes"),
        ("true: 1\n", "s.yaml:1:1: keys are words; 'true' cannot be one without quotes"),
        ("? [a]\n: 1\n", "s.yaml:1:3: keys are words; lists and mappings cannot be one without quotes"),
        ("a: 1\n---\nb: 2\n", "s.yaml:2:1: a second document starts here; one file holds one document"),
        ("a: \x07\n", "s.yaml:1:4: character U+0007 is not allowed in YAML"),
        ('a: "\\UFFFFFFFF"\n', "s.yaml:1:7: YAML syntax: a number in an escape or directive is out of range"),
        ('a: "\\uD800"\n', "s.yaml:1:4: a: half of a surrogate pair is not a character; write the character itself"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_said_at_its_place(text: str, message: str) -> None:
    """path:line:col: key: message."""
    assert errors(text) == (message,)


def test_all_problems_are_told_at_once_in_the_order_of_the_file() -> None:
    """All errors at once."""
    assert [message.split(": ")[0] for message in errors("a: .nan\nb: *x\nc: 1\nc: 2\nd: &y 3\n")] == [
        "s.yaml:1:4",
        "s.yaml:2:4",
        "s.yaml:4:1",
        "s.yaml:5:4",
    ]


def test_an_alias_bomb_is_refused_before_it_grows() -> None:
    """No alias is ever expanded."""
    bomb = "a: &a [x, x]\n" + "".join(
        f"{name}: &{name} [*{last}, *{last}]\n" for last, name in zip("abcdefghij", "bcdefghijk", strict=True)
    )
    assert any("aliases" in message for message in errors(bomb))


@pytest.mark.parametrize(("depth", "fits"), [(MAX_DEPTH, True), (MAX_DEPTH + 1, False), (100_000, False)])
def test_nesting_has_a_limit(depth: int, fits: bool) -> None:
    """Deep nesting is refused instead of exhausting the stack."""
    text = "[" * depth + "]" * depth
    if fits:
        parse(text, "s.yaml").raise_problems()
    else:
        assert "deep" in errors(text)[0]


def test_consequences_of_a_broken_value_are_not_reported() -> None:
    """What is said about a place without usable data is noise."""
    document = parse("a: {b: *x}\nc: 1\n", "s.yaml")
    document.report(("a", "b"), "expected a number")
    document.report(("a", "b", "d"), "missing")
    document.report(("c",), "too small")
    with pytest.raises(FileErrors) as caught:
        document.raise_problems()
    assert len(caught.value.messages) == 2


def test_a_missing_value_is_reported_where_it_should_have_been() -> None:
    """Nearest thing around it: the key of the mapping."""
    document = parse("a:\n  b:\n    c: 1\n", "s.yaml")
    document.report(("a", "b", "d"), "missing", at_key=True)
    with pytest.raises(FileErrors, match=r"s\.yaml:2:3: a\.b\.d: missing"):
        document.raise_problems()


def test_files_that_cannot_be_read_say_why(tmp_path: Path) -> None:
    """Missing, directory, not UTF-8, too large, and a name that is none."""
    with pytest.raises(FileErrors, match="no such file"):
        load(tmp_path / "none.yaml")
    with pytest.raises(FileErrors, match="directory"):
        load(tmp_path)
    latin = tmp_path / "latin.yaml"
    latin.write_bytes("name: a\nb: Grö\xdfe\n".encode("latin-1"))
    with pytest.raises(FileErrors, match=r"latin\.yaml:2:6: byte 0xf6 is not UTF-8"):
        load(latin)
    large = tmp_path / "large.yaml"
    large.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(FileErrors, match="1000 kB"):
        load(large)
    large.write_bytes(b"a: 1\n" + b"#" * (MAX_BYTES - 5))
    assert load(large).data == {"a": 1}
    with pytest.raises(FileErrors, match="not a file name"):
        load("a\0b")


def test_an_unreadable_file_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    """Permission denied."""

    def refuse(*args: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("builtins.open", refuse)
    with pytest.raises(FileErrors, match=r"^secret\.yaml: cannot be read: Permission denied$"):
        load("secret.yaml")


def test_a_byte_order_mark_and_windows_line_ends_are_fine(tmp_path: Path) -> None:
    """Editors on Windows write both."""
    file = tmp_path / "bom.yaml"
    file.write_bytes(b"\xef\xbb\xbfname: x\r\nb: .nan\r\n")
    with pytest.raises(FileErrors, match=r":2:4: b: \.nan"):
        load(file).raise_problems()


@pytest.mark.parametrize(
    ("override", "data"),
    [
        ("name=foot", {"name": "foot", "rig": {"stops": "off"}, "list": [1, 2]}),
        ("rig.stops=on", {"name": "knee", "rig": {"stops": "on"}, "list": [1, 2]}),
        ("rig.rate=500 Hz", {"name": "knee", "rig": {"stops": "off", "rate": "500 Hz"}, "list": [1, 2]}),
        ("rig={a: [1, x]}", {"name": "knee", "rig": {"a": [1, "x"]}, "list": [1, 2]}),
        ("list.1=a == b", {"name": "knee", "rig": {"stops": "off"}, "list": [1, "a == b"]}),
        ("name=", {"name": None, "rig": {"stops": "off"}, "list": [1, 2]}),
    ],
)
def test_an_override_sets_one_value(override: str, data: Data) -> None:
    """--set key=value, value in YAML's flow style; the last part of the path may be new."""
    document = parse("name: knee\nrig: {stops: off}\nlist: [1, 2]\n", "s.yaml")
    apply_override(document, override)
    assert document.data == data
    assert document.problems == []


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("name", "expected key=value, such as motion.duration=7s"),
        ("=1", "expected key=value, such as motion.duration=7s"),
        ("rig..a=1", "expected key=value, such as motion.duration=7s"),
        ("rg.stops=on", "no 'rg'; did you mean 'rig'?"),
        ("rig.x.y=1", "no 'x' in rig; there are stops"),
        ("list.2=1", "list has items 0..1, got '2'"),
        ("list.-1=1", "list has items 0..1, got '-1'"),
        ("name.x=1", "name is a single value and has no 'x'"),
        ("name=[1", "YAML syntax: the '[' of line 1, column 1 is not closed"),
        ("name=*a", "aliases (*a) are not used here; write the value out"),
        ("name=.inf", ".inf is not a finite number"),
    ],
)
def test_a_bad_override_is_reported_by_its_own_name(override: str, words: str) -> None:
    """--set key=value: message."""
    document = parse("name: knee\nrig: {stops: off}\nlist: [1, 2]\n", "s.yaml")
    apply_override(document, override)
    with pytest.raises(FileErrors) as caught:
        document.raise_problems()
    assert caught.value.messages == (f"--set {override}: {words}",)


def test_complaints_about_an_overridden_value_name_the_override() -> None:
    """The file is not to blame, also for what is inside the new value; its own problem there is gone."""
    document = parse("a: {b: .nan}\n", "s.yaml")
    apply_override(document, "a={b: {c: 1}}")
    document.report(("a", "b", "c"), "too small")
    document.report(("a",), "odd")
    with pytest.raises(FileErrors) as caught:
        document.raise_problems()
    assert caught.value.messages == ("--set a={b: {c: 1}}: a.b.c: too small", "--set a={b: {c: 1}}: odd")


def test_file_errors_can_be_sent_between_processes() -> None:
    """Campaign workers hand them back."""
    error = FileErrors(["a", "b"])
    for again in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
        assert again.messages == ("a", "b")
        assert str(again) == "a\nb"


TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
SCALARS = st.none() | st.booleans() | st.integers(-(10**25), 10**25) | st.floats(allow_nan=False, allow_infinity=False)
LIKELY = st.sampled_from(
    ["off", "on", "1e3", "0x1F", "5.", "~", "null", "0.3 s", "1:30", "<<", "", "- a", "a: b", "#", "010"]
)


@example({"a": "Gr\u00f6\u00dfe\x85\u2028", "\ufeff": "\u2029"})
@given(
    st.dictionaries(
        TEXT.filter(lambda key: key not in ("?",)),
        st.recursive(SCALARS | TEXT | LIKELY, lambda inner: st.lists(inner, max_size=3), max_leaves=6),
        min_size=1,
        max_size=4,
    )
)
def test_what_is_written_is_read_back(data: dict[str, Data]) -> None:
    """Round trip data -> text -> data, types included."""
    document = parse(write(data), "s.yaml")
    document.raise_problems()
    assert repr(document.data) == repr(data)


@given(st.text(max_size=60) | st.text("ab:-[]{}&*!|>'\"%@`#,? \n\t\\xuU0123", max_size=60))
def test_any_text_is_data_or_a_clear_refusal(text: str) -> None:
    """No crash on any characters; what is said can be printed: no stray surrogates."""
    messages: tuple[str, ...] = ()
    try:
        parse(text, "s.yaml").raise_problems()
    except FileErrors as error:
        messages = error.messages
    assert all(message.startswith("s.yaml:") and message.encode() for message in messages)


@given(st.text(max_size=20), st.text("ab.=[]{}:1 ", max_size=20))
def test_any_override_is_applied_or_clearly_refused(key: str, value: str) -> None:
    """No crash on any command line."""
    document = parse(PLAIN, "s.yaml")
    apply_override(document, f"{key}={value}")
    messages: tuple[str, ...] = ()
    try:
        document.raise_problems()
    except FileErrors as error:
        messages = error.messages
    assert all(message.startswith("--set ") for message in messages)
