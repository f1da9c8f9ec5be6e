from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from typer.testing import CliRunner

import mtpcr_geo
from mtpcr_geo.cli.app import app

HEAVY = {
    "numpy",
    "laspy",
    "rasterio",
    "pyproj",
    "pydantic",
    "rich",
    "scipy",
    "cv2",
    "open3d",
    "rerun",
    "pdal",
}


def run(*arguments: object, stdin: bytes | None = None):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], input=stdin)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def one_line(result) -> str:
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    return lines[0]


def loaded_by(code: str) -> set[str]:
    """Return the modules that a fresh interpreter has loaded after some code."""
    code = f"import sys\ntry:\n    {code}\nfinally:\n    print('\\n' + ' '.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    return set(done.stdout.splitlines()[-1].split())


def calling(*arguments: str) -> str:
    return f"sys.argv = {['mtpcr-geo', *arguments]!r}; import mtpcr_geo.cli.app as c; c.main()"


@pytest.mark.parametrize("code", ["import mtpcr_geo", calling("--help"), calling("--version"), calling()])
def test_starting_loads_nothing_heavy(code):
    loaded = loaded_by(code)
    assert not HEAVY & loaded
    # nor any room but the command's own
    rooms = {name.split(".")[1] for name in loaded if name.startswith("mtpcr_geo.")}
    assert rooms <= {"cli", "core"}


@pytest.mark.parametrize("verb", ["register", "check", "apply", "pipeline", "models", "demo"])
def test_the_help_of_a_verb_loads_only_option_models(verb):
    loaded = loaded_by(calling(verb, "--help"))
    assert (HEAVY - {"pydantic"}) & loaded == set()
    rooms = {name.split(".")[1] for name in loaded if name.startswith("mtpcr_geo.")}
    assert rooms <= {"cli", "core", "pipeline"}
    assert not any(name.startswith("mtpcr_geo.benchmark") for name in loaded)


def test_threads_and_what_is_to_be_done_at_the_end_are_done_and_the_status_is_kept():
    code = """if True:
        import atexit, sys, threading
        from mtpcr_geo.cli.app import command
        def late():
            threading.main_thread().join()
            print("thread", flush=True)
            atexit.register(print, "at exit", end="")
        threading.Thread(target=late).start()
        sys.argv = ["mtpcr-geo", "check", "no-such-file.laz"]
        command()
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 5
    assert done.stdout.endswith("thread\nat exit")


def test_whoever_calls_main_ends_as_it_likes():
    code = """if True:
        import atexit, sys
        atexit.register(print, "done")
        from mtpcr_geo.cli.app import main
        try:
            main()
        except SystemExit:
            sys.exit(7)
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (7, "done\n")


@pytest.mark.skipif(os.name != "posix", reason="closes standard output as a shell does")
def test_a_closed_standard_output_is_nothing_to_tell_of():
    command = f"{shlex.quote(sys.executable)} -m mtpcr_geo --version >&-"
    done = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no /dev/full")
def test_output_that_cannot_be_written_is_told():
    code = """if True:
        import os, sys
        from mtpcr_geo.cli.app import command
        sys.argv = ["mtpcr-geo", "--version"]
        command()
    """
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode != 0
    assert "No space left" in done.stderr


def test_help_names_every_verb():
    text = run("--help").stdout
    for verb in ("register", "check", "apply", "pipeline", "models", "demo", "benchmark"):
        assert f"  {verb} " in text


def test_without_arguments_the_help_is_shown_on_standard_error():
    result = run()
    assert (result.exit_code, result.stdout) == (2, "")
    assert "register" in result.stderr


def test_version():
    assert mtpcr_geo.__version__ in run("--version").stdout


def test_register_prints_verdict_and_files(town_files, tmp_path):
    source, target = town_files
    result = run("register", source, target, "-o", tmp_path / "out", "--no-recording")
    assert result.exit_code == 0
    assert "Accepted: " in result.stdout
    assert "registered.laz" in result.stdout
    assert result.stderr == ""
    assert not (tmp_path / "out" / "audit.rrd").exists()


