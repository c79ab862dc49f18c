"""From plain data to checked dataclasses, with complaints in the file's own words.

pydantic checks the shape; the classes that come out are ordinary frozen dataclasses without a trace of it. Its errors
are said again as `path:line:col: key: message`, with what is allowed and what was probably meant.
"""

import types
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import (
    Annotated,
    ClassVar,
    Final,
    Literal,
    TypeAlias,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    Strict,
    TypeAdapter,
    ValidationError,
    WithJsonSchema,
)
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from fi_gateway.errors import FaultError
from fi_gateway.marked_yaml import Data, Document, Keys, did_you_mean
from fi_gateway.quantity import (
    Dimension,
    describe_value,
    format_duration,
    format_quantity,
    parse_duration,
    parse_quantity,
    parse_share,
)


class SpecError(FaultError):
    """One value of a spec does not fit the rig or the rest of the file. keys: which one, from where it was checked."""

    def __init__(self, keys: Keys, text: str) -> None:
        super().__init__(text)
        self.keys = keys


class SpecModel:
    """Base of the dataclasses that files are read into: unknown keys are refused.

    later: keys that the file format knows and this version does not do yet.
    """

    __slots__ = ()
    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")
    later: ClassVar[tuple[str, ...]] = ()


T = TypeVar("T", bound=SpecModel)


@dataclass(frozen=True, slots=True)
class Later:
    """Marks a choice: words that the file format knows and this version does not do yet."""

    words: tuple[str, ...]


class Choice:
    """Marks a hint: which words its key `type` may have, and the class behind each."""

    def words(self) -> list[str]:
        """The words, in the order in which they are shown."""
        raise NotImplementedError

    def find(self, word: str) -> type[SpecModel] | None:
        """The class of what has that type, None when there is none; raises ValueError when it cannot be had."""
        raise NotImplementedError


def _duration(given: object) -> int:
    """A time that may be 0 [ns]."""
    value = parse_duration(given)
    if value < 0:
        raise ValueError(f"{given!r} is negative; allowed from 0 s up")
    return value


def _span(given: object) -> int:
    """A length of time [ns]: more than 0."""
    value = parse_duration(given)
    if value <= 0:
        raise ValueError(f"{given!r} is not a length of time; allowed is more than 0 s")
    return value


def _angle(given: object) -> float:
    return parse_quantity(given, Dimension.ANGLE)


def _show_angle(value: float) -> str:
    return format_quantity(value, Dimension.ANGLE)


_TEXT: Final = WithJsonSchema({"type": "string", "examples": ["0.3 s", "-60 deg"]})

Time: TypeAlias = Annotated[int, BeforeValidator(_duration), PlainSerializer(format_duration), _TEXT]
Span: TypeAlias = Annotated[int, BeforeValidator(_span), PlainSerializer(format_duration), _TEXT]
Angle: TypeAlias = Annotated[float, BeforeValidator(_angle), PlainSerializer(_show_angle), _TEXT]
Share: TypeAlias = Annotated[
    float, BeforeValidator(parse_share), WithJsonSchema({"type": ["number", "string"], "examples": [0.2, "20 %"]})
]
Whole: TypeAlias = Annotated[int, Strict()]
Count: TypeAlias = Annotated[int, Strict(), Field(ge=1)]
Flag: TypeAlias = Annotated[bool, Strict()]
Text: TypeAlias = Annotated[str, Strict()]


@cache
def _made_once(model: object) -> TypeAdapter[SpecModel]:
    return TypeAdapter(cast("type[SpecModel]", model))


def _adapter(model: object) -> TypeAdapter[SpecModel]:
    return _made_once(model)  # by way of object: mypy takes classes for unhashable


def validate(model: type[T], data: Data, keys: Keys, document: Document | None) -> T | None:
    """`data`, which stands at `keys`, as a `model`; None when it is not one, which the document is told (if given)."""
    try:
        value = _adapter(model).validate_python(data)
    except ValidationError as error:
        if document is not None:
            for details in error.errors(include_url=False):
                _report(document, keys, model, details)
        return None
    assert isinstance(value, model)
    return value


def dump(model: type[T], value: T) -> dict[str, Data]:
    """Plain data that `validate` turns back into an equal value; what is absent (None) is left out."""
    plain: dict[str, Data] = _adapter(model).dump_python(value, mode="json", by_alias=True, exclude_none=True)
    return plain


def json_schema(model: type[SpecModel]) -> dict[str, Data]:
    """JSON Schema of the files that `model` is read from, for editors."""
    schema: dict[str, Data] = _adapter(model).json_schema(by_alias=True)
    return schema


def _report(document: Document, at: Keys, model: object, details: ErrorDetails) -> None:
    """Say one of pydantic's errors in our words, at its place."""
    location, kind, given = details["loc"], details["type"], details["input"]
    if kind in ("unexpected_keyword_argument", "missing"):
        keys, owner = _walk(model, location[:-1])
        place = (*at, *keys, str(location[-1]))
        if kind == "missing":
            document.report(place, f"missing; needed: {', '.join(_keys(owner, required=True))}", at_key=True)
        else:
            document.report(place, _unknown_key(str(location[-1]), owner), at_key=True)
        return
    keys, here = _walk(model, location)
    place = (*at, *keys)
    if kind == "union_tag_not_found":
        document.report((*place, "type"), f"missing; allowed: {', '.join(_tags(here))}", at_key=True)
    elif kind == "union_tag_invalid":
        word = str(details["ctx"]["tag"])
        document.report((*place, "type"), _unknown_word(str(place[-1]), word, _tags(here), _later(here)))
    elif kind == "literal_error":
        words = [str(word) for word in get_args(_bare(here))]
        document.report(place, _unknown_word(str(place[-1]), given, words, _later(here)))
    elif kind == "value_error":
        document.report(place, str(details["ctx"]["error"]))
    else:
        document.report(place, _plain_message(kind, given, here, details))


