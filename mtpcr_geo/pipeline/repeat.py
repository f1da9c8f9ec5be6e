"""Run a registration again from its record, and compare: whether the result is reproduced."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import InputError, RegistrationError
from mtpcr_geo.core.paths import read_whole, short
from mtpcr_geo.core.progress import Progress
from mtpcr_geo.core.system import sha256, versions
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.export.prior_file import matrix_of
from mtpcr_geo.export.run_json import plain
from mtpcr_geo.pipeline import grammar
from mtpcr_geo.pipeline.options import OUTPUT_NAMES
from mtpcr_geo.pipeline.plan import plan
from mtpcr_geo.pipeline.runner import RunResult, Settings, execute
from mtpcr_geo.pipeline.stages.memory import MemoryReader

Kind = Literal["input", "option", "version", "file", "verdict", "transform", "metric"]
SAME_WITHIN = 0.001
"""Farthest that a corner of the source may come to lie elsewhere, in units of the result, to be the same."""
_METRIC_SHARE = 1e-3
_WRITERS = ("writers.", "mtpcr.write")
_STATED = {
    "name": "verdict", "sentence": "sentence", "probability": "probability", "reasons": "reasons",
    "rivals": "rivals",
}  # fmt: skip
"""What a transform.json says of the verdict, and where run.json says it."""


@dataclass(frozen=True)
class Difference:
    """Something that is not as it was recorded.

    Attributes:
        kind: what it is of.
        name: such as the file, "stage.option" or the library.
        recorded, found: how it was, and how it is now.
        decides: whether the result then counts as not reproduced.

    """

    kind: Kind
    name: str
    recorded: str
    found: str
    decides: bool = True

    def __str__(self) -> str:
        return f"{self.kind} {self.name}: recorded {self.recorded}, now {self.found}"


@dataclass(frozen=True)
class Repeat:
    """What a second run came to.

    Attributes:
        differences: all that is not as recorded, in the order in which it was looked at.
        ran: whether the registration was run again; it is not where an input has changed.
        identical: whether verdict, transform and metrics are the same bit for bit.
        moved: farthest that a corner of the source's bounds lies from where the recorded transform puts it,
            in units of the result; None without two transforms.

    """

    differences: tuple[Difference, ...]
    ran: bool
    identical: bool = False
    moved: float | None = None

    @property
    def reproduced(self) -> bool:
        """Whether the result is the same, and was made from the same inputs and options."""
        return self.ran and not any(one.decides for one in self.differences)


def repeat(
    folder: str | os.PathLike[str],
    *,
    allow_code: bool = False,
    allow_network: bool = False,
    progress: Progress | None = None,
) -> Repeat:
    """Run a registration again from its ``run.json``, write nothing, and compare.

    Inputs are found by their names as recorded, relative to the current folder or to a folder above the
    run's; they are compared by hash, options by value, libraries by version. What the recording and
    ``transform.json`` beside it say must be the same too.

    Args:
        folder: the folder that a run left.
        allow_code, allow_network: let PDAL stages run code, or reach beyond this machine.
        progress: where long work reports.

    Raises:
        InputError: if the folder holds no record of a run, or an input is gone.
        MtpcrError: whatever stops the second run.

    """
    place = Path(folder)
    record = _read(place)
    base = _base(record, place)
    found = [*_inputs(record, base), *_files(record, place), *_versions(record)]
    elements = _without_writers(record["pipeline"], place)
    specs = grammar.link(grammar.parse(json.dumps(elements)))
    settings = Settings(allow_code=allow_code, allow_network=allow_network)
    with contextlib.chdir(base):
        nodes = plan(specs, allow_code=allow_code, allow_network=allow_network)
        now = {node.tag: node.stage.options.model_dump(mode="json") for node in nodes}
        found += _options(record["options"], now)
        if any(one.kind == "input" for one in found):
            return Repeat(tuple(found), ran=False)
        result = _run(specs, settings, progress)
    return _compared(record, result, found)


def _run(
    specs: Sequence[grammar.StageSpec], settings: Settings, progress: Progress | None
) -> RunResult | None:
    """Run it; None where there is nothing to go on with."""
    try:
        return execute(specs, settings, progress)
    except RegistrationError:
        return None


def _read(place: Path) -> dict[str, Any]:
    path = place / OUTPUT_NAMES["run"]
    try:
        record = json.loads(read_whole(path))
    except OSError as error:
        raise InputError(
            f"cannot read {short(path)}: {error.strerror}; name the folder that a registration left"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{short(path)} is no JSON ({error})") from error
    wanted = {"pipeline": list, "options": dict, "inputs": list, "versions": dict, "metrics": dict}
    if not isinstance(record, dict) or any(
        not isinstance(record.get(key), kind) for key, kind in wanted.items()
    ):
        raise InputError(f"{short(path)} is no record of a run that this program wrote")
    for one in record["pipeline"]:
        if not (
            isinstance(one, dict) and isinstance(one.get("type"), str) and isinstance(one.get("tag"), str)
        ):
            raise InputError(f"{short(path)}: the pipeline recorded holds something that is no stage")
        if not isinstance(one.get("inputs", []), str | list):
            raise InputError(f"{short(path)}: the inputs of a stage recorded are no tags")
    if any(one["type"] == MemoryReader.type for one in record["pipeline"]):
        raise InputError(
            f"{short(path)}: a cloud of this run was in memory, not in a file, and is not there any more"
        )
    for one in record["inputs"]:
        if not (isinstance(one, dict) and isinstance(one.get("path"), str)):
            raise InputError(f"{short(path)}: an input recorded has no path")
    if not all(isinstance(one, dict) for one in record["options"].values()):
        raise InputError(f"{short(path)}: the options recorded of a stage are none")
    if record.get("T_target_source") is not None:
        T = matrix_of(record["T_target_source"], f"the transform recorded in {short(path)}")
        record["T_target_source"] = T.tolist()
    return record


def _base(record: Mapping[str, Any], place: Path) -> Path:
    """Return the folder from which the inputs' names are right: with the same content where there is one."""
    names = [Path(one["path"]) for one in record["inputs"]]
    bases = [Path.cwd(), *place.resolve().parents]
    there = [base for base in bases if all(os.path.isfile(base / name) for name in names)]
    if not there:
        missing = next((name for name in names if not os.path.isfile(name)), place)
        raise InputError(
            f"there is no file {short(missing)} any more, neither from here nor from a folder above "
            f"{short(place)}; go to the folder in which the run was made"
        )
    hashes = [one.get("sha256") for one in record["inputs"]]
    sizes = [one.get("bytes") for one in record["inputs"]]
    for base in there if len(there) > 1 else ():
        files = [base / name for name in names]
        if [file.stat().st_size for file in files] == sizes and [sha256(file) for file in files] == hashes:
            return base
    return there[0]


