"""The project as a whole: what the wheel holds, what may import what, what the lock file pins, what the recipes say."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES: list[str] = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]


def outside(directory: Path, *arguments: str, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Python run in `directory`, with `path` alone in front of the installed packages."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "COV"))}
    if path is not None:
        environment["PYTHONPATH"] = str(path)
    return subprocess.run(
        [sys.executable, *arguments], cwd=directory, env=environment, capture_output=True, text=True, check=False
    )


def source_files() -> set[str]:
    """Every file of the packages, relative to the checkout."""
    return {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("wheel")
    done = outside(directory, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(directory), str(ROOT))
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = directory.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory that holds nothing but the installed wheel."""
    target = tmp_path_factory.mktemp("installed")
    pip = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-compile", "--target", str(target)]
    done = outside(target, *pip, str(wheel))
    assert done.returncode == 0, done.stdout + done.stderr
    return target


@pytest.mark.long
def test_wheel_holds_every_file_of_the_packages_and_nothing_else(wheel: Path) -> None:
    """What works from the checkout works installed: modules, models, data and type markers are in the wheel."""
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == source_files()


def test_wheel_names_its_licence_and_carries_its_text(wheel: Path) -> None:
    """PEP 639: an SPDX expression in the metadata, the text beside it."""
    archive = zipfile.ZipFile(wheel)
    (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    assert "License-Expression: Apache-2.0" in archive.read(metadata).decode()
    licence = archive.read(metadata.replace("METADATA", "licenses/LICENSE"))
    assert licence == (ROOT / "LICENSE").read_bytes()
    assert b"Apache License" in licence


@pytest.mark.long
@pytest.mark.parametrize(
    ("package", "folder", "ending"), [("dbc", ".", ".eds"), ("dbc", ".", ".dbc"), ("hlc", "data", ".csv")]
)
def test_installed_data_is_found_as_a_package_resource(
    installed: Path, tmp_path: Path, package: str, folder: str, ending: str
) -> None:
    """No path into a checkout: data files are read through importlib.resources wherever the package lies."""
    code = (
        "import importlib.resources, sys\n"
        "package, folder, ending = sys.argv[1:]\n"
        "files = [f for f in (importlib.resources.files(package) / folder).iterdir() if f.name.endswith(ending)]\n"
        "assert files and all(f.read_bytes() for f in files), files\n"
        "print(importlib.resources.files(package))\n"
    )
    done = outside(tmp_path, "-c", code, package, folder, ending, path=installed)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()) == installed / package


def test_installed_program_shows_its_help(installed: Path, tmp_path: Path) -> None:
    """One program, exo-hil; it starts from any directory."""
    done = outside(tmp_path, "-m", "testbench.cli", "--help", path=installed)
    assert done.returncode == 0, done.stderr
    assert "run" in done.stdout


@pytest.mark.run
def test_installed_program_runs_a_scenario(installed: Path, tmp_path: Path) -> None:
    """Gait, models, EDS and DBC come from the wheel, and no module from the checkout."""
    shutil.copy(ROOT / "scenarios" / "knee_freeze_at.yaml", tmp_path)
    code = (
        "import sys\n"
        "from testbench.cli import main\n"
        "sys.argv = ['exo-hil', 'run', 'knee_freeze_at.yaml', '--set', 'motion.duration=0.5s', '--out', 'result']\n"
        "code = main()\n"
        f"ours = [module for name, module in sys.modules.items() if name.split('.')[0] in {PACKAGES}]\n"
        "print(*[module.__file__ for module in ours], sep='\\n')\n"
        "sys.exit(code)\n"
    )
    done = outside(tmp_path, "-P", "-c", code, path=installed)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "result" / "summary.json").exists()
    places = [line for line in done.stdout.splitlines() if line.endswith(".py")]
    assert len(places) > 50
    assert all(Path(place).is_relative_to(installed) for place in places)


def test_help_imports_no_heavy_package(tmp_path: Path) -> None:
    """Lazy imports: after --help, sys.modules has no numpy, mujoco, pydantic, can."""
    code = (
        "import json, sys\n"
        "from testbench.cli import main\n"
        "sys.argv = ['exo-hil', '--help']\n"
        "try:\n"
        "    code = main()\n"
        "except SystemExit as end:\n"
        "    code = end.code\n"
        "print(json.dumps([code or 0, sorted(sys.modules)]), file=sys.stderr)\n"
    )
    done = outside(tmp_path, "-c", code)
    assert done.returncode == 0, done.stderr
    status, modules = json.loads(done.stderr.splitlines()[-1])
    assert status == 0
    heavy = {"numpy", "mujoco", "pydantic", "can", "canopen", "cantools", "matplotlib", "pyarrow"}
    assert not heavy & set(modules)


