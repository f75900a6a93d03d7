"""What holds the house together: import arrow, start-up cost, sizes, pins, no machine named."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("datasets", "fusion", "frontend", "backend", "slam")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def pyproject() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def tracked_texts() -> Iterator[tuple[str, str]]:
    """(path from the root, text) of every text file that git knows."""
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listing.returncode != 0:
        pytest.skip("no git checkout, so no telling which files belong to it")
    for name in listing.stdout.decode().split("\0"):
        path = ROOT / name
        if name and path.is_file() and b"\0" not in (content := path.read_bytes()):
            yield name, content.decode("utf-8")


def imported_modules(path: Path) -> set[str]:
    """Top-level names of all modules that a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.partition(".")[0])
    return names


def test_the_imports_point_one_way() -> None:
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("library", "home"),
    [
        ("gtsam", "backend"),
        ("kiss_icp", "frontend"),
        ("open3d", "datasets"),
        ("rosbags", "datasets"),
    ],
)
def test_a_library_that_shapes_a_part_stays_in_it(library: str, home: str) -> None:
    users = [path for path in SOURCES if library in imported_modules(path)]
    assert [path for path in users if path.relative_to(ROOT).parts[0] != home] == []


def test_the_application_imports_only_what_a_run_installs() -> None:
    """evo is GPL-3: the tests may use it, the application may not. Nor any other tool of theirs."""
    test_only = {"evo", "hypothesis", "pytest", "packaging", "mypy"}
    assert [path for path in SOURCES if imported_modules(path) & test_only] == []


def test_the_dependencies_are_what_the_application_imports() -> None:
    used: set[str] = set().union(*map(imported_modules, SOURCES))
    foreign = used - set(sys.stdlib_module_names) - set(PACKAGES)
    homes = importlib.metadata.packages_distributions()
    imported = {canonicalize_name(home) for module in foreign for home in homes[module]}
    asked = {Requirement(line).name for line in pyproject()["project"]["dependencies"]}
    assert imported == asked


def test_help_starts_without_the_slow_libraries() -> None:
    pytest.importorskip("slam.cli", reason="the command line is not there yet")
    program = (
        "import sys\n"
        "from slam.cli import main\n"
        "sys.argv = ['slam', '--help']\n"
        "try:\n"
        "    main()\n"
        "except SystemExit as stop:\n"
        "    assert not stop.code, stop.code\n"
        "print('LOADED', *sorted({name.partition('.')[0] for name in sys.modules}))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    usage, _, loaded = done.stdout.partition("LOADED")
    assert "run" in usage
    slow = {"gtsam", "numba", "matplotlib", "open3d", "rosbags", "kiss_icp", "cv2", "scipy"}
    assert slow & set(loaded.split()) == set()


def test_files_stay_readable() -> None:
    lengths = {path.relative_to(ROOT): len(path.read_text().splitlines()) for path in SOURCES}
    assert {path: lines for path, lines in lengths.items() if lines > 350} == {}
    vague = re.compile(r"util|helper|manager|common|misc")
    assert [path for path in lengths if vague.search(path.name)] == []


def test_package_inits_are_nearly_empty() -> None:
    for path in SOURCES:
        if path.name == "__init__.py":
            statements = ast.parse(path.read_text(encoding="utf-8")).body
            assert len(statements) <= 2, f"{path} does more than name the package"


def test_kernels_are_compiled_once_and_keep_nan() -> None:
    """Numba's fastmath=True assumes that there is no NaN; ranges hold NaN and inf."""
    decorators = re.compile(r"^@(?:numba\.)?n?jit\b.*?(?=\ndef )", re.MULTILINE | re.DOTALL)
    for path in SOURCES:
        for decorator in decorators.findall(path.read_text(encoding="utf-8")):
            assert "cache=True" in decorator or "inline=" in decorator, f"{path}: {decorator}"
            assert "fastmath=True" not in decorator, f"{path}: {decorator}"


@pytest.mark.parametrize(
    ("what", "pattern"),
    [
        # Spelt so that this file does not find itself.
        ("a network address", r"\b[a-z][a-z+]*:/{2}[\w.-]+"),
        ("a path of one machine", r"(?<![\w.~\-])/(?:work|home|root|Users|opt|mnt)/\w+"),
    ],
)
def test_tracked_files_name_nothing_of_one_machine(what: str, pattern: str) -> None:
    found = [
        f"{name}: {match.group()}"
        for name, text in tracked_texts()
        for match in re.finditer(pattern, text)
    ]
    assert found == [], f"tracked files name {what}"


def test_the_version_is_the_installed_one() -> None:
    project = pyproject()["project"]
    assert project["version"] == importlib.metadata.version(project["name"])


def pins(name: str) -> dict[str, str]:
    """Versions by distribution of a lock file. Every line pins exactly one."""
    lines = [line.partition("#")[0].strip() for line in (ROOT / name).read_text().splitlines()]
    matches = [re.fullmatch(r"([a-z0-9-]+)==([0-9][\w.]*)", line) for line in lines if line]
    assert all(matches), f"{name} has a line that pins nothing"
    return {match[1]: match[2] for match in matches if match}


def test_the_locks_pin_what_the_project_asks_for() -> None:
    project = pyproject()["project"]
    run, develop = pins("requirements.lock"), pins("requirements-dev.lock")
    for requirement in map(Requirement, project["dependencies"]):
        assert requirement.specifier.contains(run[requirement.name]), requirement
    for requirement in map(Requirement, project["optional-dependencies"]["dev"]):
        assert requirement.specifier.contains(develop[requirement.name]), requirement
    # What the tests passed with is what a run gets.
    assert {name: develop.get(name) for name in run} == run
    assert "evo" not in run
