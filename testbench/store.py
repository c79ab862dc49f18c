"""The result folder: written whole, or not at all.

Everything is written into a new folder beside the target (`.<name>.<writer>.part`), flushed to the disk, and put in
place by renaming. A previous result is moved aside first and removed last; anything else that stands there is left
alone and refused, a result of another scenario too. When writing fails or is interrupted, the half-written folder is
removed and the previous result is back. What a killed process left half-written is removed by the next one that writes
to the same place.
After a power cut between the two renames the previous result is left in `.<name>.<writer>.old`, whole.
"""

import json
import os
import platform
import re
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from canopen_exo.bus.trace import write_candump
from testbench.document import Summary
from testbench.errors import BenchError
from testbench.injections import INJECTIONS_FILE, write_injections
from testbench.record import Array, RunRecord
from testbench.summary import summary_json

Writer = Callable[[Path], None]
"""Writes one file at the path given."""

SCENARIO_FILE: Final = "scenario.yaml"
SUMMARY_FILE: Final = "summary.json"

FILES: Final = frozenset(
    {
        SCENARIO_FILE,
        SUMMARY_FILE,
        INJECTIONS_FILE,
        *("controller.log", "drive.log", "golden_controller.log", "golden_drive.log"),
        *("golden.parquet", "faulted.parquet", "golden_commands.parquet", "faulted_commands.parquet"),
        *("fault.png", "joints.png", "triggers.png"),
    }
)
"""What a result folder may hold; a folder with anything else in it is somebody's, and never replaced."""


