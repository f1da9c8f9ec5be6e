"""Readers and writers served without PDAL, under PDAL's names and options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, model_validator

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import CrsError, OptionError
from mtpcr_geo.io.views import Box, Cropped, Head, Moved, parse_bounds
from mtpcr_geo.io.write_any import ENDINGS
from mtpcr_geo.pipeline.file_options import TEXT_GRAMMAR, Scale, TextLayoutText
from mtpcr_geo.pipeline.stage import OptionsModel, RunContext, Stage, StageOptions, Value

if TYPE_CHECKING:
    from pyproj import CRS


def _path_of(value: Any) -> Any:
    # PDAL from 2.9 on also takes {"path": ...}
    return value.get("path", value) if isinstance(value, Mapping) else value


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _checked_bounds(values: list[str]) -> list[str]:
    for value in values:
        parse_bounds(value)
    return values


_READER_SYNONYMS = {"spatialreference": "override_srs"}
_WRITER_SYNONYMS = {"spatialreference": "a_srs"}


def _without_synonyms(options: Any, synonyms: Mapping[str, str]) -> Any:
    """Return options under the one name that each has here, of the several that PDAL takes."""
    if not isinstance(options, Mapping):
        return options
    twice = [f"{old} and {new}" for old, new in synonyms.items() if old in options and new in options]
    if twice:
        raise ValueError(f"{twice[0]} are the same option; leave one of them out")
    return {synonyms.get(name, name): value for name, value in options.items()}


FileName = Annotated[Path, BeforeValidator(_path_of)]
Bounds = Annotated[list[str], BeforeValidator(_listed), Field(min_length=1)]


class LasReaderOptions(StageOptions):
    """Options of readers.las."""

    filename: FileName = Field(description="file to read: LAS 1.0-1.4, LAZ or COPC")
    count: int | None = Field(None, ge=1, description="read at most this many points, from the first on")
    override_srs: str | None = Field(None, description="CRS to take instead of what the file states")
    default_srs: str | None = Field(None, description="CRS to take where the file states none")

    @model_validator(mode="before")
    @classmethod
    def _synonyms(cls, options: Any) -> Any:
        return _without_synonyms(options, _READER_SYNONYMS)


class LasReader(Stage):
    """Read LAS, LAZ or COPC; points are streamed when a later stage asks for them."""

    type: ClassVar[str] = "readers.las"
    Options: ClassVar[OptionsModel] = LasReaderOptions
    options: LasReaderOptions

    def reads(self) -> list[Path]:
        """Name the file."""
        return [self.options.filename]

    def check(self, context: RunContext) -> None:
        """Open the header, and read the CRS options."""
        self._open()

    def preview(self, context: RunContext) -> Value | None:
        """Return the whole cloud, known by its header."""
        return self._open()

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Return the cloud, known by its header; cut short where a count is given."""
        cloud = self._open()
        if self.options.count is not None and self.options.count < cloud.count:
            cloud = Head(cloud, self.options.count)
        self.metadata |= {
            "filename": str(self.options.filename),
            "count": cloud.count,
            "minimum": cloud.minimum.tolist(),
            "maximum": cloud.maximum.tolist(),
            "srs": cloud.crs.to_wkt() if cloud.crs is not None else "",
        }
        return cloud

    def _open(self) -> Cloud:
        from mtpcr_geo.io.formats import open_any

        override = stated_crs(self, "override_srs", self.options.override_srs)
        default = stated_crs(self, "default_srs", self.options.default_srs)
        text = self.options.text if isinstance(self.options, FileReaderOptions) else None
        cloud = open_any(self.options.filename, override, text)
        if cloud.crs is None and default is not None:
            cloud = open_any(self.options.filename, default, text)
        return cloud


class FileReaderOptions(LasReaderOptions):
    """Options of mtpcr.read."""

    filename: FileName = Field(description="file of any format that is read, or what names many")
    text: TextLayoutText | None = Field(None, description=f"layout of a file that is text: {TEXT_GRAMMAR}")


class FileReader(LasReader):
    """Read a cloud in any format that is read without PDAL, or many files as one."""

    type: ClassVar[str] = "mtpcr.read"
    Options: ClassVar[OptionsModel] = FileReaderOptions

    def reads(self) -> list[Path]:
        """Name the files."""
        from mtpcr_geo.io.formats import files_at

        return files_at(self.options.filename)


class CopcReaderOptions(LasReaderOptions):
    """Options of readers.copc."""

    bounds: Bounds | None = Field(
        None, description='keep what lies in "([xmin, xmax], [ymin, ymax])", in the file\'s units'
    )

    @model_validator(mode="after")
    def _check(self) -> CopcReaderOptions:
        _checked_bounds(self.bounds or [])
        return self


