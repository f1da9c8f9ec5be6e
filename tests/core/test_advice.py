"""Errors spell options as the reader has them: keywords in Python, options of stages in a pipeline."""

from __future__ import annotations

import re
from typing import Any, Literal, get_args, get_origin

import pytest
from helpers_las import write_raw
from helpers_paths import REPOSITORY
from typer.testing import CliRunner

import mtpcr_geo as mg
from mtpcr_geo.cli.app import app
from mtpcr_geo.cli.options import ApplyVerb, CheckVerb, PipelineVerb, RegisterVerb
from mtpcr_geo.cli.parameters import shown_fields, spelling
from mtpcr_geo.core import advice
from mtpcr_geo.core.errors import CrsError, MtpcrError
from mtpcr_geo.pipeline import grammar
from mtpcr_geo.pipeline.advice import for_command, for_python

# the name of a keyword is that of the option, but for these
OTHER_NAMES = {"--json": "as_json", "--validate": "only_validate", "--schema": "print_schema"}
# switches that are no keyword anywhere
OF_THE_COMMAND = {"quiet", "verbose", "as_json", "dump_pipeline", "progress", "only_validate", "print_schema"}
ASIDE = {"cli", "benchmark"}
FILE = '[{"type": "readers.las", "tag": "a", "filename": "%s"}, {"type": "mtpcr.level", "tag": "up"}]'
UNTAGGED = '[{"type": "readers.las", "filename": "%s"}, {"type": "mtpcr.level"}]'


@pytest.mark.parametrize("model", [RegisterVerb, PipelineVerb, CheckVerb, ApplyVerb])
def test_an_option_of_the_command_is_a_keyword_by_its_name(model):
    for name, field in shown_fields(model).items():
        long = spelling(name, field)[0]
        if not long.startswith("--"):
            continue
        if field.annotation is bool and field.default is False and name not in OF_THE_COMMAND:
            assert name in advice.SWITCHES or long not in _named_in_messages(), name
        words = long[2:].replace("-", "_")
        assert OTHER_NAMES.get(long, words) in (name, f"no_{name}")


def _named_in_messages() -> set[str]:
    """Options that texts of the package name, its command aside."""
    package = REPOSITORY / "mtpcr_geo"
    files = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in ASIDE]
    return {name for path in files for name in re.findall(r"--[a-z]+(?:-[a-z]+)*", path.read_text("utf-8"))}


def choices(annotation: Any) -> list[str]:
    """The words between which an option is a choice."""
    if get_origin(annotation) is Literal:
        return [word for word in get_args(annotation) if isinstance(word, str)]
    return [word for part in get_args(getattr(annotation, "__value__", annotation)) for word in choices(part)]


@pytest.mark.parametrize("model", [RegisterVerb, CheckVerb])
def test_every_choice_of_an_option_is_its_value(model):
    found = 0
    for name, field in shown_fields(model).items():
        for word in choices(field.annotation):
            option = spelling(name, field)[0]
            assert advice.spelt(f"give {option} {word} or so", advice.as_keyword) == (
                f'give {name}="{word}" or so'
            )
            found += 1
    assert found > 20
    assert advice.spelt("within --within 5 m of --near", advice.as_keyword) == "within within=5 m of near"


@pytest.mark.parametrize(
    ("text", "python", "pipeline"),
    [
        (
            "give --source-crs EPSG:..., or --source-crs local (--local for both clouds) if",
            'give source_crs="EPSG:...", or source_crs="local" (local=True for both clouds) if',
            "give --level.source_crs=EPSG:..., or --level.source_crs=local (--level.local=true "
            "for both clouds) if",
        ),
        (
            "try --near 12.5 -3e2 --near-crs EPSG:4326.",
            'try near=[12.5, -3e2] near_crs="EPSG:4326".',
            "try --match.near=[12.5,-3e2] --match.near_crs=EPSG:4326.",
        ),
        ("name --source-crs and --target-crs", "name source_crs and target_crs",
         "name --level.source_crs and --level.target_crs"),
        ("--no-focus belongs to --profile paper", 'focus=False belongs to profile="paper"',
         "--no-focus belongs to --profile paper"),
        ("or give --overwrite", "or give overwrite=True", "or give --overwrite"),
        ("--near X Y, 3--4 and --level.cell=2 stay", "near=[X, Y], 3--4 and --level.cell=2 stay",
         "--match.near=[X,Y], 3--4 and --level.cell=2 stay"),
    ],
)  # fmt: skip
def test_spelt(text, python, pipeline):
    stages = grammar.parse(
        '[{"type": "mtpcr.level", "tag": "level"}, {"type": "mtpcr.match", "tag": "match"}]'
    )
    assert advice.spelt(text, advice.as_keyword) == python
    assert advice.spelt(text, for_command(stages)) == pipeline


