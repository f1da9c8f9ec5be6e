"""Moving any cloud by a transform that was written before."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.core.errors import CrsError, InputError
from mtpcr_geo.crs.facts import facts_of, leaves_heights_open, same_place
from mtpcr_geo.export.transform import read_transform
from mtpcr_geo.io.formats import open_any
from mtpcr_geo.io.many import ManyFiles, output_names
from mtpcr_geo.io.memory import cloud_of, coordinates, is_array
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.io.views import Moved
from mtpcr_geo.io.write_any import ENDINGS, check_ending, write_any

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.core.arrays import Floats
    from mtpcr_geo.core.cloud import Cloud
    from mtpcr_geo.core.progress import Progress
    from mtpcr_geo.crs.chain import TransformChain
    from mtpcr_geo.io.memory import CloudLike

# a cloud that states no CRS may lie this many extents of the registered one away from it
_FAR = 10.0
# and one in the same CRS this many, before that is said
_BESIDE = 1.0


def apply_transform(
    transform_path: str | Path,
    in_path: str | Path,
    out_path: str | Path,
    inverse: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
    say: Callable[[str], object] | None = None,
    text: str | None = None,
    scale: float | None = None,
    cloud_crs: str | None = None,
) -> Path:
    """Stream a cloud through a transform into a new file of any format that is written.

    The storage step of LAS is finer than the input's, so that moving there and back returns every point.

    Args:
        transform_path: a ``transform.json``.
        in_path: a cloud in the source's frame (in the target's with `inverse`).
        out_path: where to write; the suffix is the format. For a cloud of many files a folder, which will
            hold a file of the same name for each.
        inverse: go from target to source.
        overwrite: whether `out_path` may be replaced.
        progress: where to report the points written.
        say: called with a sentence where points or dimensions were left out, the cloud lies far from the one
            that was registered, or states nothing of heights.
        text: layout of a cloud that is text, see `mtpcr_geo.io.formats.text_layout.TextLayout.read`.
        scale: storage step of a LAS file, in units of its CRS; metres where those are degrees.
        cloud_crs: CRS of the cloud, taken instead of what its file states; "local" if it has none.

    Returns:
        The file written.

    Raises:
        InputError: if an input cannot be read.
        CrsError: if the cloud is not in the frame from which the transform starts.
        OutputError: if the output cannot be written, or exists.

    """
    chain = read_transform(transform_path)
    cloud = open_any(in_path, text=text)
    out_path = Path(out_path)
    for read in (cloud.path, Path(in_path), Path(transform_path)):
        if os.path.exists(out_path) and os.path.isfile(read) and out_path.samefile(read):
            raise InputError(f"{out_path} is input and output at once; write to another file")
    moved = moved_by(chain, cloud, inverse=inverse, cloud_crs=cloud_crs)
    remarks = (
        heights_text(chain, cloud, inverse=inverse, cloud_crs=cloud_crs),
        far_text(chain, cloud, inverse=inverse),
    )
    if say is not None:
        for remark in remarks:
            if remark is not None:
                say(remark)
    said = write_moved(
        out_path, moved, overwrite=overwrite, reads=(in_path, transform_path), progress=progress, scale=scale
    )
    if say is not None:
        for sentence in said:
            say(sentence)
    return out_path


def move(
    chain: TransformChain, points: CloudLike, *, inverse: bool = False, cloud_crs: str | CRS | None = None
) -> Floats | Cloud:
    """Move points by the chain of a registration: an array at once, a cloud as its points are read.

    Args:
        chain: from the source's coordinates to the target's.
        points: (n, 3) coordinates in the source's CRS and units (in the target's with `inverse`); or a file,
            `laspy.LasData` or `Cloud`.
        inverse: go from target to source.
        cloud_crs: CRS of a cloud, taken instead of what it states; "local" if it has none.

    Returns:
        (n, 3) float64 for an array, else a cloud with all dimensions.

    Raises:
        InputError: if the points are none.
        CrsError: if a cloud is not in the frame from which the transform starts.

    """
    if is_array(points):
        xyz = coordinates(points, "points")
        return chain.inverse(xyz) if inverse else chain.forward(xyz)
    return moved_by(chain, cloud_of(points, "points"), inverse=inverse, cloud_crs=cloud_crs)


def moved_by(
    chain: TransformChain, cloud: Cloud, *, inverse: bool = False, cloud_crs: str | CRS | None = None
) -> Moved:
    """Return a cloud moved by the chain of a registration; its points are moved as they are read.

    Args:
        chain: from the source's coordinates to the target's.
        cloud: in the source's frame (in the target's with `inverse`). One that states the same horizontal
            system and nothing of heights is taken to have the heights of that frame.
        inverse: go from target to source.
        cloud_crs: CRS of the cloud, taken instead of what it states; "local" if it has none.

    Raises:
        CrsError: if the cloud is not in the frame from which the transform starts, or states no CRS and lies
            far from where that of the registration lay.

    """
    start, end = (chain.target, chain.source) if inverse else (chain.source, chain.target)
    crs = _claimed(cloud, cloud_crs)
    if crs is not None and start.file_crs is not None and not _is_in_frame(chain, crs, inverse):
        side = "target" if inverse else "source"
        raise CrsError(
            f"{cloud.name} is in {crs.name}, and the transform starts from its {side}'s "
            f"{start.file_crs.name}; reproject the cloud first, give --cloud-crs if it "
            "is in another system than it states, or check whether --inverse is meant"
        )
    if crs is None:
        _check_near(chain, cloud, inverse)
    return Moved(cloud, chain.motion(inverse), end.file_crs)


def _claimed(cloud: Cloud, given: str | CRS | None) -> CRS | None:
    """Return the CRS of a cloud: the one given, else the one stated; None for local coordinates."""
    from mtpcr_geo.crs import parse_crs

    if given is None:
        return cloud.crs
    return parse_crs(given) if isinstance(given, str) else given


def heights_text(
    chain: TransformChain, cloud: Cloud, *, inverse: bool = False, cloud_crs: str | CRS | None = None
) -> str | None:
    """Say what heights are taken for a cloud that states the plan of its CRS alone; None for all others.

    Args:
        chain: from the source's coordinates to the target's.
        cloud: what is moved.
        inverse: go from target to source.
        cloud_crs: CRS of the cloud, taken instead of what it states.

    """
    start, crs = chain.target if inverse else chain.source, _claimed(cloud, cloud_crs)
    if crs is None or start.file_crs is None or _is_known(chain, crs, inverse):
        return None
    return (
        f"{Path(cloud.name).name} is in {crs.name}, which says nothing of heights: they are taken as "
        f"{facts_of(start.file_crs).height_name}, as those of the {'target' if inverse else 'source'}"
    )


def _is_in_frame(chain: TransformChain, crs: CRS, inverse: bool) -> bool:
    """Return whether coordinates in a CRS are those from which a chain starts.

    They are in the CRS of its frame; or in the one that the registered file itself states, whatever was
    given for it; or in the horizontal part of that of the frame, with nothing stated of heights.
    """
    start = chain.target if inverse else chain.source
    if _is_known(chain, crs, inverse):
        return True
    return start.file_crs is not None and leaves_heights_open(crs, start.file_crs)


def _is_known(chain: TransformChain, crs: CRS, inverse: bool) -> bool:
    """Return whether a CRS is that of the frame where a chain starts, or the registered file states it."""
    start, stated = (chain.target, chain.target_stated) if inverse else (chain.source, chain.source_stated)
    return any(same_place(crs, one) for one in (start.file_crs, stated) if one is not None)


def _check_near(chain: TransformChain, cloud: Cloud, inverse: bool) -> None:
    """Refuse a cloud that states no CRS and lies where the cloud that was registered was not.

    Raises:
        CrsError: if it is farther away than many times the extent of that one.

    """
    away = _extents_away(chain, cloud, inverse)
    if away is not None and away > _FAR:
        side = "target" if inverse else "source"
        raise CrsError(
            f"{cloud.name} states no CRS and lies {away:.3g} times the extent of the {side} away from it, so "
            "it is hardly in its frame; state its CRS in the file, or check whether --inverse is meant"
        )


def far_text(chain: TransformChain, cloud: Cloud, *, inverse: bool = False) -> str | None:
    """Say that a cloud lies outside the place where the transform was found; None if it does not.

    Args:
        chain: from the source's coordinates to the target's.
        cloud: what is moved.
        inverse: go from target to source.

    """
    away = _extents_away(chain, cloud, inverse)
    if away is None or away <= _BESIDE:
        return None
    side = "target" if inverse else "source"
    return (
        f"{Path(cloud.name).name} lies {away:.3g} times the extent of the {side} away from it: the transform "
        "was found there and nowhere else, and an error of its rotation grows with the distance"
    )


def _extents_away(chain: TransformChain, cloud: Cloud, inverse: bool) -> float | None:
    """Return how far a cloud lies from where the registered one lay, in extents of that one; None unknown."""
    if not cloud.count:
        return None
    box = chain.bounds
    if inverse:
        corners = np.array(
            [[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        )
        moved = chain.forward(corners)
        box = np.array([moved.min(axis=0), moved.max(axis=0)])
    # in the plane: heights of one place differ by their datum
    low, high = cloud.minimum[:2], cloud.maximum[:2]
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return None
    gap = float(np.hypot(*np.maximum(np.maximum(box[0, :2] - high, low - box[1, :2]), 0.0)))
    extent = float(np.hypot(*(box[1, :2] - box[0, :2])))
    return gap / max(extent, np.finfo(float).tiny)


def paths_of(cloud: Cloud) -> list[Path]:
    """Return the files that a cloud is read from; none for a cloud in memory."""
    clouds = cloud.parts if isinstance(cloud, ManyFiles) else (cloud,)
    return [path for path in (getattr(one, "path", None) for one in clouds) if isinstance(path, Path)]


def write_moved(
    out_path: Path,
    moved: Moved,
    *,
    overwrite: bool = False,
    reads: Iterable[str | Path] = (),
    progress: Progress | None = None,
    scale: float | None = None,
) -> list[str]:
    """Stream a moved cloud into a new file, LAS with digits fine enough to move it back.

    Args:
        out_path: where to write; the suffix is the format. For a cloud of many files a folder.
        moved: what to write.
        overwrite: whether `out_path` may be replaced.
        reads: files that are read, and never replaced.
        progress: where to report the points written.
        scale: storage step of a LAS file, in units of its CRS; metres where those are degrees.

    Returns:
        What was left out, a sentence for each file and kind.

    Raises:
        OutputError: if the output cannot be written, or exists, or its ending names no format.

    """
    parts: list[tuple[Path, Cloud]] = [(out_path, moved.base)]
    if isinstance(moved.base, ManyFiles):
        clouds = moved.base.parts
        names = output_names([Path(part.name) for part in clouds])
        parts = [(out_path / name, part) for name, part in zip(names, clouds, strict=True)]
        if os.path.isfile(out_path) or out_path.suffix.lower() in ENDINGS:
            files = "1 file is" if len(parts) == 1 else f"{len(parts)} files are"
            raise InputError(f"{out_path} is a file by its name, and {files} moved to a folder; name one")
    else:
        check_ending(out_path)
    with OutputSet(overwrite) as outputs:
        outputs.keep([*(Path(file) for file in reads), *paths_of(moved.base)])
        said = []
        for final, part in parts:
            path = outputs.path(final)
            left_out = write_any(path, part, moved.move, moved.crs, scale, progress, returning=scale is None)
            said += left_out.sentences(final.name)
        outputs.commit()
    return said
