from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from helpers_survey import tiles_of, town_source, town_target, write_tile
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app


def run(*arguments: object):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.slow
def test_a_survey_is_built_and_registered_against(tmp_path: Path) -> None:
    tiles = tiles_of(tmp_path / "tiles", town_target())
    built = run("survey", "build", *tiles[:2], tmp_path / "tiles", "-o", tmp_path / "survey", "--workers", 1)
    assert built.exit_code == 0, built.stderr
    assert "4 tiles" in built.stdout
    scan = write_tile(tmp_path / "scan.laz", town_source()[0], None)
    done = run(
        "register",
        scan,
        tmp_path / "survey",
        "-o",
        tmp_path / "out",
        "--source-crs",
        "local",
        "--no-recording",
    )
    assert done.exit_code == 0, done.stdout + done.stderr
    assert (tmp_path / "out" / "registered.laz").is_file()
    again = run("register", scan, tmp_path / "survey", "-o", tmp_path / "out", "--source-crs", "local")
    assert again.exit_code == 7
    dump = run("register", scan, tmp_path / "survey", "-o", tmp_path / "out", "--dump-pipeline")
    assert dump.exit_code == 2


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("build",), "name the tiles"),
        (("build", "a.laz", "--cel", "1"), "no option '--cel'"),
        (("make", "a.laz"), "build"),
    ],
)
def test_a_wrong_command_line_is_refused(arguments: tuple[str, ...], says: str, tmp_path: Path) -> None:
    result = run("survey", *arguments, "-o", tmp_path / "survey")
    assert result.exit_code == 2, result.stderr
    assert says in result.stderr
    assert not (tmp_path / "survey").exists()


def test_a_tile_that_failed_is_said(tmp_path: Path) -> None:
    tiles = tiles_of(tmp_path / "tiles", town_target(points=5000))
    tiles[1].write_bytes(tiles[1].read_bytes()[:3000])
    result = run("survey", "build", tmp_path / "tiles", "-o", tmp_path / "survey", "--workers", 1)
    assert result.exit_code == 5
    assert "tile1.laz" in result.stderr
    assert "1 tile could not be used" in result.stderr


def test_a_tile_that_is_gone_is_said(tmp_path: Path) -> None:
    tiles = tiles_of(tmp_path / "tiles", town_target(points=5000))
    arguments = ("survey", "build", tmp_path / "tiles", "-o", tmp_path / "survey", "--workers", 1)
    assert run(*arguments).exit_code == 0
    tiles[1].unlink()
    again = run(*arguments)
    assert again.exit_code == 0
    assert "1 tile no longer to be found" in again.stderr
    assert "tile1.laz" in again.stderr
    assert "--prune" in again.stderr
    pruned = run(*arguments, "--prune")
    assert (pruned.exit_code, pruned.stderr) == (0, "")
    assert "3 tiles" in pruned.stdout


def test_dask_is_imported_only_where_it_is_used() -> None:
    code = (
        "import sys; import mtpcr_geo.cli.survey, mtpcr_geo.cli.batch, mtpcr_geo.survey.batch; "
        "print([m for m in ('dask', 'distributed') if m in sys.modules])"
    )
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert made.stdout.strip() == "[]"


@pytest.mark.skipif(find_spec("distributed") is not None, reason="Dask is installed")
def test_without_dask_more_workers_are_an_error(tmp_path: Path) -> None:
    tiles = tiles_of(tmp_path / "tiles", town_target(points=5000))
    result = run("survey", "build", *tiles, "-o", tmp_path / "survey", "--workers", 2)
    assert result.exit_code == 8
    assert "mtpcr-geo[cluster]" in result.stderr