@pytest.fixture
def nowhere(tmp_path) -> str:
    """A cloud without a CRS."""
    return str(write_raw(tmp_path / "nowhere.las", records=()))


def test_each_place_gets_its_own_advice(nowhere, town_files, tmp_path):
    done = CliRunner().invoke(app, ["register", nowhere, str(town_files[1]), "-o", str(tmp_path / "out")])
    assert (done.exit_code, "--source-crs local" in done.stderr) == (CrsError.exit_code, True)
    (tmp_path / "a.json").write_text(FILE % nowhere)
    done = CliRunner().invoke(app, ["pipeline", str(tmp_path / "a.json")])
    assert "--up.target_crs=local" in done.stderr
    (tmp_path / "a.json").write_text(UNTAGGED % nowhere)
    done = CliRunner().invoke(app, ["pipeline", "-i", str(tmp_path / "a.json"), "--validate"])
    assert "--mtpcr.level.target_crs=local" in done.stderr
    # the advice holds
    again = ["pipeline", "-i", str(tmp_path / "a.json"), "--mtpcr.level.target_crs=local", "--validate"]
    assert CliRunner().invoke(app, again).exit_code == 0
    with pytest.raises(CrsError, match='source_crs="local"') as error:
        mg.register(nowhere, town_files[1])
    assert "--" not in str(error.value)
    with pytest.raises(CrsError, match='"target_crs": "local" of up'):
        mg.Pipeline(FILE % nowhere).validate()


def test_findings_name_options_as_their_reader_does(nowhere, town_files):
    found = [f"{one.what}; {one.fix}" for one in mg.check(nowhere, town_files[1]).findings]
    assert any('source_crs="local"' in text for text in found)
    assert not [text for text in found if re.search(r"(?<![\w-])--[a-z]", text)]
    done = CliRunner().invoke(app, ["check", nowhere, str(town_files[1])])
    assert "--source-crs local" in " ".join(done.stdout.split())
    assert "source_crs" not in done.stdout
    # the functions that say so to Python were called before: nothing of that stays
    again = mg.check(nowhere, town_files[1]).findings
    assert [f"{one.what}; {one.fix}" for one in again] == found


def epsg_of(pipeline: mg.Pipeline) -> int | None:
    assert pipeline.pair is not None
    assert pipeline.pair.frame.crs is not None
    return pipeline.pair.frame.crs.to_epsg()


@pytest.mark.parametrize("option", ["override_srs", "default_srs"])
def test_a_reader_takes_another_crs_or_says_where_local_is_said(option, nowhere, town_files):
    stages = '[{"type": "readers.las", "filename": "%s", "%s": "%s"}, {"type": "mtpcr.level"}]'
    pipeline = mg.Pipeline(stages % (nowhere, option, "EPSG:32633"))
    pipeline.execute()
    assert epsg_of(pipeline) == 32633
    pipeline = mg.Pipeline(stages % (town_files[0], option, "EPSG:32633"))
    pipeline.execute()
    assert epsg_of(pipeline) == (32633 if option == "override_srs" else 25833)
    with pytest.raises(MtpcrError, match=r'"source_crs": "local" of mtpcr\.level'):
        mg.Pipeline(stages % (nowhere, option, "local")).validate()


def test_options_that_no_stage_has_stay_as_they_are():
    stages = grammar.parse('["a.laz", {"type": "mtpcr.bev"}]')
    assert advice.spelt("give --near-crs local", for_command(stages)) == "give --near-crs local"
    assert advice.spelt("give --allow-code", for_python(stages)) == "give allow_code=True"
