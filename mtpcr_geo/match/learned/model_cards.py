"""Descriptions of learned models: small TOML files that say what a model's files are and how to feed them.

Some come with the package; a user adds others by putting ``NAME.toml`` beside the model files in the models
folder, and matches with ``--matcher NAME``. The package ships weights of its own, trained by
`mtpcr_geo.benchmark.train`, and nobody else's; a file of the same name in the models folder goes before them.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path, PurePath, PureWindowsPath
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from mtpcr_geo.core.errors import MissingPartError, OptionError
from mtpcr_geo.core.system import sha256
from mtpcr_geo.core.types import Look

VARIABLE = "MTPCR_GEO_MODELS"
_LONGEST, _MOST_DOTS = 20_000, 200
_LONGEST_NAME = 200


def _within(name: str) -> str:
    """Take the name of a file in the models folder; raise ValueError for one that leads elsewhere."""
    if not name.isprintable() or len(name.encode()) > _LONGEST_NAME or name != PurePath(name).name:
        raise ValueError(f"{name[:60]!r} is no plain name of a file in the models folder")
    if "\\" in name or PureWindowsPath(name).drive:
        raise ValueError(f"{name[:60]!r} is no plain name of a file in the models folder")
    return name


FileName = Annotated[str, AfterValidator(_within)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ExtractorFile(_Part):
    """A graph that finds keypoints in one image."""

    file: FileName = Field(description="ONNX file in the models folder")
    size_multiple: int = Field(32, ge=1, description="height and width are padded to multiples of this")
    score_threshold: float = Field(0.0, description="keypoints that score no more are padding, and dropped")
    descriptor_dim: int = Field(ge=1, description="length of a descriptor")
    max_keypoints: int = Field(4096, ge=1, description="keypoints kept of an image")
    tile: int = Field(1024, ge=64, description="edge of the tiles that larger images are cut into, pixels")
    magnify_to: int = Field(
        0, ge=0, description="images are magnified twice where they then stay within this edge; 0 for never"
    )
    sweep_to: int = Field(
        0,
        ge=0,
        description="orientations are compared on images shrunk by a whole factor to this edge, and the best "
        "is matched at full size; 0 for never",
    )
    candidates: int = Field(
        0,
        ge=0,
        le=100,
        description="partners of a keypoint, by descriptors of unit length, that vote for a pose; 0 for "
        "poses by consensus of the matches alone",
    )
    map_stride: int = Field(
        0,
        ge=0,
        le=64,
        description="the graph has an output map, (1, d, h / stride, w / stride) descriptors of unit length "
        "of all places, by which poses are proposed; 0 if it has none",
    )
    channels: Literal[1, 3] = Field(1, description="grey, or grey three times over")
    mean: float = Field(0.0, description="taken from grey / 255 before the graph sees it")
    std: float = Field(1.0, gt=0, description="by which the rest is divided")
    names: dict[str, str] = Field(
        {}, description="the graph's own names where they differ: image, max_keypoints, keypoints, scores, "
        "descriptors, map"
    )  # fmt: skip


class MatcherFile(_Part):
    """A graph that pairs the keypoints of two images."""

    file: FileName = Field(description="ONNX file in the models folder")
    score_threshold: float = Field(0.1, description="pairs that score no more are dropped")
    sweep_keypoints: int = Field(
        2048,
        ge=16,
        description="orientations are compared by so many of the best keypoints; attention takes time by "
        "their square. The best orientation is matched with all",
    )
    scale_px: float | None = Field(
        None,
        gt=0,
        description="places are given in pixels over this many; if not given, as LightGlue does: from the "
        "middle of the image, over half of its longer edge",
    )
    names: dict[str, str] = Field(
        {}, description="the graph's own names where they differ: kpts0, kpts1, desc0, desc1, matches, scores"
    )


class NearestFile(_Part):
    """Nearest neighbours, for models without a matching graph."""

    ratio: float = Field(1.0, gt=0, le=1, description="nearest over second nearest distance; 1 turns it off")
    cross_check: bool = Field(True, description="neighbours must be mutual")
    least: float = Field(0.0, ge=-1, le=1, description="least cosine similarity")


class FusedFile(_Part):
    """A graph that takes both images and gives pairs of keypoints."""

    file: FileName = Field(description="ONNX file in the models folder")
    size_multiple: int = Field(8, ge=1, description="height and width are padded to multiples of this")
    score_threshold: float = Field(0.1, description="pairs that score no more are dropped")
    tile: int = Field(1024, ge=64, description="longest edge fed; larger images are shrunk to it")
    channels: Literal[1, 3] = Field(1, description="grey, or grey three times over")
    mean: float = Field(0.0, description="taken from grey / 255 before the graph sees it")
    std: float = Field(1.0, gt=0, description="by which the rest is divided")
    names: dict[str, str] = Field(
        {}, description="the graph's own names where they differ: images, keypoints, matches, mscores"
    )


class Origin(_Part):
    """Where a model comes from and on what terms."""

    project: str = Field(description="the project where its authors publish it")
    licence: str = Field(description="of code and weights")
    terms: str | None = Field(None, description="what a user must know before using it")


class ModelDescription(_Part):
    """All there is to know about one learned matcher."""

    name: str
    title: str
    kind: Literal["keypoints", "fused"]
    any_yaw: bool = Field(False, description="finds its way at any angle, so that no sweep is needed")
    turns: int = Field(
        8,
        ge=1,
        le=72,
        description="orientations in which the source is tried, round the circle: as many as it takes for "
        "what it bears of rotation",
    )
    look: Look | None = Field(
        None,
        description="image that the weights were trained on, and that profiles show it; if not given, the "
        "profile's own",
    )
    extractor: ExtractorFile | None = None
    matcher: MatcherFile | None = None
    nearest_neighbours: NearestFile | None = None
    fused: FusedFile | None = None
    origin: Origin

    @model_validator(mode="after")
    def _whole(self) -> ModelDescription:
        if self.kind == "fused":
            if self.fused is None or self.extractor or self.matcher or self.nearest_neighbours:
                raise ValueError("kind 'fused' takes a [fused] table and no other graph")
        elif self.extractor is None or self.fused is not None:
            raise ValueError("kind 'keypoints' takes an [extractor] table, and no [fused] one")
        elif (self.matcher is None) == (self.nearest_neighbours is None):
            raise ValueError("give either a [matcher] or a [nearest_neighbours] table")
        return self

    @property
    def files(self) -> list[str]:
        """Names of the files it needs."""
        return [part.file for part in (self.extractor, self.matcher, self.fused) if part is not None]


def models_folder(given: str | os.PathLike[str] | None) -> Path | None:
    """Return the folder of model files: the option, else the environment's, else None."""
    named = given if given is not None else os.environ.get(VARIABLE)
    return Path(named) if named else None