class CopcReader(LasReader):
    """Read COPC, whole or within bounds."""

    type: ClassVar[str] = "readers.copc"
    Options = CopcReaderOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Return the cloud, cropped where bounds are given."""
        cloud = super().run(inputs, context)
        bounds = self.options.bounds if isinstance(self.options, CopcReaderOptions) else None
        if bounds is None or not isinstance(cloud, Cloud):
            return cloud
        return Cropped(cloud, [parse_bounds(text) for text in bounds])


class CropOptions(StageOptions):
    """Options of filters.crop, as far as it is served without PDAL."""

    bounds: Bounds = Field(description='keep what lies in "([xmin, xmax], [ymin, ymax])"; several join')
    outside: bool = Field(False, description="keep what lies outside instead")

    @model_validator(mode="after")
    def _check(self) -> CropOptions:
        _checked_bounds(self.bounds)
        return self

    @property
    def boxes(self) -> list[Box]:
        """The bounds, read."""
        return [parse_bounds(text) for text in self.bounds]


class Crop(Stage):
    """Keep the points within bounds."""

    type = "filters.crop"
    Options = CropOptions
    options: CropOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Return the cloud cropped; points stream through."""
        return Cropped(one_cloud(self, inputs), self.options.boxes, self.options.outside)


class LasWriterOptions(StageOptions):
    """Options of writers.las, as far as it is served without PDAL."""

    filename: FileName = Field(description="file to write: LAS 1.4; .laz is compressed")
    a_srs: str | None = Field(None, description="CRS to state instead of the cloud's own")
    compression: Literal["laszip", "lazperf", "true", "none", "false"] | None = Field(
        None, description="whether to write LAZ; the file's name says it if this does not"
    )
    scale_x: float | None = Field(None, gt=0, description="size of the last digit of x, in units of the CRS")
    scale_y: float | None = Field(None, gt=0, description="size of the last digit of y, in units of the CRS")
    scale_z: float | None = Field(None, gt=0, description="size of the last digit of z, in units of the CRS")
    minor_version: Literal[4] = Field(4, description="only LAS 1.4 is written")
    extra_dims: Literal["all"] = Field("all", description="every extra dimension is kept")

    @model_validator(mode="before")
    @classmethod
    def _plain(cls, options: Any) -> Any:
        options = _without_synonyms(options, _WRITER_SYNONYMS)
        compression = options.get("compression") if isinstance(options, dict) else None
        if isinstance(compression, bool):
            return {**options, "compression": str(compression).lower()}
        return options

    @model_validator(mode="after")
    def _check(self) -> LasWriterOptions:
        if self.compression is not None:
            wanted = self.compression not in ("none", "false")
            if wanted != (self.filename.suffix.lower() == ".laz"):
                raise ValueError(
                    f"compression {self.compression} does not suit the name {self.filename.name}; "
                    "LAZ ends in .laz, LAS in .las"
                )
        scales = (self.scale_x, self.scale_y, self.scale_z)
        if any(scales) and not all(scales):
            raise ValueError("scale_x, scale_y and scale_z go together; give all three or none")
        return self

    @property
    def scale(self) -> tuple[float, float, float] | None:
        """The scales, where given."""
        if self.scale_x is None or self.scale_y is None or self.scale_z is None:
            return None
        return self.scale_x, self.scale_y, self.scale_z


class LasWriter(Stage):
    """Write LAS 1.4 or LAZ: point format 6 or up, WKT, every dimension and extra byte kept."""

    type: ClassVar[str] = "writers.las"
    Options = LasWriterOptions
    options: LasWriterOptions

    def writes(self) -> list[Path]:
        """Name the file."""
        return [self.options.filename]

    def check(self, context: RunContext) -> None:
        """Read the CRS option."""
        stated_crs(self, "a_srs", self.options.a_srs)

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Stream the cloud to the file, and hand it on."""
        from mtpcr_geo.io.many import uncommon_of
        from mtpcr_geo.io.write import write_cloud
        from mtpcr_geo.io.write_any import LeftOut

        cloud = one_cloud(self, inputs)
        crs = stated_crs(self, "a_srs", self.options.a_srs) or cloud.crs
        scale = self.options.scale
        path = context.outputs.path(self.options.filename)
        base, move = (cloud.base, cloud.move) if isinstance(cloud, Moved) else (cloud, None)
        with context.progress.task(f"writing {self.options.filename.name}", cloud.count) as advance:
            points = write_cloud(path, base, move, crs, scale, advance=advance)
        self.metadata |= {"filename": str(self.options.filename), "count": cloud.count - points}
        self.metadata |= LeftOut(points, (), uncommon_of(base)).as_dict()
        return cloud


class FileWriterOptions(StageOptions):
    """Options of mtpcr.write."""

    filename: Path = Field(description="file to write; its ending is the format")
    a_srs: str | None = Field(None, description="CRS to state instead of the cloud's own")
    scale: Scale = None

    @model_validator(mode="after")
    def _check(self) -> FileWriterOptions:
        if self.filename.suffix.lower() not in ENDINGS:
            raise ValueError(f"the file ends in none of {', '.join(ENDINGS)}, which are the formats written")
        return self


class FileWriter(Stage):
    """Write a cloud in any format that is written: LAS, LAZ, COPC, PLY, PCD, XYZ, CSV, NPY or E57."""

    type: ClassVar[str] = "mtpcr.write"
    Options: ClassVar[OptionsModel] = FileWriterOptions
    options: FileWriterOptions

    def writes(self) -> list[Path]:
        """Name the file."""
        return [self.options.filename]

    def check(self, context: RunContext) -> None:
        """Read the CRS option."""
        stated_crs(self, "a_srs", self.options.a_srs)

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Stream the cloud to the file, and hand it on."""
        from mtpcr_geo.io.write_any import write_any

        cloud = one_cloud(self, inputs)
        crs = stated_crs(self, "a_srs", self.options.a_srs) or cloud.crs
        path = context.outputs.path(self.options.filename)
        base, move = (cloud.base, cloud.move) if isinstance(cloud, Moved) else (cloud, None)
        with context.progress.task(f"writing {self.options.filename.name}", cloud.count) as advance:
            left_out = write_any(path, base, move, crs, self.options.scale, advance=advance)
        self.metadata |= {"filename": str(self.options.filename), "count": cloud.count - left_out.points}
        self.metadata |= left_out.as_dict()
        return cloud