def _inputs(record: Mapping[str, Any], base: Path) -> Iterator[Difference]:
    for one in record["inputs"]:
        found = sha256(base / one["path"])
        if found != one.get("sha256"):
            yield Difference("input", one["path"], f"sha256 {one.get('sha256')}", f"sha256 {found}")


def _versions(record: Mapping[str, Any]) -> Iterator[Difference]:
    now = versions()
    for name, version in record["versions"].items():
        if now.get(name) != version:
            yield Difference("version", name, str(version), now.get(name, "not installed"), decides=False)


def _files(record: Mapping[str, Any], place: Path) -> Iterator[Difference]:
    """Compare what other files of the run say with its run.json."""
    transform = place / OUTPUT_NAMES["transform"]
    if transform.is_file():
        from mtpcr_geo.export.transform import read_transform, verdict_of

        kept, T = read_transform(transform).T_file, record.get("T_target_source")
        if T is None or not np.array_equal(kept, np.array(T, np.float64)):
            yield Difference("file", transform.name, "the transform of run.json", "another transform")
        stated = verdict_of(transform)
        if stated is not None and any(
            name in stated and stated[name] != record.get(key) for name, key in _STATED.items()
        ):
            yield Difference("file", transform.name, "the verdict of run.json", "another verdict")
    recording = place / OUTPUT_NAMES["recording"]
    if recording.is_file():
        from mtpcr_geo.export.recording.trail import read_trail

        trail = read_trail(recording)
        for key in ("pipeline", "inputs", "versions", "verdict", "metrics", "T_target_source"):
            if trail.get(key) != record.get(key):
                yield Difference(
                    "file", recording.name, f"{key} as in run.json", f"another {key}: one of both was changed"
                )
        recorded = {one["tag"]: one["options"] for one in trail["stages"]}
        for one in _options({tag: record["options"].get(tag, {}) for tag in recorded}, recorded):
            yield Difference("option", one.name, one.recorded, f"{one.found} in {recording.name}")


