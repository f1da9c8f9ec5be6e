"""Moving any cloud by a transform that was written before."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from mtpcr_geo.core.errors import CrsError, InputError
from mtpcr_geo.crs.facts import same_place
from mtpcr_geo.export.transform import read_transform
from mtpcr_geo.io.formats import open_any
from mtpcr_geo.io.many import ManyFiles, output_names
from mtpcr_geo.io.memory import cloud_of, coordinates, is_array
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.io.views import Moved
from mtpcr_geo.io.write import write_cloud

if TYPE_CHECKING:
    from mtpcr_geo.core.arrays import Floats
    from mtpcr_geo.core.cloud import Cloud
    from mtpcr_geo.core.progress import Progress
    from mtpcr_geo.crs.chain import TransformChain
    from mtpcr_geo.io.memory import CloudLike


def apply_transform(
    transform_path: str | Path,
    in_path: str | Path,
    out_path: str | Path,
    inverse: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
    say: Callable[[str], object] | None = None,
) -> Path:
    """Stream a cloud through a transform into a new LAS, LAZ or COPC file.

    The output's storage step is finer than the input's, so that moving there and back returns every point.

    Args:
        transform_path: a ``transform.json``.
        in_path: a cloud in the source's frame (in the target's with `inverse`).
        out_path: where to write; the suffix is the format. For a cloud of many files a folder, which will
            hold a file of the same name for each.
        inverse: go from target to source.
        overwrite: whether `out_path` may be replaced.
        progress: where to report the points written.
        say: called with a sentence where points were left out.

    Returns:
        The file written.

    Raises:
        InputError: if an input cannot be read.
        CrsError: if the cloud is not in the frame from which the transform starts.
        OutputError: if the output cannot be written, or exists.

    """
    chain = read_transform(transform_path)
    cloud = open_any(in_path)
    out_path = Path(out_path)
    if out_path.exists() and cloud.path.exists() and out_path.samefile(cloud.path):
        raise InputError(f"{out_path} is input and output at once; write to another file")
    moved = moved_by(chain, cloud, inverse=inverse)
    left_out = write_moved(out_path, moved, overwrite=overwrite, progress=progress)
    if left_out and say is not None:
        say(left_out_text(left_out, out_path.name))
    return out_path


def left_out_text(count: int, name: str) -> str:
    """Return in a sentence that points were left out of a file."""
    points = "1 point is" if count == 1 else f"{count:,} points are"
    return f"{points} left out of {name}: too far from all others to be stored with them"


def move(chain: TransformChain, points: CloudLike, *, inverse: bool = False) -> Floats | Cloud:
    """Move points by the chain of a registration: an array at once, a cloud as its points are read.

    Args:
        chain: from the source's coordinates to the target's.
        points: (n, 3) coordinates in the source's CRS and units (in the target's with `inverse`); or a file,
            `laspy.LasData` or `Cloud`.
        inverse: go from target to source.

    Returns:
        (n, 3) float64 for an array, else a cloud with all dimensions.

    Raises:
        InputError: if the points are none.
        CrsError: if a cloud is not in the frame from which the transform starts.

    """
    if is_array(points):
        xyz = coordinates(points, "points")
        return chain.inverse(xyz) if inverse else chain.forward(xyz)
    return moved_by(chain, cloud_of(points, "points"), inverse=inverse)


def moved_by(chain: TransformChain, cloud: Cloud, *, inverse: bool = False) -> Moved:
    """Return a cloud moved by the chain of a registration; its points are moved as they are read.

    Args:
        chain: from the source's coordinates to the target's.
        cloud: in the source's frame (in the target's with `inverse`).
        inverse: go from target to source.

    Raises:
        CrsError: if the cloud is not in the frame from which the transform starts.

    """
    start, end = (chain.target, chain.source) if inverse else (chain.source, chain.target)
    if cloud.crs is not None and start.file_crs is not None and not same_place(cloud.crs, start.file_crs):
        side = "target" if inverse else "source"
        raise CrsError(
            f"{cloud.name} is in {cloud.crs.name}, and the transform starts from its {side}'s "
            f"{start.file_crs.name}; reproject the cloud first, or check whether --inverse is meant"
        )
    return Moved(cloud, chain.inverse if inverse else chain.forward, end.file_crs)


def write_moved(
    out_path: str | Path, moved: Moved, *, overwrite: bool = False, progress: Progress | None = None
) -> int:
    """Stream a moved cloud into a new LAS, LAZ or COPC file, with digits fine enough to move it back.

    Returns:
        The number of points left out, since they lie too far from all others to be stored with them.

    Raises:
        OutputError: if the output cannot be written, or exists.

    """
    parts: list[tuple[Path, Cloud]] = [(Path(out_path), moved.base)]
    if isinstance(moved.base, ManyFiles):
        clouds = moved.base.parts
        names = output_names([Path(part.name) for part in clouds])
        parts = [(Path(out_path) / name, part) for name, part in zip(names, clouds, strict=True)]
        if Path(out_path).is_file():
            raise InputError(f"{out_path} is a file, and {len(parts)} files are moved; name a folder")
    with OutputSet(overwrite) as outputs:
        left_out = sum(
            write_cloud(outputs.path(final), part, moved.move, moved.crs, progress=progress, returning=True)
            for final, part in parts
        )
        outputs.commit()
    return left_out