def _plain_message(kind: str, given: object, here: object, details: ErrorDetails) -> str:
    limits = details.get("ctx", {})
    got = describe_value(given)
    messages: dict[str, Callable[[], str]] = {
        "dataclass_type": lambda: f"expected a mapping with {', '.join(_keys(here))}; got {got}",
        "model_attributes_type": lambda: f"expected a mapping with type: {' | '.join(_tags(here))}; got {got}",
        "dict_type": lambda: f"expected a mapping of names; got {got}",
        "tuple_type": lambda: f"expected a list such as [a, b]; got {got}",
        "bool_type": lambda: f"expected true or false; got {got}",
        "int_type": lambda: f"expected a whole number; got {got}",
        "string_type": lambda: f"expected a text; got {got}",
        "greater_than_equal": lambda: f"{got} is too small; allowed from {limits['ge']} up",
        "less_than_equal": lambda: f"{got} is too large; allowed up to {limits['le']}",
        "too_short": lambda: f"the list needs at least {limits['min_length']} item",
    }
    return messages[kind]() if kind in messages else f"{details['msg']}; got {got}"


def _unknown_key(key: str, owner: object) -> str:
    allowed = _keys(owner)
    if is_dataclass(owner) and key in getattr(owner, "later", ()):
        return f"not available yet; available: {', '.join(allowed)}"
    what = f"{tag(owner)} has no such key" if "type" in allowed else "unknown key"
    return f"{what}{did_you_mean(key, allowed)} (allowed: {', '.join(allowed)})"


def _unknown_word(what: str, word: object, allowed: list[str], later: tuple[str, ...]) -> str:
    if word in later:
        return f"{what} {word!r} is not available yet; available: {', '.join(allowed)}"
    hint = did_you_mean(word, allowed) if isinstance(word, str) else ""
    got = repr(word) if isinstance(word, str) else describe_value(word)
    return f"unknown {what} {got}{hint} (allowed: {', '.join(allowed)})"


def _walk(model: object, location: tuple[int | str, ...]) -> tuple[Keys, object]:
    """The keys of a place in pydantic's notation, which also names the chosen type, and what is expected there."""
    here, keys = model, Keys()
    for item in location:
        bare = _bare(here)
        members = _members(bare)
        choice = _choice(here)
        if choice is not None and item != "type":
            here = choice.find(str(item))
            continue
        if members:
            here = next((member for member in members if tag(member) == item), None)
            continue
        keys = (*keys, item)
        arguments = get_args(bare)
        if isinstance(bare, type) and is_dataclass(bare):
            here = _hints(bare).get(str(item))
        elif get_origin(bare) is dict:
            here = arguments[1]
        else:
            here = arguments[0] if arguments else None
    bare = _bare(here)
    return keys, bare if isinstance(bare, type) and is_dataclass(bare) else here


def _bare(hint: object) -> object:
    """The hint without Annotated and without `| None`."""
    while get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    if get_origin(hint) in (Union, types.UnionType):
        members = [member for member in get_args(hint) if member is not type(None)]
        if len(members) == 1:
            return _bare(members[0])
    return hint


def _members(bare: object) -> tuple[object, ...]:
    """The dataclasses of a choice by `type`; () for anything else."""
    return get_args(bare) if get_origin(bare) in (Union, types.UnionType) else ()


def tag(member: object) -> str:
    """The word a class goes by: its only `type`, or its name when several lead to it."""
    kind = _hints(member)["type"]
    return str(get_args(kind)[0]) if get_origin(kind) is Literal else getattr(member, "__name__", str(member))


def _tags(hint: object) -> list[str]:
    choice = _choice(hint)
    if choice is not None:
        return choice.words()
    return [tag(member) for member in _members(_bare(hint))]


def _choice(hint: object) -> Choice | None:
    """The Choice that marks the hint, wherever in it."""
    if get_origin(hint) in (Union, types.UnionType):
        return next((found for found in map(_choice, get_args(hint)) if found is not None), None)
    if get_origin(hint) is not Annotated:
        return None
    inner, *marks = get_args(hint)
    return next((mark for mark in marks if isinstance(mark, Choice)), _choice(inner))


def _later(hint: object) -> tuple[str, ...]:
    """The words marked `Later`, wherever in the hint."""
    if get_origin(hint) is not Annotated:
        return ()
    inner, *marks = get_args(hint)
    return sum((mark.words for mark in marks if isinstance(mark, Later)), _later(inner))


def _hints(model: object) -> dict[str, object]:
    """Key in the file -> type hint, in written order."""
    return {alias: hint for alias, hint, _ in _shape(model)}


def _keys(model: object, required: bool = False) -> list[str]:
    return [alias for alias, _, needed in _shape(model) if needed or not required]


@cache
def _shape(model: object) -> tuple[tuple[str, object, bool], ...]:
    """(key in the file, type hint, whether it is required) of each field."""
    if not (isinstance(model, type) and is_dataclass(model)):
        return ()
    hints = get_type_hints(model, include_extras=True)
    shape = []
    for entry in fields(model):
        marks = get_args(hints[entry.name])[1:] if get_origin(hints[entry.name]) is Annotated else ()
        aliases = [mark.alias for mark in marks if isinstance(mark, FieldInfo) and mark.alias]
        needed = entry.default is entry.default_factory  # both MISSING
        shape.append((aliases[0] if aliases else entry.name, hints[entry.name], needed))
    return tuple(shape)
