"""YAML files read into plain data that remembers where each value stood: every complaint can say line and column.

Grammar: YAML 1.1 as PyYAML scans it, with the plain scalars of YAML 1.2's core schema: only true/false are booleans, so
`off` is the word "off"; no sexagesimal numbers, no dates. Left out on purpose, and refused: anchors and aliases (a few
lines of them expand to gigabytes), tags, several documents in one file, keys that are not words, duplicate keys,
numbers that are not finite.
"""

import difflib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeAlias

import yaml

from fi_gateway.errors import FaultError

Data: TypeAlias = "str | int | float | bool | list[Data] | dict[str, Data] | None"
Keys: TypeAlias = tuple[str | int, ...]
"""Where a value stands in a document: ("injectors", "freeze_position", "effect")."""

MAX_BYTES: Final = 1_000_000
MAX_DEPTH: Final = 32

_INTEGER: Final = re.compile(r"[-+]?[0-9]{1,30}|0x[0-9a-fA-F]{1,24}", re.ASCII)
_FLOAT: Final = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", re.ASCII)
_BREAKS: Final = re.compile("[\x85\u2028\u2029\ufeff]")
_FLOW: Final = re.compile(r"[\[\]{},#\n]")
_SCALAR: Final = "'<scalar>'"
_NOT_FINITE: Final = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_WORDS: Final[dict[str, bool | None]] = {
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
}


class FileErrors(FaultError):  # noqa: N818 (it is all the errors of a file)
    """Everything that is wrong with a file (and the overrides on top of it), one message each, in the file's order."""

    def __init__(self, messages: Iterable[str]) -> None:
        self.messages = tuple(messages)
        super().__init__("\n".join(self.messages))

    def __reduce__(self) -> tuple[type["FileErrors"], tuple[tuple[str, ...]]]:
        return FileErrors, (self.messages,)


@dataclass(frozen=True, slots=True)
class Mark:
    """Where a value was written.

    line, column: from 1; override: the `--set key=value` it came from, or "", and then line is that one's number.
    """

    line: int
    column: int
    override: str = ""


@dataclass(frozen=True, slots=True)
class Problem:
    """One complaint about the value at `keys`."""

    keys: Keys
    mark: Mark
    text: str


@dataclass(slots=True)
class Document:
    """Plain data, the marks of its values and of the keys before them, and what is wrong so far.

    source: the file as messages name it. broken: places without usable data; what is said about them, below them, or
    of the mapping they are in later would only be a consequence, and is not reported. overrides: how many were applied.
    """

    source: str
    data: Data = None
    values: dict[Keys, Mark] = field(default_factory=dict)
    keys: dict[Keys, Mark] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    broken: set[Keys] = field(default_factory=set)
    overrides: int = 0

    def mark(self, keys: Keys, at_key: bool = False) -> Mark:
        """Mark of the value (or of its key); of the nearest thing around it where there is none."""
        if at_key and keys in self.keys:
            return self.keys[keys]
        if keys in self.values:
            return self.values[keys]
        while keys:
            keys = keys[:-1]
            mark = self.keys.get(keys) or self.values.get(keys)
            if mark is not None:
                return mark
        return Mark(1, 1)

    def report(self, keys: Keys, text: str, at_key: bool = False) -> None:
        """Complain about the value (or the key) at `keys`."""
        below = any(keys[:depth] in self.broken for depth in range(len(keys) + 1))
        if not below and not any(place[:-1] == keys for place in self.broken if place):
            self.problems.append(Problem(keys, self.mark(keys, at_key), text))

    def raise_problems(self) -> None:
        """Raise FileErrors when anything was reported."""
        if self.problems:
            ordered = sorted(self.problems, key=lambda problem: _order(problem.mark))
            raise FileErrors(dict.fromkeys(self.line(problem) for problem in ordered))

    def line(self, problem: Problem) -> str:
        """`path:line:col: key: message`, or `--set key=value: message`."""
        mark, key = problem.mark, dotted(problem.keys)
        if mark.override:
            same = mark.override.removeprefix("--set ").partition("=")[0] == key
            return f"{mark.override}: {'' if same or not key else key + ': '}{problem.text}"
        return f"{self.source}:{mark.line}:{mark.column}: {key + ': ' if key else ''}{problem.text}"


