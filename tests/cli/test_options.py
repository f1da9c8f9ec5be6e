"""Options are declared once: help, command, stages and Python say the same."""

from __future__ import annotations

import re

import pytest
from pydantic import BaseModel
from typer.testing import CliRunner

from mtpcr_geo.cli import app as cli
from mtpcr_geo.cli import options as verbs
from mtpcr_geo.cli.parameters import help_of, shown_fields, spelling
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.pipeline.options import RegisterOptions
from mtpcr_geo.pipeline.registry import stage_types
from mtpcr_geo.pipeline.shown import GROUPS

MODELS: dict[str, type[BaseModel]] = {
    "register": verbs.RegisterVerb,
    "check": verbs.CheckVerb,
    "apply": verbs.ApplyVerb,
    "pipeline": verbs.PipelineVerb,
    "models": verbs.ModelsVerb,
    "demo": verbs.DemoVerb,
}
# every option the command had in release 0.1.0, but for the demonstration's seed
OF_OLD = {
    "register": "--out -o --source-crs --target-crs --local --level --cell --vertical --out-crs --prior "
    "--no-prior --prior-sigma --prior-yaw --motion --profile --matcher --models --no-res --no-focus "
    "--no-enhance --seed --overwrite --force --no-recording --dump-pipeline --json --verbose -v --quiet -q",
    "pipeline": "--validate --metadata --progress --schema --allow-code --allow-network --overwrite --json "
    "--verbose -v --quiet -q",
    "apply": "--inverse --overwrite --quiet -q",
    "check": "--source-crs --target-crs --local --vertical --json --quiet -q",
    "models": "--models --json",
    "demo": "--out -o --overwrite --quiet -q",
}
# the same option under another name in a stage
RENAMED = {("mtpcr.level", "method"): "level"}


def words_of(text: str) -> str:
    return " ".join(text.split())


def help_text(verb: str) -> str:
    result = CliRunner().invoke(cli.app, [verb, "--help"])
    assert result.exit_code == 0
    return result.stdout


@pytest.mark.parametrize("verb", MODELS)
def test_every_option_is_in_the_help_with_its_description(verb):
    text = words_of(help_text(verb))
    fields = shown_fields(MODELS[verb])
    for name, field in fields.items():
        assert field.description, name
        assert words_of(help_of(field)) in text, name
        assert all(spelt in text for spelt in spelling(name, field)), name
    # a field that is no parameter takes what is left of the command line
    assert set(MODELS[verb].model_fields) - set(fields) <= {"more"}


@pytest.mark.parametrize("verb", MODELS)
def test_no_option_but_those_of_the_model(verb):
    parameters = cli.load(verb).params
    spelt = {name for one in parameters if one.param_type_name == "option" for name in one.opts}
    fields = shown_fields(MODELS[verb])
    by_model = {name for key, field in fields.items() for name in spelling(key, field)}
    assert spelt == {name for name in by_model if name.startswith("-")}
    arguments = {one.name.upper() for one in parameters if one.param_type_name == "argument"}
    assert arguments == {name for name in by_model if not name.startswith("-")}


@pytest.mark.parametrize("verb", MODELS)
def test_every_option_of_old_is_there(verb):
    known = {name for one in cli.load(verb).params for name in one.opts}
    assert set(OF_OLD[verb].split()) <= known


def test_help_of_register_is_in_groups_and_ends_with_examples():
    text = help_text("register")
    groups = re.findall(r"^(\S.*):$", text, flags=re.MULTILINE)
    assert groups == ["Arguments", *GROUPS, "Options", "Examples"]
    assert text.rstrip().splitlines()[-1].strip().startswith("mtpcr-geo register ")


@pytest.mark.parametrize("verb", MODELS)
def test_every_verb_has_examples_that_name_it_and_options_it_has(verb):
    _, _, examples = help_text(verb).partition("\nExamples:\n")
    lines = [line.strip() for line in examples.strip().splitlines()]
    assert len(lines) >= 2
    known = {name for one in cli.load(verb).params for name in one.opts}
    for line in lines:
        assert re.search(rf"\bmtpcr-geo {verb}\b", line)
        if "|" not in line:
            named = {word.partition("=")[0] for word in line.split() if word.startswith("-")}
            assert {word for word in named if "." not in word} <= known, line


@pytest.mark.parametrize("verb", cli.VERBS)
def test_table_and_docstring_say_the_same(verb):
    command = cli.load(verb)
    assert words_of(command.help.partition("\n\n")[0]) == cli.VERBS[verb].help
    assert command.name == verb


def test_stages_and_register_agree():
    found = 0
    for kind, stage in stage_types().items():
        if kind == "mtpcr.register":  # takes all of them
            continue
        for name, field in stage.Options.model_fields.items():
            same = RegisterOptions.model_fields.get(RENAMED.get((kind, name), name))
            if same is None:
                continue
            found += 1
            assert field.description == same.description, (kind, name)
            assert field.default == same.default, (kind, name)
            assert field.annotation == same.annotation, (kind, name)
    assert found >= 18


