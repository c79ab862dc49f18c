"""From a point of the grid to the scenario that is run there."""

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from fi_gateway.marked_yaml import Document, FileErrors, Mark, set_value
from testbench.campaign.file.axes import Axis
from testbench.campaign.records import Point
from testbench.errors import BenchError
from testbench.scenario import Scenario, scenario_in


@dataclass(frozen=True, slots=True)
class Settings:
    """Makes scenarios of points. base: the scenario's document, changes for every run included, never changed here.

    labels: (axis, value) -> where the value stands in the campaign file, for messages.
    """

    base: Document
    axes: Sequence[Axis]
    labels: dict[tuple[str, str], str] = field(default_factory=dict)

    def scenario(self, point: Point) -> Scenario:
        """The scenario of a point, seed as in the base; raises FileErrors, and BenchError for an unknown axis."""
        document = _copied(self.base)
        for name, text in point.parameters:
            place = self.labels.get((name, text), "")
            origin = f"{place}: axes.{name}: {text}" if place else f"axes.{name}: {text}"
            for key, value in self._settings(name, text):
                document.overrides += 1
                set_value(document, key, value, Mark(document.overrides, 0, origin))
        return scenario_in(document)

    def changes(self, point: Point) -> list[tuple[str, str]]:
        """(key of the scenario, value) of all that a point sets; raises BenchError, and KeyError for a case."""
        return [setting for name, text in point.parameters for setting in self._settings(name, text)]

    def _settings(self, name: str, text: str) -> Sequence[tuple[str, str]]:
        for axis in self.axes:
            if axis.name == name:
                return axis.settings(text)
        if "." in name:  # a search for combinations names the switches of injectors themselves
            return ((name, text),)
        raise BenchError(f"point with axis {name!r}: there are {', '.join(axis.name for axis in self.axes) or 'none'}")

    @property
    def injectors(self) -> tuple[str, ...]:
        """The injectors of the scenario."""
        data = self.base.data if isinstance(self.base.data, dict) else {}
        found = data.get("injectors")
        return tuple(found) if isinstance(found, dict) else ()


def checked(settings: Settings, points: Iterable[Point], most: int = 20) -> tuple[list[str], dict[Point, str]]:
    """(what is wrong, point -> resolved YAML with seed 0) of all points; no more are looked at after `most` complaints.

    Each complaint once. What hangs on several values together does not name them by itself, so the point is named.
    """
    messages: dict[str, str] = {}
    texts: dict[Point, str] = {}
    seen: dict[str, Point] = {}
    for point in points:
        try:
            text = replace(settings.scenario(point), seed=0).resolved_yaml()
        except FileErrors as error:
            for line in error.messages:
                axis, _, rest = line.partition(": axes.")[2].partition(": ")
                told = line if axis else f"{describe_point(point)}: {line}"
                messages.setdefault(f"{axis}{rest.partition(': ')[2]}" if axis else told, told)
            if len(messages) >= most:
                return [*messages.values(), "... and perhaps more: the points after these were not looked at"], {}
            continue
        first = seen.setdefault(text, point)
        if first is not point:
            told = f"points ({describe_point(first)}) and ({describe_point(point)}) are one scenario"
            messages.setdefault(told, f"{told}, and would count twice; take one out with filter")
        texts[point] = text
    return list(messages.values()), texts


def describe_point(point: Point) -> str:
    """ "duration = 0.05 s, stops = off"."""
    return ", ".join(f"{name} = {text}" for name, text in point.parameters) or "the only point"


def _copied(document: Document) -> Document:
    """A copy to set values in; marks are never changed and shared."""
    return Document(
        document.source,
        copy.deepcopy(document.data),
        dict(document.values),
        dict(document.keys),
        list(document.problems),
        set(document.broken),
        document.overrides,
    )
