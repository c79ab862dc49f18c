"""Who starts whom, drawn in text: one tree for each injector or frame that starts a chain.

A branch is `-- signal --> started`; one that needs several sources (`all`) names the others, and one that has several
is drawn in full under the first and named under the others.
"""

from collections.abc import Mapping

from fi_gateway.trigger_specs import TriggerSpec


def draw_chains(triggers: Mapping[str, TriggerSpec]) -> list[str]:
    """Lines of text; triggers: by the injector that they start, without circles. [] for none."""
    lines: list[str] = []
    drawn: set[str] = set()
    roots = [name for trigger in triggers.values() for name in trigger.sources if name not in triggers]
    for name in dict.fromkeys(roots):
        lines.append(name)
        _draw(name, triggers, "  ", drawn, lines)
    for name, trigger in triggers.items():
        if trigger.frame is not None:
            lines.append(trigger.frame.words())
            lines.append(f"  `--{_label(trigger, '')}--> {name}")
            drawn.add(name)
            _draw(name, triggers, " " * 8, drawn, lines)
    return lines


def _draw(source: str, triggers: Mapping[str, TriggerSpec], indent: str, drawn: set[str], lines: list[str]) -> None:
    """Append what `source` starts."""
    started = [name for name, trigger in triggers.items() if source in trigger.sources]
    for number, name in enumerate(started):
        is_last = number == len(started) - 1
        head = f"{indent}{'`' if is_last else '|'}--{_label(triggers[name], source)}--> "
        if name in drawn:
            lines.append(f"{head}{name} (above)")
            continue
        lines.append(f"{head}{name}")
        drawn.add(name)
        _draw(name, triggers, f"{indent}{' ' if is_last else '|'}     ", drawn, lines)


def _label(trigger: TriggerSpec, source: str) -> str:
    """What is written on a branch."""
    parts = [] if trigger.frame is not None else [trigger.on + (", while it holds" if trigger.edge == "level" else "")]
    others = [name for name in trigger.all or () if name != source]
    if others:
        parts.append(f"with {', '.join(others)}")
    text = ", ".join(parts) + trigger.rest()
    return f" {text.removeprefix(', ')} " if text else ""
