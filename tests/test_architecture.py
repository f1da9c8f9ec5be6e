"""Who may import whom: checked on the package as it is, and on copies of its imports that are wrong."""

from __future__ import annotations

import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import pytest
from helpers_paths import REPOSITORY

PACKAGE = "mtpcr_geo"
MAX_LINES = 450
LINT = "from importlinter.cli import lint_imports_command; lint_imports_command()"

Imports = dict[str, set[str]]


@pytest.fixture(scope="module")
def imports() -> Imports:
    """Every module of the package and the modules it imports, for types only or not."""
    graph = grimp.build_graph(PACKAGE, cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    """Check the package in a folder against the contracts in pyproject.toml."""
    command = [sys.executable, "-c", LINT, "--no-cache", "--no-logo", str(REPOSITORY / "pyproject.toml")]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def write_skeleton(folder: Path, imports: Imports) -> None:
    """Write a package that has these modules and imports, and nothing else."""
    packages = {module.rpartition(".")[0] for module in imports}
    for module, imported in imports.items():
        path = folder.joinpath(*module.split("."))
        path = path / "__init__.py" if module in packages else path.with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"import {name}\n" for name in sorted(imported)), encoding="utf-8")


def test_contracts_hold() -> None:
    found = lint(REPOSITORY)
    assert found.returncode == 0, found.stdout + found.stderr


def test_no_circle_of_modules(imports: Imports) -> None:
    # packages count as modules, so that one which imports its own members' importers is found too
    TopologicalSorter(imports).prepare()


@pytest.mark.parametrize(
    ("importer", "imported", "contract"),
    [
        ("core.errors", "io.las", "Rooms import only rooms below them"),
        ("crs.facts", "method.icp", "Rooms import only rooms below them"),
        ("method.icp", "crs.facts", "Rooms import only rooms below them"),
        ("pipeline.grammar", "cli.app", "Rooms import only rooms below them"),
        ("cli.app", "benchmark.protocol", "Nothing imports the benchmark room"),
        ("__main__", "benchmark.protocol", "Nothing imports the benchmark room"),
    ],
)
def test_a_wrong_import_is_found(
    importer: str, imported: str, contract: str, imports: Imports, tmp_path: Path
) -> None:
    importer, imported = f"{PACKAGE}.{importer}", f"{PACKAGE}.{imported}"
    assert {importer, imported} <= set(imports)
    write_skeleton(tmp_path, imports | {importer: imports[importer] | {imported}})
    found = lint(tmp_path)
    assert found.returncode == 1, found.stdout + found.stderr
    assert f"{contract} BROKEN" in found.stdout
    assert f"{importer} -> {imported}" in found.stdout


@pytest.mark.parametrize("room", ["core", "method", "pipeline", "benchmark"])
def test_a_circle_inside_a_room_is_found(room: str, imports: Imports, tmp_path: Path) -> None:
    inside = f"{PACKAGE}.{room}."
    arrows = [(a, b) for a in imports for b in imports[a] if a.startswith(inside) and b.startswith(inside)]
    importer, imported = min(arrows)
    wrong = imports | {imported: imports[imported] | {importer}}
    with pytest.raises(CycleError):
        TopologicalSorter(wrong).prepare()
    write_skeleton(tmp_path, wrong)
    assert "No circles, between rooms or inside one BROKEN" in lint(tmp_path).stdout


def test_an_import_for_types_only_counts(imports: Imports, tmp_path: Path) -> None:
    write_skeleton(tmp_path, imports)
    path = tmp_path / PACKAGE / "core" / "errors.py"
    text = f"import typing\nif typing.TYPE_CHECKING:\n    import {PACKAGE}.io.las\n"
    path.write_text(text, encoding="utf-8")
    found = lint(tmp_path)
    assert found.returncode == 1
    assert f"{PACKAGE}.core.errors -> {PACKAGE}.io.las" in found.stdout


def test_a_circle_through_a_package_is_found(imports: Imports) -> None:
    package, member = f"{PACKAGE}.crs", f"{PACKAGE}.crs.chain"
    wrong = imports | {package: imports[package] | {member}, member: imports[member] | {package}}
    with pytest.raises(CycleError):
        TopologicalSorter(wrong).prepare()


def test_the_copy_of_the_imports_is_right_without_a_wrong_one(imports: Imports, tmp_path: Path) -> None:
    write_skeleton(tmp_path, imports)
    found = lint(tmp_path)
    assert found.returncode == 0, found.stdout + found.stderr


def test_modules_are_short() -> None:
    lengths = {
        path.relative_to(REPOSITORY).as_posix(): len(path.read_text(encoding="utf-8").splitlines())
        for path in sorted((REPOSITORY / PACKAGE).rglob("*.py"))
    }
    assert {path: length for path, length in lengths.items() if length > MAX_LINES} == {}