def default_folder(name: str, seed: int, overrides: Sequence[str] = ()) -> Path:
    """`results/<name>-<seed>`, whatever letters the scenario's name has; overrides give a place of its own."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", name).lstrip(".")[:100] or "scenario"
    changes = f"-{zlib.crc32(' '.join(overrides).encode()):08x}" if overrides else ""
    return Path("results") / f"{plain}-{seed}{changes}"


def result_files(
    scenario_yaml: str, document: Summary, joints: tuple[str, ...], golden: RunRecord, faulted: RunRecord
) -> dict[str, Writer]:
    """File name -> writer for everything but the plots (testbench.report)."""
    text = summary_json(document)
    files: dict[str, Writer] = {
        SCENARIO_FILE: lambda path: _write_text(path, scenario_yaml),
        SUMMARY_FILE: lambda path: _write_text(path, text),
        INJECTIONS_FILE: lambda path: write_injections(
            path, [*faulted.activations, *faulted.activations_after], faulted.time0_ns
        ),
    }
    for name, run in (("golden", golden), ("faulted", faulted)):
        for index, bus in enumerate(run.buses):
            log = f"{bus.name}.log" if name == "faulted" else f"golden_{bus.name}.log"
            files[log] = _log_writer(run, index, bus.name)
        files[f"{name}.parquet"] = _truth_writer(joints, run)
        files[f"{name}_commands.parquet"] = _commands_writer(joints, run)
    return files


def check_folder(folder: Path, scenario: str = "") -> None:
    """Raise BenchError when a result cannot be put there; call it before the run, not after.

    Allowed: nothing there yet, an empty folder, or a previous result and nothing else, of the scenario of that name
    when one is given.
    """
    folder = _resolved(folder)
    try:
        if not folder.exists():
            for parent in folder.parents:
                if parent.exists():
                    _check_parent(folder, parent)
                    return
        if not folder.is_dir():
            raise BenchError(f"result folder {folder}: a file is there; give another place with --out")
        _check_parent(folder, folder.parent)
        names = sorted(entry.name for entry in folder.iterdir())
    except OSError as error:
        raise BenchError(f"result folder {folder}: {_reason(error)}; give another place with --out") from error
    if not names:
        return
    strange = [name for name in names if name not in FILES]
    if SUMMARY_FILE not in names or SCENARIO_FILE not in names or strange:
        found = strange[0] if strange else names[0]
        raise BenchError(
            f"result folder {folder}: it holds {found!r} and is not, or not only, a previous result; nothing was "
            "changed: move it away, or give another place with --out"
        )
    before = _scenario_in(folder / SUMMARY_FILE)
    if scenario and before not in ("", scenario):
        raise BenchError(
            f"result folder {folder}: it holds a result of the scenario {before!r}, not of {scenario!r}; nothing was "
            "changed: move it away, or give another place with --out"
        )


def _scenario_in(summary: Path) -> str:
    """Of which scenario a summary is; "" when it does not say."""
    try:
        document = json.loads(summary.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return ""
    found = document.get("scenario") if isinstance(document, dict) else None
    return found if isinstance(found, str) else ""


def write_result(folder: Path, files: Mapping[str, Writer]) -> Path:
    """Put the files into `folder`, whole or not at all; returns the folder as it was resolved.

    A previous result there is replaced. Raises BenchError when the place is refused or cannot be written.
    """
    unknown = sorted(set(files) - FILES)
    if unknown:
        raise BenchError(f"result folder {folder}: file {unknown[0]!r} given, allowed are {', '.join(sorted(FILES))}")
    check_folder(folder)
    folder = _resolved(folder)
    try:
        with _parents(folder.parent):
            _remove_left_over(folder)
            part = _beside(folder, "part")
            try:
                part.mkdir()
                for name, write in files.items():
                    write(part / name)
                    _flush(part / name)
                _flush_folder(part)
                _swap(part, folder)
            finally:
                shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise BenchError(
            f"result folder {folder}: cannot be written: {_reason(error)}; nothing was left there: make room, or "
            "give another place with --out"
        ) from error
    return folder


def _swap(part: Path, folder: Path) -> None:
    """Put `part` in the place of `folder`; whatever fails, what stood there stands there again."""
    aside = _beside(folder, "old")
    try:
        if folder.exists():
            aside.mkdir()
            folder.rename(aside / folder.name)
        part.rename(folder)
    finally:
        if not folder.exists() and (aside / folder.name).exists():
            (aside / folder.name).rename(folder)
        shutil.rmtree(aside, ignore_errors=True)
    _flush_folder(folder.parent)


@contextmanager
def _parents(parent: Path) -> Iterator[None]:
    """Make the folders above; take away again those that were made, when what follows fails."""
    made: list[Path] = []
    try:
        for above in [*reversed(parent.parents), parent]:
            if not above.exists():
                made.append(above)
                above.mkdir(exist_ok=True)
        yield
    except BaseException:
        for above in reversed(made):
            with suppress(OSError):  # somebody else's file came into it meanwhile
                above.rmdir()
        raise


def _beside(folder: Path, end: str) -> Path:
    """A new name beside `folder`, known before anything is made there; nobody else gets the same."""
    return folder.with_name(f".{folder.name}.{_machine()}-{os.getpid()}-{os.urandom(4).hex()}.{end}")


def _remove_left_over(folder: Path) -> None:
    """Remove what processes of this machine that are no more left half-written for this folder."""
    if os.name == "nt":  # there is no harmless way to ask for a process
        return
    written = re.compile(rf"\.{re.escape(folder.name)}\.{_machine()}-([0-9]{{1,9}})-[0-9a-f]{{8}}\.part", re.ASCII)
    with suppress(OSError):  # a folder one may write in and not read
        for entry in list(folder.parent.iterdir()):
            match = written.fullmatch(entry.name)
            if match is not None and not _is_alive(int(match[1])):
                shutil.rmtree(entry, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)  # asks only
    except PermissionError:  # alive, and somebody else's
        return True
    except (OSError, OverflowError):
        return False
    return True


def _machine() -> str:
    """This machine, in eight digits: on a shared disk, other machines write too."""
    return f"{zlib.crc32(platform.node().encode()):08x}"


def _resolved(folder: Path) -> Path:
    """The folder itself, whatever links lead to it: the link stays, what it names is replaced."""
    return Path(os.path.realpath(folder))


def _check_parent(folder: Path, parent: Path) -> None:
    if not parent.is_dir():
        raise BenchError(f"result folder {folder}: {parent} is a file; give another place with --out")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise BenchError(f"result folder {folder}: no permission to write in {parent}; give another place with --out")


def _reason(error: OSError) -> str:
    return error.strerror or str(error)


def _flush(path: Path) -> None:
    """Have the system put a file on the disk."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _flush_folder(path: Path) -> None:
    """Have the system put a folder's list of names on the disk, where it can (not on Windows)."""
    with suppress(OSError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")


def _log_writer(run: RunRecord, index: int, name: str) -> Writer:
    return lambda path: write_candump(path, run.rows, index, name)


def _truth_writer(joints: tuple[str, ...], run: RunRecord) -> Writer:
    truth = run.truth
    columns = (("q", "rad", truth.q), ("dq", "rad/s", truth.dq), ("tau", "N m", truth.tau))
    about = "plant truth at 1 kHz: joint angle, joint speed, joint torque after the gear"
    return lambda path: _write_parquet(path, joints, truth.t_s, columns, about)


def _commands_writer(joints: tuple[str, ...], run: RunRecord) -> Writer:
    said = run.commands
    reference = (("q_ref", "rad", said.q_ref), ("dq_ref", "rad/s", said.dq_ref)) if said.has_reference else ()
    columns = (*reference, ("tau_command", "N m", said.tau_command))
    about = "high-level controller at its rate: reference angle and speed, torque command before the clamp"
    return lambda path: _write_parquet(path, joints, said.t_s, columns, about)


def _write_parquet(
    path: Path, joints: tuple[str, ...], t_s: Array, columns: tuple[tuple[str, str, Array], ...], about: str
) -> None:
    """Columns time_s and <joint>.<quantity>, unit in each field's metadata. Imports pyarrow."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields, arrays = [pa.field("time_s", pa.float64(), False, {"unit": "s", "zero": "time 0"})], [pa.array(t_s)]
    for k, joint in enumerate(joints):
        for name, unit, values in columns:
            fields.append(pa.field(f"{joint}.{name}", pa.float64(), False, {"unit": unit}))
            arrays.append(pa.array(values[:, k]))
    table = pa.Table.from_arrays(arrays, schema=pa.schema(fields, {"about": about}))
    pq.write_table(table, path, compression="zstd")