def _order(mark: Mark) -> tuple[bool, int, int]:
    return mark.override != "", mark.line, mark.column


def dotted(keys: Keys) -> str:
    """A place as `--set` and messages write it: "injectors.freeze_position.effect.duration"."""
    return ".".join(str(key) for key in keys)


def did_you_mean(given: str, allowed: Iterable[str]) -> str:
    """ "; did you mean 'x'?" when something similar is allowed, else ""."""
    close = difflib.get_close_matches(given, list(allowed), n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else ""


def load(path: Path | str) -> Document:
    """The file as a Document whose problems are not yet raised; raises FileErrors when it cannot be read as YAML."""
    source = str(path)
    try:
        with open(path, "rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise FileErrors([f"{source}: no such file"]) from None
    except IsADirectoryError:
        raise FileErrors([f"{source}: this is a directory; give a YAML file"]) from None
    except OSError as error:
        raise FileErrors([f"{source}: cannot be read: {error.strerror or error}"]) from None
    except ValueError as error:  # a NUL in the name
        raise FileErrors([f"{source!r}: not a file name: {error}"]) from None
    if len(raw) > MAX_BYTES:
        raise FileErrors([f"{source}: larger than {MAX_BYTES // 1000} kB, the most a scenario may have"])
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        column = error.start - raw.rfind(b"\n", 0, error.start)
        raise FileErrors(
            [f"{source}:{line}:{column}: byte 0x{raw[error.start]:02x} is not UTF-8; save the file as UTF-8"]
        ) from None
    return parse(text, source)


def parse(text: str, source: str) -> Document:
    """As `load`, from text; a syntax error is raised alone, as nothing behind it can be read."""
    document = Document(source)
    try:
        _read(document, text)
    except _UnreadableError as error:
        raise FileErrors([f"{source}:{error.line}:{error.column}: {error.text}"]) from None
    if document.data is None:
        document.report((), "the file is empty")
        document.broken.add(())
    return document


def write(data: dict[str, Data]) -> str:
    """YAML text that `parse` reads as the same data, in the same order; also read alike by YAML 1.1 readers."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


def flow_text(data: Data) -> str:
    """One line of YAML that `parse` and `set_value` read as the same data; a text is left as it is where that does."""
    if isinstance(data, str) and data == data.strip() and not _FLOW.search(data):
        try:
            if parse(data, "value").data == data:
                return data
        except FileErrors:
            pass
    text: str = yaml.dump(
        data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=math.inf, default_flow_style=True
    )
    return text.removesuffix("...\n").strip()


class _Dumper(yaml.SafeDumper):
    """Puts quotes around texts that only our notation of numbers takes for a number, such as 1e3.

    Texts with the line breaks of Unicode are escaped, which YAML would otherwise fold into spaces.
    """


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"' if _BREAKS.search(text) else None)


_Dumper.add_representer(str, _text)
_Dumper.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(f"({_INTEGER.pattern})\\Z"), list("-+0123456789"))
_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(f"({_FLOAT.pattern})\\Z"), list("-+.0123456789"))


def apply_override(document: Document, override: str) -> None:
    """Set one value from `key=value`: a dotted path (list items by number from 0), and a value in YAML's flow style.

    The last part of the path may be new; the parts before it must exist. Problems go to the document.
    """
    key, equals, text = override.partition("=")
    document.overrides += 1
    origin = Mark(document.overrides, 0, f"--set {override}")
    if not equals or not all(key.strip().split(".")):
        document.problems.append(Problem((), origin, "expected key=value, such as motion.duration=7s"))
        return
    set_value(document, key.strip(), text, origin)


def set_value(document: Document, key: str, text: str, origin: Mark) -> None:
    """As apply_override, whatever the value came from: messages about it begin with `origin.override`."""
    parts = key.split(".")
    value = Document(origin.override)
    try:
        _read(value, text)
        keys = _assign(document, parts, value.data)
    except _UnreadableError as error:
        document.problems.append(Problem(tuple(parts), origin, error.text))
        return
    for marks in (document.values, document.keys):
        for old in [place for place in marks if place[: len(keys)] == keys]:
            del marks[old]
    document.broken = {place for place in document.broken if place[: len(keys)] != keys}
    document.broken.update(keys + place for place in value.broken)
    document.problems = [found for found in document.problems if found.keys[: len(keys)] != keys]
    document.problems.extend(Problem(keys + found.keys, origin, found.text) for found in value.problems)
    document.values.update({keys + place: origin for place in ((), *value.values)})
    document.keys.update({keys + place: origin for place in ((), *value.keys)})


def _assign(document: Document, parts: list[str], value: Data) -> Keys:
    """Put `value` at the dotted place; returns the place."""
    here, keys = document.data, Keys()
    for depth, part in enumerate(parts):
        last = depth == len(parts) - 1
        if isinstance(here, list):
            if not part.isdecimal() or int(part) >= len(here):
                raise _UnreadableError(0, 0, f"{dotted(keys)} has items 0..{len(here) - 1}, got {part!r}")
            keys = (*keys, int(part))
            if last:
                here[int(part)] = value
            here = here[int(part)]
        elif isinstance(here, dict):
            if part not in here and not last:
                known = f"; there are {', '.join(here)}" if here else "; there are none"
                where = f" in {dotted(keys)}" if keys else ""
                raise _UnreadableError(0, 0, f"no {part!r}{where}{did_you_mean(part, here) or known}")
            keys = (*keys, part)
            if last:
                here[part] = value
            here = here[part]
        else:
            raise _UnreadableError(0, 0, f"{dotted(keys) or 'the file'} is a single value and has no {part!r}")
    return keys


class _UnreadableError(Exception):
    """Nothing can be read from here on. line, column: from 1."""

    def __init__(self, line: int, column: int, text: str) -> None:
        super().__init__(text)
        self.line, self.column, self.text = line, column, text


def _read(document: Document, text: str) -> None:
    """Fill the document; raises _UnreadableError on a syntax error."""
    try:
        reader = _Reader(document, text)
        document.data = reader.document()
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        column = error.position - text.rfind("\n", 0, error.position)
        message = f"character U+{ord(text[error.position]):04X} is not allowed in YAML"
        raise _UnreadableError(line, column, message) from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        message = _unclosed(error, text, reader.innermost()) or _syntax(error)
        raise _UnreadableError(line, column, message) from None


def _unclosed(error: yaml.MarkedYAMLError, text: str, innermost: yaml.Mark | None) -> str:
    """About a bracket that may be many lines before the place where it can no longer be right; "" for another error."""
    if innermost is None or not (error.context or "").startswith("while parsing a flow "):
        return ""
    place = f"line {innermost.line + 1}, column {innermost.column + 1}"
    opened = f"YAML syntax: the {text[innermost.index]!r} of {place} is not closed"
    problem = error.problem or ""
    if problem.endswith(("<stream end>'", "<document start>'", "<document end>'")):
        return opened
    expected, _, found = problem.partition(", but got ")
    if not expected.startswith("expected ',' or "):
        return ""
    return f"{opened}, or a ',' is missing, before this {'value' if found == _SCALAR else found}"


def _syntax(error: yaml.MarkedYAMLError) -> str:
    problem = error.problem or "not YAML"
    if "'\\t'" in problem:
        return "a tab stands where YAML wants spaces; indent with spaces"
    if problem.startswith("mapping values are not allowed"):
        remedy = "put quotes around a text that contains ': ', or { } around keys with their values"
        return f"YAML syntax: a second ': ' in one line; {remedy}"
    context = f" {error.context}," if error.context else ""
    return f"YAML syntax:{context} {problem}"


class _Reader:
    """Turns YAML events into data and marks."""

    def __init__(self, document: Document, text: str) -> None:
        self._into = document
        self._events = yaml.SafeLoader(text)

    def document(self) -> Data:
        """The one document of the stream; None when there is none."""
        self._next()
        if isinstance(self._peek(), yaml.StreamEndEvent):
            return None
        self._next()
        data = self._node((), 0)
        self._next()
        after = self._peek()
        if not isinstance(after, yaml.StreamEndEvent):
            text = "a second document starts here; one file holds one document"
            self._into.problems.append(Problem((), _mark(after), text))
        return data

    def innermost(self) -> yaml.Mark | None:
        """Where the innermost list or mapping begins that has not ended."""
        return self._events.marks[-1] if self._events.marks else None

    def _peek(self) -> yaml.Event:
        try:
            event: yaml.Event = self._events.peek_event()  # type: ignore[no-untyped-call]
        except (ValueError, OverflowError):  # PyYAML lets an escape beyond U+10FFFF through to chr()
            text = "YAML syntax: a number in an escape or directive is out of range"
            raise _UnreadableError(self._events.line + 1, self._events.column + 1, text) from None
        return event

    def _next(self) -> yaml.Event:
        event = self._peek()
        self._events.get_event()  # type: ignore[no-untyped-call]
        return event

    def _node(self, keys: Keys, depth: int) -> Data:
        event = self._next()
        mark = _mark(event)
        self._into.values[keys] = mark
        if depth >= MAX_DEPTH and isinstance(event, yaml.CollectionStartEvent):
            raise _UnreadableError(mark.line, mark.column, f"nested more than {MAX_DEPTH} deep")
        if isinstance(event, yaml.AliasEvent):
            self._break(keys, f"aliases (*{event.anchor}) are not used here; write the value out")
            return None
        if isinstance(event, yaml.NodeEvent) and event.anchor is not None:
            self._into.report(keys, f"anchors (&{event.anchor}) are not used here; leave it out")
        if isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent) and event.tag is not None:
            self._into.report(keys, f"tags ({event.tag}) are not used here; leave it out")
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(keys, event)
        if isinstance(event, yaml.SequenceStartEvent):
            items: list[Data] = []
            while not isinstance(self._peek(), yaml.SequenceEndEvent):
                items.append(self._node((*keys, len(items)), depth + 1))
            self._next()
            return items
        return self._mapping(keys, depth)

    def _mapping(self, keys: Keys, depth: int) -> Data:
        found: dict[str, Data] = {}
        while not isinstance(self._peek(), yaml.MappingEndEvent):
            event = self._peek()
            mark = _mark(event)
            key = self._node((*keys, "?"), depth + 1)
            self._into.values.pop((*keys, "?"))
            if not isinstance(key, str):
                what = "lists and mappings" if isinstance(key, list | dict) else f"{getattr(event, 'value', key)!r}"
                self._into.problems.append(Problem(keys, mark, f"keys are words; {what} cannot be one without quotes"))
                key = str(key)
                self._into.broken.add((*keys, key))
            place = (*keys, key)
            if key in found:
                first = self._into.keys[place]
                text = f"given twice; first at {first.line}:{first.column}"
                self._into.problems.append(Problem(place, mark, text))
            self._into.keys[place] = mark
            found[key] = self._node(place, depth + 1)
        self._next()
        return found

    def _scalar(self, keys: Keys, event: yaml.ScalarEvent) -> Data:
        text: str = event.value
        if any("\ud800" <= letter <= "\udfff" for letter in text):
            self._break(keys, "half of a surrogate pair is not a character; write the character itself")
            return None
        if not event.implicit[0]:  # quoted, or a block of text
            return text
        if text in _WORDS:
            return _WORDS[text]
        if _INTEGER.fullmatch(text):
            return int(text, 16 if text.startswith("0x") else 10)
        if _NOT_FINITE.fullmatch(text) or (_FLOAT.fullmatch(text) and not math.isfinite(float(text))):
            self._break(keys, f"{text if len(text) < 30 else 'this number'} is not a finite number")
            return None
        return float(text) if _FLOAT.fullmatch(text) else text

    def _break(self, keys: Keys, text: str) -> None:
        self._into.report(keys, text)
        self._into.broken.add(keys)


def _mark(event: yaml.Event) -> Mark:
    start = event.start_mark
    return Mark(start.line + 1, start.column + 1) if start else Mark(1, 1)
