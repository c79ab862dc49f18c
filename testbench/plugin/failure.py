"""What a failed test's report says about its rig."""

from pathlib import Path

from fi_gateway.control import listing_text
from fi_gateway.errors import FaultError
from testbench.errors import BenchError
from testbench.plugin.exo import SHOWN, Exo
from testbench.plugin.observer import BUSES


def describe(rig: Exo, folder: Path | None) -> tuple[list[tuple[str, str]], list[Path]]:
    """Sections (title, text), and the paths of the candump logs written to `folder`."""
    sections = []
    for bus in BUSES:
        rows = rig.frames(bus, SHOWN)
        text = "\n".join(rig.text_of(row) for row in rows) or "no frame was on it"
        sections.append((f"exo-hil: last frames of the {bus} bus", text))
    logs: list[Path] = []
    try:
        if folder is None:
            raise OSError("no folder for temporary files")
        logs = rig.write_logs(folder)
        said = "\n".join(str(path) for path in logs)
    except OSError as error:
        said = f"cannot be written: {error}"
    sections.append(("exo-hil: candump logs", said))
    sections.append(("exo-hil: rig", _state(rig)))
    return sections, logs


def _state(rig: Exo) -> str:
    """The rig in a few lines."""
    lines = [
        f"scenario {rig.scenario.name} on {rig.bus}, {rig.time_s:.6f} s after power-up",
        f"master {rig.master.state.value}, controller {rig.controller.state.name.lower()}",
    ]
    if rig.master.failure:
        lines.append(rig.master.failure)
    for one in rig.controller.events[-SHOWN:]:
        lines.append(f"{one.time_ns / 1e9:12.6f} s  {one.joint or 'rig'}: {one.text}")
    try:
        rows = rig.gateway.listing()
        lines.append(listing_text(rows, rig.time_ns) if rows else "no faults")
    except (BenchError, FaultError) as error:
        lines.append(f"faults: {error}")
    return "\n".join([*lines, *([rig.timing] if rig.timing else [])])