def test_import_contracts_cover_every_package() -> None:
    """A package added to the wheel is held by the layering check as well, and every package is typed."""
    layers = {
        name.strip() for layer in PROJECT["tool"]["importlinter"]["contracts"][0]["layers"] for name in layer.split("|")
    }
    found = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert set(PACKAGES) == found == layers == set(PROJECT["tool"]["importlinter"]["root_packages"])
    for package in found - {"dbc"}:  # dbc holds data only
        assert (ROOT / package / "py.typed").exists()


@pytest.mark.parametrize(
    ("module", "statement"),
    [
        ("canopen_exo/nmt.py", "import fi_gateway"),
        ("hlc/node.py", "import joint_emulators"),
        ("joint_emulators/rack.py", "import hlc"),
        ("fi_gateway/gateway.py", "import testbench"),
        ("testbench/__init__.py", "import mujoco"),
        ("joint_emulators/rack.py", "import mujoco"),
        ("canopen_exo/bus/loop.py", "import time"),
        ("fi_gateway/gateway.py", "import threading"),
        ("hlc/node.py", "import random"),
    ],
)
def test_forbidden_import_breaks_a_contract(tmp_path: Path, module: str, statement: str) -> None:
    """design, "Rooms": dependencies run downwards, and the check that holds this does see a violation."""
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    broken = tmp_path / module
    broken.write_text(broken.read_text(encoding="utf-8") + f"\n{statement}\n", encoding="utf-8")
    command = "import sys; sys.path.insert(0, '.'); from importlinter.cli import lint_imports; sys.exit(lint_imports())"
    done = outside(tmp_path, "-c", command, path=tmp_path)
    importer, imported = module.removesuffix(".py").replace("/", ".").removesuffix(".__init__"), statement.split()[1]
    assert done.returncode == 1, done.stdout + done.stderr
    assert f"{importer} -> {imported}" in done.stdout


def locked() -> dict[str, list[str]]:
    """Name -> pinned versions (one for each marker) in the lock file."""
    pins: dict[str, list[str]] = {}
    for name, version in re.findall(r"^([\w.-]+)==([^\s;\\]+)", (ROOT / "requirements.lock").read_text(), re.MULTILINE):
        pins.setdefault(canonicalize_name(name), []).append(version)
    return pins


def test_lock_file_pins_every_dependency_within_its_range() -> None:
    """Set-up installs the lock file alone: nothing pyproject.toml asks for is missing from it or outside its range."""
    project = PROJECT["project"]
    wanted = [*PROJECT["build-system"]["requires"], *project["dependencies"]]
    for extra in project["optional-dependencies"].values():
        wanted += [text for text in extra if not text.startswith(project["name"])]
    pins = locked()
    for requirement in map(Requirement, wanted):
        versions = pins.get(canonicalize_name(requirement.name), [])
        assert versions, f"{requirement.name} is not pinned; run: make lock"
        for version in versions:
            assert requirement.specifier.contains(version), f"{requirement} is pinned to {version}; run: make lock"


def test_lock_file_has_a_hash_for_every_pin_and_no_address() -> None:
    """The same bytes from whichever registry a machine is set up to use."""
    text = (ROOT / "requirements.lock").read_text()
    assert "://" not in text
    blocks = re.split(r"\n(?=\S)", text.strip())
    assert len(blocks) == sum(len(versions) for versions in locked().values())
    for block in blocks:
        assert re.search(r"--hash=sha256:[0-9a-f]{64}$", block), block.splitlines()[0]


needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


@needs_make
def test_make_alone_lists_every_recipe_and_does_nothing() -> None:
    """`make` shows the recipes."""
    done = subprocess.run(["make", "--no-print-directory"], cwd=ROOT, capture_output=True, text=True, check=True)
    phony = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert phony is not None
    listed = re.findall(r"^make (\w+)  *\S", done.stdout, re.MULTILINE)
    assert sorted([*listed, "moved"]) == sorted(phony[1].split())  # `moved` is a condition, not a recipe
    assert len(done.stdout.splitlines()) == len(listed)


def test_ci_runs_the_test_recipe_itself() -> None:
    """CI runs the same recipe as a developer, nothing beside it."""
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    commands = [line for line in script.read_text().splitlines() if line and not line.startswith("#")]
    assert commands[-1] == "exec make test"
    assert len(commands) == 3  # strict mode, the checkout's root, the recipe
    assert "run: .ci/run" in (ROOT / ".github" / "workflows" / "ci.yml").read_text()


def test_every_core_module_is_compiled_or_says_why_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """The list of compiled modules is complete: a new module is added to it, or to the exceptions with its reason."""
    monkeypatch.syspath_prepend(str(ROOT))
    from benchmarks.compile_core import CORE, INTERPRETED

    core_packages = tuple(package for package in PACKAGES if package not in ("testbench", "dbc"))
    modules = {name for name in source_files() if name.endswith(".py") and name.startswith(core_packages)}
    excepted = {name for name in modules if any(Path(name).match(pattern) for pattern in INTERPRETED)}
    assert set(CORE) | excepted == modules
    assert not set(CORE) & excepted
    for pattern in INTERPRETED:
        assert any(Path(name).match(pattern) for name in modules), f"{pattern} matches no module"
