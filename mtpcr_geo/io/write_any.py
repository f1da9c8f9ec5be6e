"""Writing clouds in the format that a file's ending names: LAS, LAZ, COPC, or another one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.io.formats import LAS_ENDINGS
from mtpcr_geo.io.formats.writing import WRITERS, write_other
from mtpcr_geo.io.many import uncommon_of
from mtpcr_geo.io.storage import Move
from mtpcr_geo.io.write import write_cloud

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.core.progress import Progress

_LISTS = ("dimensions_left_out", "dimensions_not_in_all_files")
ENDINGS = (*LAS_ENDINGS, *WRITERS)


@dataclass(frozen=True)
class LeftOut:
    """What a file could not hold.

    Attributes:
        points: number of points too far from all others to be stored with them.
        dimensions: names of dimensions that the format has no place for.
        uncommon: names of dimensions that only some of the files have which the cloud comes from.

    """

    points: int = 0
    dimensions: tuple[str, ...] = ()
    uncommon: tuple[str, ...] = ()

    @classmethod
    def read(cls, facts: Mapping[str, Any]) -> LeftOut:
        """Return what a stage states by the names of `as_dict`."""
        dimensions, uncommon = (tuple(facts.get(name, ())) for name in _LISTS)
        return cls(int(facts.get("left_out", 0)), dimensions, uncommon)

    def as_dict(self) -> dict[str, Any]:
        """Return what there is of it, for the metadata of a stage."""
        facts = {
            "left_out": self.points,
            **dict(zip(_LISTS, map(list, (self.dimensions, self.uncommon)), strict=True)),
        }
        return {name: value for name, value in facts.items() if value}

    def sentences(self, name: str) -> list[str]:
        """Return what was left out of a file of that name, a sentence each."""
        said = []
        if self.points:
            points = "1 point is" if self.points == 1 else f"{self.points:,} points are"
            said.append(f"{points} left out of {name}: too far from all others to be stored with them")
        if self.dimensions:
            said.append(f"{name} has no place for {', '.join(self.dimensions)}: left out")
        if self.uncommon:
            said.append(
                f"{', '.join(self.uncommon)} left out of {name}: not all of the files joined have them"
            )
        return said


def check_ending(path: Path) -> None:
    """Refuse a file whose ending names no format that is written.

    Raises:
        OutputError: naming those that are.

    """
    if path.suffix.lower() not in ENDINGS:
        raise OutputError(
            f"{path} ends in none of {', '.join(ENDINGS)} and .copc.laz, which are the formats written; name "
            "such a file"
        )


def write_any(
    path: Path,
    cloud: Cloud,
    move: Move | None,
    crs: CRS | None,
    scale: float | tuple[float, float, float] | None = None,
    progress: Progress | None = None,
    advance: Callable[[int], object] | None = None,
    *,
    returning: bool = False,
) -> LeftOut:
    """Write a cloud in the format that the file's ending names; the arguments are those of `write_cloud`.

    Returns:
        What the file could not hold.

    Raises:
        OutputError: if the file cannot be written, its ending names no format, or coordinates do not fit.
        InputError: if the cloud cannot be read.

    """
    check_ending(path)
    if path.suffix.lower() in LAS_ENDINGS:
        points = write_cloud(path, cloud, move, crs, scale, progress, advance, returning=returning)
        return LeftOut(points, (), uncommon_of(cloud))
    task: Any = nullcontext(lambda n: None)
    if progress is not None:
        task = progress.task(f"writing {path.name}", cloud.count)
    with task as report:

        def both(count: int) -> None:
            report(count)
            if advance is not None:
                advance(count)

        return LeftOut(0, write_other(path, cloud, move, crs, both), uncommon_of(cloud))