class EachWriterOptions(StageOptions):
    """Options of mtpcr.write_each."""

    filename: Path = Field(description="files to write, with a # for their names")
    names: list[str] = Field(description="a name for each file of the cloud, in their order", min_length=1)
    scale: Scale = None


class EachWriter(Stage):
    """Write a cloud of many files as many files, as mtpcr.write does."""

    type: ClassVar[str] = "mtpcr.write_each"
    Options: ClassVar[OptionsModel] = EachWriterOptions
    options: EachWriterOptions

    def writes(self) -> list[Path]:
        """Name the files."""
        return [self.options.filename.with_name(name) for name in self.options.names]

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Stream each part to its file, and hand the cloud on."""
        from mtpcr_geo.io.many import ManyFiles
        from mtpcr_geo.io.write_any import LeftOut, write_any

        cloud = one_cloud(self, inputs)
        base, move = (cloud.base, cloud.move) if isinstance(cloud, Moved) else (cloud, None)
        parts = base.parts if isinstance(base, ManyFiles) else (base,)
        if len(parts) != len(self.options.names):
            raise OptionError(
                f"{self.label}: {len(parts)} files are to be written, and {len(self.options.names)} named"
            )
        left_out: list[LeftOut] = []
        with context.progress.task(f"writing {len(parts)} files", cloud.count) as advance:
            for part, final in zip(parts, self.writes(), strict=True):
                path, scale = context.outputs.path(final), self.options.scale
                left_out.append(write_any(path, part, move, cloud.crs, scale, advance=advance))
        points = sum(one.points for one in left_out)
        dimensions = tuple(dict.fromkeys(name for one in left_out for name in one.dimensions))
        self.metadata |= {"filename": str(self.options.filename), "count": cloud.count - points}
        self.metadata |= LeftOut(points, dimensions).as_dict()
        return cloud


class CopcWriter(LasWriter):
    """Write COPC."""

    type: ClassVar[str] = "writers.copc"


def one_cloud(stage: Stage, inputs: Sequence[Value]) -> Cloud:
    """Take the single cloud among a stage's inputs.

    Raises:
        OptionError: if the inputs are something else.

    """
    if len(inputs) == 1 and isinstance(inputs[0], Cloud):
        return inputs[0]
    if len(inputs) == 1:
        raise OptionError(
            f"{stage.label} needs a cloud and got a pair of clouds; "
            "put mtpcr.apply before it, which moves the source"
        )
    raise OptionError(
        f"{stage.label} needs one cloud and got {len(inputs)} inputs; name one in its inputs, "
        "or join them by PDAL's filters.merge"
    )


def stated_crs(stage: Stage, option: str, text: str | None) -> CRS | None:
    """Read a CRS option of a stage; None where it is not given.

    Raises:
        CrsError: naming the stage and the option.

    """
    from mtpcr_geo.crs import parse_crs

    if text is None:
        return None
    try:
        crs = parse_crs(text)
    except CrsError as error:
        raise CrsError(f"{stage.label}: option {option!r}: {error}") from error
    if crs is None:
        raise CrsError(
            f"{stage.label}: option {option!r} takes a coordinate reference system, and {text!r} is none; "
            "that a cloud is local is said to the stage that takes both: --source-crs local, or --target-crs"
        )
    return crs
