"""The registry: built-in words, installed ones, dotted paths; what is refused, and that nothing is imported in vain."""

import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from types import ModuleType
from typing import Annotated, Literal

import pytest

import fi_gateway.kinds
from fi_gateway.boundary import Count, SpecModel, Text, dump, json_schema, validate
from fi_gateway.kinds import Kinds
from fi_gateway.marked_yaml import FileErrors, parse


class Shape(SpecModel):
    """What this choice is of."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Circle(Shape):
    """Built in."""

    type: Literal["circle"]
    radius: Count


@dataclass(frozen=True, slots=True)
class Square(Shape):
    """From elsewhere."""

    type: Text
    side: Count = 1


class NoDataclass(Shape):
    """Has no fields."""


class Stranger:
    """Is no Shape."""


SHAPES: Kinds[Shape] = Kinds("shape", "nobody.has_this_group", Shape, (Circle,))


@dataclass(frozen=True, slots=True)
class Drawing(SpecModel):
    """A file."""

    shape: Annotated[Shape, SHAPES]
    other: Annotated[Shape, SHAPES] | None = None


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of a module that has the classes above."""
    module = ModuleType("elsewhere_shapes")
    vars(module).update(Square=Square, NoDataclass=NoDataclass, Stranger=Stranger, number=3)
    monkeypatch.setitem(sys.modules, "elsewhere_shapes", module)
    return "elsewhere_shapes"


def read(text: str) -> Drawing | str:
    """The file, or what is wrong with it."""
    document = parse(text, "f.yaml")
    drawing = validate(Drawing, document.data, (), document)
    try:
        document.raise_problems()
    except FileErrors as errors:
        return "\n".join(errors.messages)
    assert drawing is not None
    return drawing


def test_a_built_in_word_gives_its_class() -> None:
    """As a union of built-in classes would."""
    assert read("shape: {type: circle, radius: 3}") == Drawing(Circle("circle", 3))


def test_a_dotted_path_gives_the_class_and_keeps_the_word(elsewhere: str) -> None:
    """The word is written back, so that the file can be read again where the path works."""
    drawing = read(f"shape: {{type: {elsewhere}.Square, side: 4}}\nother: {{type: {elsewhere}.Square}}")
    assert drawing == Drawing(Square(f"{elsewhere}.Square", 4), Square(f"{elsewhere}.Square", 1))
    assert isinstance(drawing, Drawing)
    assert dump(Drawing, drawing)["shape"] == {"type": f"{elsewhere}.Square", "side": 4}
    assert validate(Drawing, dump(Drawing, drawing), (), None) == drawing


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ("{type: circle, radius: 0}", "f.yaml:1:31: shape.radius: 0 is too small; allowed from 1 up"),
        ("{type: circle}", "shape.radius: missing; needed: type, radius"),
        ("{type: circel}", "shape.type: unknown shape 'circel'; did you mean 'circle'? (allowed: circle)"),
        ("{radius: 3}", "shape.type: missing; allowed: circle"),
        ("{type: 3}", "shape.type: "),
        ("circle", "shape: expected a mapping with type: circle; got 'circle'"),
        ("{type: elsewhere_shapes.Square, side: 0}", "f.yaml:1:46: shape.side: 0 is too small; allowed from 1 up"),
        ("{type: elsewhere_shapes.Square, sid: 1}", "shape.sid: Square has no such key; did you mean 'side'?"),
        ("{type: elsewhere_shapes.Sqare}", "f.yaml:1:15: shape.type: 'elsewhere_shapes' has no 'Sqare'"),
        ("{type: elsewhere_shapes.Stranger}", "shape.type: 'elsewhere_shapes.Stranger' is no shape for files"),
        ("{type: elsewhere_shapes.number}", "shape.type: 'elsewhere_shapes.number' is no shape for files"),
        ("{type: elsewhere_shapes.NoDataclass}", "must be a frozen dataclass with the field `type: Text`"),
        ("{type: no.such.package.Square}", "cannot import 'no.such.package' for 'no.such.package.Square': No module"),
        ("{type: .Square}", "shape.type: unknown shape '.Square'"),
        ("{type: a..Square}", "shape.type: unknown shape 'a..Square'"),
    ],
)
@pytest.mark.usefixtures("elsewhere")
def test_what_cannot_be_read_is_refused_at_its_place(shape: str, message: str) -> None:
    """What, where, got, allowed, remedy, whoever wrote the class."""
    said = read(f"shape: {shape}")
    assert isinstance(said, str)
    assert message in said


def installed(monkeypatch: pytest.MonkeyPatch, *entries: tuple[str, str]) -> Kinds[Shape]:
    """A choice with these entry points: (name, path)."""
    found = [EntryPoint(name, path, "shapes.group") for name, path in entries]
    monkeypatch.setattr(fi_gateway.kinds, "entry_points", lambda group: found if group == "shapes.group" else [])
    return Kinds("shape", "shapes.group", Shape, (Circle,))


def test_installed_words_come_after_the_built_in_ones(monkeypatch: pytest.MonkeyPatch, elsewhere: str) -> None:
    """And are found by their name."""
    kinds = installed(monkeypatch, ("square", f"{elsewhere}:Square"))
    assert kinds.words() == ["circle", "square"]
    assert kinds.find("square") is Square


def test_nothing_is_imported_before_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A broken package that is installed does not hurt who does not use it."""
    kinds = installed(monkeypatch, ("broken", "no.such.package:Square"))
    assert kinds.words() == ["circle", "broken"]
    assert kinds.find("circle") is Circle
    with pytest.raises(ValueError, match=r"cannot import 'no\.such\.package'"):
        kinds.find("broken")


def test_a_built_in_word_cannot_be_taken(monkeypatch: pytest.MonkeyPatch, elsewhere: str) -> None:
    """A file means the same everywhere."""
    kinds = installed(monkeypatch, ("circle", f"{elsewhere}:Square"))
    assert kinds.words() == ["circle"]
    assert kinds.find("circle") is Circle


def test_a_word_of_two_packages_is_refused(monkeypatch: pytest.MonkeyPatch, elsewhere: str) -> None:
    """Neither is guessed; both paths are named."""
    kinds = installed(monkeypatch, ("square", f"{elsewhere}:Square"), ("square", f"{elsewhere}:Stranger"))
    with pytest.raises(ValueError, match=r"'square'; give one of elsewhere_shapes\.Square, elsewhere_shapes\.Str"):
        kinds.find("square")


def test_the_json_schema_has_what_is_built_in_and_installed(monkeypatch: pytest.MonkeyPatch, elsewhere: str) -> None:
    """Editors know installed types; each type has its own word, so that one alternative fits."""
    kinds = installed(monkeypatch, ("square", f"{elsewhere}:Square"))

    @dataclass(frozen=True, slots=True)
    class File(SpecModel):
        shape: Annotated[Shape, kinds]

    schema = json_schema(File)
    text = str(schema)
    assert text.count("'const': 'circle'") == text.count("'const': 'square'") == 1