@pytest.mark.parametrize("verb", ["check", "models"])
def test_verbs_share_the_options_of_register(verb):
    shared = set(MODELS[verb].model_fields) & set(RegisterOptions.model_fields)
    assert shared
    for name in shared:
        mine, whole = MODELS[verb].model_fields[name], RegisterOptions.model_fields[name]
        assert (mine.description, mine.default) == (whole.description, whole.default)


def test_the_command_gives_register_the_defaults_of_python(tmp_path, monkeypatch):
    given: dict[str, RegisterOptions] = {}

    def build(source, target, out, options):
        given["options"] = options
        return []

    monkeypatch.setattr("mtpcr_geo.registration.build_pipeline", build)
    result = CliRunner().invoke(cli.app, ["register", "a.laz", "b.laz", "-o", "out", "--dump-pipeline"])
    assert result.exit_code == 0, result.output
    assert given["options"] == RegisterOptions()


def test_every_option_reaches_register(monkeypatch):
    values = {
        "source_crs": "EPSG:2154", "target_crs": "EPSG:25832", "local": True,
        "source_unit": "mm", "target_unit": "us-ft", "source_axes": "y-up", "target_axes": "z-down",
        "level": "none", "cell": 0.75,
        "vertical": "estimate", "out_crs": "EPSG:25833", "prior": "none", "near": (4.5, -52.0),
        "near_crs": "EPSG:4326", "within": 40.0, "yaw": -30.0, "yaw_tolerance": 8.0,
        "motion": "yaw", "profile": "paper", "matcher": "orb", "models": "folder",
        "source_text": "x y z separator=; skip=2", "target_text": "x - y z", "scale": 0.01, "also": "ply",
        "res": False, "focus": False, "enhance": False, "seed": 4,
        "proposals": False, "recording": False, "recording_mb": 2.5,
        "force": True, "overwrite": True, "threads": 3,
    }  # fmt: skip
    # with a whole pose there is neither place nor yaw
    posed = {"prior": "georef", "prior_sigma": 7.5, "prior_yaw": 8.0}
    assert set(values) | set(posed) == set(RegisterOptions.model_fields)
    reaches_register(monkeypatch, values)
    reaches_register(monkeypatch, posed)


def reaches_register(monkeypatch, values):
    words = ["register", "a.laz", "b.laz", "--out", "out", "--dump-pipeline"]
    for name, field in RegisterOptions.model_fields.items():
        if name in values:
            parts = values[name] if isinstance(values[name], tuple) else (values[name],)
            words += [spelling(name, field)[0], *(str(one) for one in parts if not isinstance(one, bool))]
    given: dict[str, RegisterOptions] = {}
    monkeypatch.setattr(
        "mtpcr_geo.registration.build_pipeline", lambda *args: given.setdefault("o", args[-1]) and []
    )
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    assert given["o"] == RegisterOptions.model_validate(values)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("register a b -o x --resolution 1", "has no option '--resolution'; did you mean '--cell'?"),
        ("register a b --output x", "has no option '--output'; did you mean '--out'?"),
        ("register a b -o x --crs EPSG:2154", "did you mean '--source-crs' or '--target-crs'?"),
        ("register a b -o x --epsg 2154", "did you mean '--source-crs' or '--target-crs'?"),
        ("register a b -o x --force-overwrite", "did you mean '--overwrite'?"),
        ("register a b -o x --quite", "did you mean '--quiet'?"),
        ("register a b -o x --frobnicate", "no option '--frobnicate'; see mtpcr-geo register --help"),
        ("register a b", "missing option '--out'"),
        ("register a", "see mtpcr-geo register --help"),
        ("register a b c -o x", "see mtpcr-geo register --help"),
        ("register a b -o x --cell", "option '--cell' requires an argument"),
        ("register a b -o x --cell wide", "option --cell: input should be a valid number"),
        (
            "register a b -o x --level up",
            "option --level: input should be 'auto', 'ransac' or 'none', got 'up'",
        ),
        ("register a b -o x --prior-yaw 200", "option --prior-yaw: "),
        ("regster a b", "there is no verb 'regster'; did you mean 'register'?"),
        ("--frobnicate", "mtpcr-geo has no option '--frobnicate'"),
        ("pipeline --overwrit p.json", "pipeline has no option '--overwrit'; did you mean '--overwrite'?"),
        ("pipeline p.json --silent", "pipeline has no option '--silent'; did you mean '--quiet'?"),
        ("pipeline p.json q.json", "unexpected argument 'q.json'; the pipeline is p.json"),
        ("apply t.json a.laz b.laz --invert", "did you mean '--inverse'?"),
        ("benchmark --dta x -o y", "did you mean '--data'?"),
    ],
)
def test_a_wrong_command_line_is_one_line_and_exit_code_2(words, says):
    result = CliRunner().invoke(cli.app, words.split())
    assert isinstance(result.exception, SystemExit)
    assert result.exit_code == OptionError.exit_code
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("mtpcr-geo: error: ")
    assert says in line
