"""The plugin for QGIS, without QGIS: the zip, the parameters, and how it calls the command."""

from __future__ import annotations

import ast
import configparser
import json
import sys
import zipfile
from pathlib import Path

import pytest
from pydantic import BaseModel
from typer.testing import CliRunner

from mtpcr_geo.cli import qgis_plugin
from mtpcr_geo.cli.app import app, load
from mtpcr_geo.cli.options import ApplyVerb, CheckVerb, RegisterVerb
from mtpcr_geo.core.version import __version__
from mtpcr_geo.export.qgis.plugin import command

MODELS: dict[str, type[BaseModel]] = {"register": RegisterVerb, "apply": ApplyVerb, "check": CheckVerb}
KINDS = {"switch", "choice", "number", "integer", "point", "file", "folder", "out_file", "out_folder", "text"}


@pytest.fixture
def plugin(tmp_path) -> zipfile.ZipFile:
    done = CliRunner().invoke(app, ["qgis-plugin", "-o", str(tmp_path / "p.zip")])
    assert done.exit_code == 0, done.output
    assert f"wrote {tmp_path / 'p.zip'}" in done.output.replace("\n", "")
    return zipfile.ZipFile(tmp_path / "p.zip")


def test_the_zip_is_a_plugin(plugin):
    names = plugin.namelist()
    assert {name.split("/")[0] for name in names} == {"mtpcr_geo_qgis"}
    metadata = configparser.ConfigParser()
    metadata.read_string(plugin.read("mtpcr_geo_qgis/metadata.txt").decode())
    general = metadata["general"]
    assert general["version"] == __version__
    assert general["qgisMinimumVersion"] == "3.22"
    assert general["hasProcessingProvider"] == "yes"
    assert f"mtpcr_geo_qgis/{general['icon']}" in names
    for name in names:
        if name.endswith(".py"):
            # QGIS 3.22 for Windows has Python 3.9
            ast.parse(plugin.read(name), feature_version=(3, 9))
    assert "def classFactory(" in plugin.read("mtpcr_geo_qgis/__init__.py").decode()


def test_an_existing_zip_stays(tmp_path):
    (tmp_path / "p.zip").write_text("mine")
    words = ["qgis-plugin", "-o", str(tmp_path / "p.zip")]
    assert CliRunner().invoke(app, words).exit_code == 7
    assert (tmp_path / "p.zip").read_text() == "mine"
    assert CliRunner().invoke(app, [*words, "--overwrite", "-q"]).exit_code == 0
    assert zipfile.is_zipfile(tmp_path / "p.zip")


@pytest.mark.parametrize("verb", MODELS)
def test_parameters_are_those_of_the_verb(plugin, verb):
    declared = json.loads(plugin.read("mtpcr_geo_qgis/verbs.json"))[verb]
    assert declared["help"].startswith(load(verb).help.partition("\n")[0].partition(";")[0][:20])
    known = {name for one in load(verb).params for name in one.opts}
    required = []
    for one in declared["parameters"]:
        field = MODELS[verb].model_fields[one["name"]]
        assert one["flag"] is None or one["flag"] in known
        assert one["kind"] in KINDS
        assert one["label"]
        assert field.is_required() == one["required"]
        if one["kind"] == "choice":
            assert one["choices"]
            assert one["default"] is None or one["default"] in one["choices"]
        required += [one["name"]] * one["required"]
    assert set(required) == {name for name, field in MODELS[verb].model_fields.items() if field.is_required()}


def test_a_call_is_written_so_that_the_command_reads_it_back():
    parameters = qgis_plugin.verbs()["register"]["parameters"]
    defaults = {one["name"]: one["default"] for one in parameters}
    values = {**defaults, "source": "-a b.laz", "target": "t.laz", "out": "o", "force": True, "res": False}
    values |= {"yaw": -12.5, "cell": 0.5, "near": ["-3.5", "4"], "matcher": "", "motion": "yaw", "seed": 0}
    words = command.arguments(parameters, values)
    assert words[-3:] == ["--", "-a b.laz", "t.laz"]
    assert "--no-res" in words
    assert "--force" in words
    assert "--yaw=-12.5" in words
    assert not any(word.startswith(("--seed", "--matcher", "--no-focus")) for word in words)
    context = load("register").make_context("register", words)
    assert context.params["near"] == ("-3.5", "4")
    assert (str(context.params["source"]), str(context.params["out"])) == ("-a b.laz", "o")
    assert context.params["motion"] == "yaw"


def test_where_the_command_is_looked_for(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    monkeypatch.delenv(command.SETTING, raising=False)
    with pytest.raises(command.CommandError, match="not installed, or not found"):
        command.find()
    program = tmp_path / "program"
    program.write_text("")
    assert command.find(str(program)) == str(program)
    monkeypatch.setenv(command.SETTING, str(program))
    assert command.find() == str(program)
    monkeypatch.setenv(command.SETTING, str(tmp_path / "gone"))
    with pytest.raises(command.CommandError, match="no such file"):
        command.find()


def test_output_errors_and_stops_come_back():
    code = "import sys; print('{\"a\": 1}'); print('talk', file=sys.stderr); sys.exit(3)"
    answer = command.run([sys.executable, "-c", code])
    assert (answer.code, answer.json(), answer.talk.strip()) == (3, {"a": 1}, "talk")
    failed = command.run([sys.executable, "-c", "import sys; print('why', file=sys.stderr); sys.exit(5)"])
    with pytest.raises(command.CommandError, match=r"^why$"):
        failed.json()
    with pytest.raises(command.CommandError, match="cannot start"):
        command.run([str(Path("no") / "such" / "program")])
    with pytest.raises(command.CommandError, match="stopped"):
        command.run([sys.executable, "-c", "while True: pass"], lambda: True)


def test_the_commands_python_is_not_that_of_qgis(monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONHOME", sys.prefix)
    monkeypatch.setenv("PYTHONPATH", f"{sys.prefix}/lib{':' if sys.platform != 'win32' else ';'}{tmp_path}")
    own = command.environment()
    assert "PYTHONHOME" not in own
    assert own["PYTHONPATH"] == str(tmp_path)