def test_register_as_json_and_quiet(town_files, tmp_path):
    source, target = town_files
    result = run("register", source, target, "-o", tmp_path / "a", "--no-recording", "--json")
    assert json.loads(result.stdout)["verdict"] == "accepted"
    quiet = run("register", source, target, "-o", tmp_path / "b", "--no-recording", "--quiet")
    assert (quiet.exit_code, quiet.output) == (0, "")


@pytest.mark.slow
def test_dump_pipeline_runs_and_gives_the_same_bits(town_files, tmp_path):
    source, target = town_files
    dumped = run(
        "register", source, target, "-o", tmp_path / "b", "--no-recording", "--seed", 3, "--dump-pipeline"
    )
    assert not (tmp_path / "b").exists()
    first = run("register", source, target, "-o", tmp_path / "a", "--no-recording", "--seed", 3, "--quiet")
    second = run("pipeline", "-", "--quiet", stdin=dumped.stdout.encode())
    assert first.exit_code == second.exit_code == 0
    for name in ("registered.laz", "transform.cloudcompare.txt", "bev/target.tif"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.parametrize(("verdict", "code"), [("doubtful", 3), ("refused", 4)])
def test_exit_code_says_the_verdict(verdict, code, town_files, tmp_path, monkeypatch):
    from mtpcr_geo.core.types import Verdict

    monkeypatch.setattr(
        "mtpcr_geo.verdict.decision.assess", lambda *a, **k: Verdict(verdict, ("because",), {})
    )
    out = tmp_path / "out"
    result = run("register", *town_files, "-o", out, "--no-recording")
    assert result.exit_code == code
    assert f"{verdict.capitalize()}: " in result.stdout
    assert "because" in result.stdout
    assert (out / "registered.laz").exists() == (verdict == "doubtful")
    assert (out / "transform.json").exists() == (verdict == "doubtful")
    assert (out / "run.json").exists()
    forced = run("register", *town_files, "-o", out, "--no-recording", "--force", "--overwrite", "-q")
    assert (forced.exit_code, forced.stdout) == (code, "")
    assert one_line(forced) == f"mtpcr-geo: {verdict}: because"
    assert (out / "registered.laz").exists()


def test_register_says_no_to_bad_words(town_files, tmp_path):
    source, target = town_files
    out = tmp_path / "out"
    for words, code in (
        (["--cell", "-1"], 2),
        (["--cell", "nan"], 2),
        (["--profile", "fancy"], 2),
        (["--seed", "-4"], 2),
        (["--source-crs", "EPSG:0"], 6),
    ):
        result = run("register", source, target, "-o", out, *words)
        assert result.exit_code == code, words
        assert one_line(result).startswith("mtpcr-geo: error: ")
    assert not out.exists()


def test_register_does_not_replace_unasked(town_files, tmp_path):
    (tmp_path / "run.json").write_text("mine")
    result = run("register", *town_files, "-o", tmp_path, "--no-recording")
    assert result.exit_code == 7
    assert "--overwrite" in one_line(result)
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]
    assert (tmp_path / "run.json").read_text() == "mine"


def test_one_cloud_given_twice(town_files, tmp_path):
    result = run("register", town_files[0], town_files[0], "-o", tmp_path / "out")
    assert result.exit_code == 5
    assert "same" in one_line(result)
    assert not (tmp_path / "out").exists()


def test_interrupt_is_quiet_and_leaves_nothing(town_files, tmp_path, monkeypatch):
    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("mtpcr_geo.verdict.decision.assess", interrupt)
    result = run("register", *town_files, "-o", tmp_path / "out", "--no-recording")
    assert result.exit_code == 130
    assert "interrupted" in one_line(result)
    assert not (tmp_path / "out").exists()