def _options(recorded: Mapping[str, Any], now: Mapping[str, Mapping[str, Any]]) -> Iterator[Difference]:
    """Compare the options of the stages that run again."""
    for tag, options in now.items():
        before = recorded.get(tag, {})
        for name in dict.fromkeys([*before, *options]):
            was, value = before.get(name, "not an option"), plain(options.get(name, "not an option"))
            if was != value:
                yield Difference("option", f"{tag}.{name}", json.dumps(was), json.dumps(value))


def _without_writers(stages: Sequence[Mapping[str, Any]], place: Path) -> list[dict[str, Any]]:
    """Return the stages that the result needs, from readers to verdict; what writes files is passed by."""
    behind: dict[str, list[str]] = {}
    kept: dict[str, dict[str, Any]] = {}
    last: list[str] | None = None
    for stage in stages:
        given = stage.get("inputs", [])
        names = [given] if isinstance(given, str) else list(given)
        inputs = [tag for name in names for tag in behind.get(str(name), [str(name)])]
        tag = stage["tag"]
        if stage["type"].startswith(_WRITERS):
            behind[tag] = inputs
            if stage["type"] == "mtpcr.write_run":
                last = inputs
        else:
            behind[tag] = [tag]
            kept[tag] = {**stage, **({"inputs": inputs} if inputs else {})}
    if last is None:
        raise InputError(f"{short(place)}: the pipeline recorded writes no run.json to compare")
    needed: set[str] = set()
    left = list(last)
    while left:
        tag = left.pop()
        if tag not in needed and tag in kept:
            needed.add(tag)
            left += kept[tag].get("inputs", [])
    return [stage for tag, stage in kept.items() if tag in needed]


def _compared(record: Mapping[str, Any], result: RunResult | None, found: Sequence[Difference]) -> Repeat:
    """Compare verdict, transform and metrics of both runs."""
    verdict = result.verdict if result is not None else None
    name = verdict.name if verdict is not None else "refused"
    metrics = plain(verdict.metrics) if verdict is not None else {}
    pair = result.pair if result is not None else None
    T = TransformChain.of(pair).T_file if pair is not None and pair.T_target_source is not None else None
    kept = record.get("T_target_source")
    before = None if kept is None else np.array(kept, np.float64)
    differences = list(found)
    if name != record.get("verdict"):
        differences.append(Difference("verdict", "verdict", str(record.get("verdict")), name))
    moved = None
    if (T is None) != (before is None):
        states = ["none" if one is None else "there" for one in (before, T)]
        differences.append(Difference("transform", "T_target_source", states[0], states[1]))
    elif T is not None and before is not None and pair is not None:
        cloud = pair.source.cloud
        moved = _moved(before, T, np.stack([cloud.minimum, cloud.maximum]))
        if not np.array_equal(T, before):
            text = f"a corner of the source {moved:.3g} away"
            differences.append(
                Difference("transform", "T_target_source", "4x4", text, decides=moved > SAME_WITHIN)
            )
    for key in dict.fromkeys([*record["metrics"], *metrics]):
        was, value = record["metrics"].get(key), metrics.get(key)
        if was != value:
            decides = not _near(was, value)
            differences.append(Difference("metric", key, json.dumps(was), json.dumps(value), decides))
    identical = not any(one.kind in ("verdict", "transform", "metric") for one in differences)
    return Repeat(tuple(differences), ran=True, identical=identical, moved=moved)


def _moved(T_before: Floats, T_now: Floats, bounds: Floats) -> float:
    """Return the farthest distance between the places of the corners of a box under two transforms."""
    corners = np.array(list(itertools.product(*bounds.T)))
    apart = transforms.apply(T_now, corners) - transforms.apply(T_before, corners)
    return float(np.linalg.norm(apart, axis=1).max())


def _near(was: Any, value: Any) -> bool:
    """Return whether two metrics are the same but for the last digits."""
    try:
        a, b = np.asarray(was, np.float64), np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return False
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=_METRIC_SHARE, atol=1e-6, equal_nan=True))