def descriptions(folder: Path | None) -> dict[str, ModelDescription]:
    """Read all descriptions: the package's, then the folder's, which may replace them.

    Raises:
        OptionError: if a description in the folder is wrong.
        MissingPartError: if the folder is not there.

    """
    found = {}
    for entry in sorted(
        resources.files("mtpcr_geo.match.learned").joinpath("cards").iterdir(), key=lambda e: e.name
    ):
        if entry.name.endswith(".toml"):
            name = entry.name.removesuffix(".toml")
            found[name] = _parse(name, entry.read_text(encoding="utf-8"), entry.name)
    if folder is not None:
        if not folder.is_dir():
            raise MissingPartError(f"the models folder {folder} is not there; name another by --models")
        for path in sorted(folder.glob("*.toml")):
            found[path.stem] = _parse(path.stem, _text(path), str(path))
    return found


def path_of(file: str, model: ModelDescription, folder: Path | None) -> Path:
    """Find one of a model's files: in the folder, else among those that the package ships.

    Raises:
        MissingPartError: naming the file, where it was looked for, and who publishes it.

    """
    found = _present(file, folder)
    if found is not None:
        return found
    where = f"publishers: {model.origin.project}"
    if folder is None:
        raise MissingPartError(
            f"{model.title} needs the file {file}, and no models folder is named; put the file in a "
            f"folder and name it by --models or {VARIABLE} ({where})"
        )
    raise MissingPartError(
        f"{model.title} needs {folder / file}, which is not there ({where}); `mtpcr-geo models` lists what "
        "is, and --matcher bev or rootsift needs no file"
    )


def look_of(name: str, folder: Path | None) -> Look | None:
    """Return the image that a learned matcher of that name was trained on; None where any will do.

    A folder that is not there is for the matcher to report, where it needs one.

    Raises:
        OptionError: if a description in the folder is wrong.

    """
    model = descriptions(folder if folder is not None and folder.is_dir() else None).get(name)
    return model.look if model is not None else None


def _present(file: str, folder: Path | None) -> Path | None:
    """Return where a file is, in the folder or in the package; None if it is in neither."""
    shipped = Path(str(resources.files("mtpcr_geo.match.learned").joinpath("weights", file)))
    places = [shipped] if folder is None else [folder / file, shipped]
    return next((path for path in places if path.is_file()), None)


def inventory(folder: Path | None) -> Iterator[dict[str, Any]]:
    """List every learned matcher: its files with size and sha256 or None, licence, terms and origin."""
    for name, model in descriptions(folder).items():
        files: dict[str, dict[str, Any] | None] = {}
        for file in model.files:
            path = _present(file, folder)
            files[file] = None if path is None else {"bytes": path.stat().st_size, "sha256": sha256(path)}
        yield {
            "name": name,
            "title": model.title,
            "usable": all(files.values()),
            "files": files,
            "licence": model.origin.licence,
            "terms": model.origin.terms,
            "project": model.origin.project,
        }


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise OptionError(f"cannot read the model description {path}: {error}") from None


def _parse(name: str, text: str, where: Annotated[str, "for messages"]) -> ModelDescription:
    try:
        # the parser takes time by the square of a key's dots
        if len(text) > _LONGEST or any(line.count(".") > _MOST_DOTS for line in text.splitlines()):
            raise OptionError(
                f"the model description {where} has more than {_LONGEST} letters, or than {_MOST_DOTS} dots "
                "in a line; shorten it"
            )
        return ModelDescription.model_validate({"name": name, **tomllib.loads(text)})
    except RecursionError:
        raise OptionError(f"the model description {where} is nested too deeply") from None
    except ValueError as error:
        if isinstance(error, ValidationError):
            problem = error.errors(include_url=False)[0]
            at = ".".join(str(part) for part in problem["loc"]) or "description"
            raise OptionError(f"the model description {where}: {at}: {problem['msg']}") from None
        raise OptionError(f"the model description {where} is not TOML: {error}") from None