def test_apply_there_and_back(town_files, tmp_path):
    source, target = town_files
    run("register", source, target, "-o", tmp_path, "--no-recording", "--quiet")
    assert run("apply", tmp_path / "transform.json", source, tmp_path / "there.laz").exit_code == 0
    back = run(
        "apply", tmp_path / "transform.json", tmp_path / "there.laz", tmp_path / "back.laz", "--inverse"
    )
    assert back.exit_code == 0
    before, after = laspy.read(source), laspy.read(tmp_path / "back.laz")
    np.testing.assert_allclose(np.asarray(after.xyz), np.asarray(before.xyz), atol=0.0021)


def test_pipeline_validates_without_running(town_files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = json.dumps([str(town_files[1]), "out/copy.laz"]).encode()
    result = run("pipeline", "-", "--validate", stdin=text)
    assert (result.exit_code, result.stdout) == (0, "the pipeline is valid\n")
    assert list(tmp_path.iterdir()) == []


def test_pipeline_writes_metadata_and_takes_overrides(town_files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("p.json").write_text(json.dumps([{"type": "readers.las", "filename": "x"}, "copy.laz"]))
    result = run(
        "pipeline", "p.json", f"--readers.las.filename={town_files[1]}", "--readers.las.count", 50,
        "--metadata", "m.json", "-v",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert len(laspy.read("copy.laz")) == 50
    metadata = json.loads(Path("m.json").read_text())
    assert metadata["metadata"]["readers.las"]["count"] == 50
    assert set(metadata["stages"]) == {"readers_las1", "writers_las1"}
    # results on standard output, talk on standard error; each file once
    assert result.stdout.count("copy.laz") == 1
    assert "readers_las1 (readers.las)" in result.stderr
    assert "readers.las" not in result.stdout


def test_the_pipeline_may_stand_behind_its_overrides(town_files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("p.json").write_text(json.dumps([{"type": "readers.las", "filename": "x"}, "copy.laz"]))
    before = f"--readers.las.filename={town_files[1]}"
    result = run("pipeline", before, "--readers.las.count", 20, "p.json", "-q")
    assert (result.exit_code, result.output) == (0, "")
    assert len(laspy.read("copy.laz")) == 20


def test_a_registering_pipeline_names_each_file_once(town_files, tmp_path):
    dumped = run("register", *town_files, "-o", tmp_path, "--no-recording", "--dump-pipeline").stdout
    result = run("pipeline", "-", stdin=dumped.encode())
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert lines[0].startswith("Accepted: ")
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert written
    for path in written:
        # names are compared whole, and a folder of rasters stands for what is in it
        named = {str(path), f"{path.parent}/"}
        assert sum(bool(named & set(line.split())) for line in lines) == 1, path


def test_colours_only_where_they_are_wanted(town_files, tmp_path, monkeypatch):
    words = ("register", *town_files, "--no-recording", "--overwrite", "-v", "-o", tmp_path)
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert "\x1b[1;32m" in run(*words).stdout
    monkeypatch.setenv("NO_COLOR", "1")
    plain = run(*words)
    assert "\x1b[1;32m" not in plain.stdout
    assert "Accepted:" in plain.stdout
    assert "mtpcr.match" in plain.stderr


def test_errors_show_no_control_characters(tmp_path):
    result = run("apply", tmp_path / "a\x1b[31mred.json", "a.laz", "b.laz")
    assert result.exit_code == 5
    assert "a\\x1b[31mred.json" in one_line(result)


def test_schema_is_a_schema_that_ready_pipelines_fit():
    from helpers_paths import REPOSITORY

    from mtpcr_geo.pipeline.grammar import parse

    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(run("pipeline", "--schema").stdout)
    validator = jsonschema.Draft202012Validator
    validator.check_schema(schema)
    for file in sorted((REPOSITORY / "pipelines").glob("*.json")):
        stages = [
            {"type": e.type, **({"tag": e.tag} if e.tag else {}), **e.options}
            for e in parse(file.read_bytes())
        ]
        validator(schema).validate(stages)
    wrong = [{"type": "mtpcr.bev", "cel": 1.0}]
    assert not validator(schema).is_valid(wrong)


def test_pipeline_without_a_file():
    assert "name a pipeline file" in one_line(run("pipeline"))
