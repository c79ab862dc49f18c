"""Registries of what a scenario file can choose by `type`: faults, events, effects. One mechanism for all of them.

A word is the name of a built-in class, the name under which an installed package registers a class (entry point), or
the dotted path of a class, `my_package.my_module.MyFaultSpec`. Built-in names win, so that a file means the same
everywhere. A class that is not built in is imported when a file names it, and not before: who reads a file with a
dotted path runs code of that package.
"""

import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Annotated, Final, Generic, TypeVar, cast

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, TypeAdapter, ValidationError
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, InitErrorDetails, core_schema

from fi_gateway.boundary import Choice, SpecModel, dump, tag

S = TypeVar("S", bound=SpecModel)

_DOTTED: Final = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)+")


class Kinds(Choice, Generic[S]):
    """The classes of one choice. Stands in a hint: `Annotated[FaultSpec, FAULTS]`.

    what: "fault"; group: of the entry points, "exo_hil.faults"; base: what every class derives from. Each is a frozen
    dataclass with a field `type`: the Literal word of one that is built in, else a Text that keeps the word as written.
    """

    def __init__(self, what: str, group: str, base: type[S], built_in: tuple[type[S], ...]) -> None:
        self.what: Final[str] = what
        self.group: Final[str] = group
        self.base: Final[type[S]] = base
        self.built_in: Final[dict[str, type[S]]] = {tag(spec): spec for spec in built_in}

    def words(self) -> list[str]:
        """Built in, then installed."""
        return [*self.built_in, *self._installed]

    def find(self, word: str) -> type[S] | None:
        """The class behind a word; None for an unknown one. Raises ValueError when it cannot be imported or used."""
        if word in self.built_in:
            return self.built_in[word]
        installed = self._installed.get(word)
        if installed is not None:
            if len(installed) > 1:
                paths = ", ".join(sorted(entry.value.replace(":", ".") for entry in installed))
                raise ValueError(f"several installed packages call a {self.what} {word!r}; give one of {paths} instead")
            module, _, name = installed[0].value.partition(":")
            return self._load(module, name)
        if _DOTTED.fullmatch(word):
            module, _, name = word.rpartition(".")
            return self._load(module, name)
        return None

    @cached_property
    def _installed(self) -> dict[str, list[EntryPoint]]:
        found: dict[str, list[EntryPoint]] = {}
        for entry in entry_points(group=self.group):
            if entry.name not in self.built_in:
                found.setdefault(entry.name, []).append(entry)
        return found

    def _load(self, module: str, name: str) -> type[S]:
        """The class of that name in a module, fit for use."""
        path = f"{module}.{name}"
        try:
            found: object = import_module(module)
        except ImportError as error:
            raise ValueError(
                f"cannot import {module!r} for {path!r}: {error}; install the package, or put it on PYTHONPATH"
            ) from None
        found = getattr(found, name, None)
        if found is None:
            raise ValueError(f"{module!r} has no {name!r}")
        if not (isinstance(found, type) and issubclass(found, self.base)):
            needed = f"{self.base.__module__}.{self.base.__qualname__}"
            raise ValueError(f"{path!r} is no {self.what} for files: it must be a class derived from {needed}")
        if not _keeps_type(found):
            raise ValueError(f"{path!r} must be a frozen dataclass with the field `type: Text`, which keeps the word")
        return found

    def _read(self, data: object, read_built_in: Callable[[object], S]) -> S:
        """The data as an instance of the class that it names."""
        if isinstance(data, self.base):
            return data
        word = data.get("type") if isinstance(data, dict) else None
        if not isinstance(word, str) or word in self.built_in:
            return read_built_in(data)
        try:
            spec = self.find(word)
        except ValueError as error:
            problem = InitErrorDetails(type="value_error", loc=("type",), input=word, ctx={"error": error})
            raise ValidationError.from_exception_data(self.what, [problem]) from None
        if spec is None:
            return read_built_in(data)
        adapter: TypeAdapter[S] = TypeAdapter(cast("type[S]", Annotated[self.base, _Only(word, spec)]))
        return adapter.validate_python(data)

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        members = {word: handler.generate_schema(spec) for word, spec in self.built_in.items()}
        return core_schema.no_info_wrap_validator_function(
            self._read,
            core_schema.tagged_union_schema(members, "type"),
            serialization=core_schema.plain_serializer_function_ser_schema(lambda spec: dump(type(spec), spec)),
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """As for a union of all; what is installed is imported for this. A dotted path has no schema."""
        found = handler(schema)
        for word in self._installed:
            spec = self.find(word)
            assert spec is not None
            member = handler.resolve_ref_schema(handler(TypeAdapter(spec).core_schema))
            member["properties"]["type"] = {"const": word, "title": "Type", "type": "string"}
            found["oneOf"].append(member)
        return found


class _Only:
    """Marks a hint: this one class, whatever its `type` says; in errors the word stands where that of a union does."""

    def __init__(self, word: str, spec: type[SpecModel]) -> None:
        self._word: Final[str] = word
        self._spec: Final[type[SpecModel]] = spec

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.tagged_union_schema({self._word: handler.generate_schema(self._spec)}, "type")


def _keeps_type(found: object) -> bool:
    return is_dataclass(found) and "type" in (field.name for field in fields(found))
