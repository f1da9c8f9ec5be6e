"""Moving any cloud by a transform that was written before."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mtpcr_geo.core.errors import CrsError, InputError
from mtpcr_geo.crs.facts import same_place
from mtpcr_geo.export.transform import read_transform
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.io.write import returning_scales, write_cloud

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress


def apply_transform(
    transform_path: str | Path,
    in_path: str | Path,
    out_path: str | Path,
    inverse: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Stream a cloud through a transform into a new LAS, LAZ or COPC file.

    The output's storage step is finer than the input's, so that moving there and back returns every point.

    Args:
        transform_path: a ``transform.json``.
        in_path: a cloud in the source's frame (in the target's with `inverse`).
        out_path: where to write; the suffix is the format.
        inverse: go from target to source.
        overwrite: whether `out_path` may be replaced.
        progress: where to report the points written.

    Returns:
        The file written.

    Raises:
        InputError: if an input cannot be read.
        CrsError: if the cloud is not in the frame from which the transform starts.
        OutputError: if the output cannot be written, or exists.

    """
    chain = read_transform(transform_path)
    start, end = (chain.target, chain.source) if inverse else (chain.source, chain.target)
    cloud = open_cloud(in_path)
    out_path = Path(out_path)
    if out_path.exists() and out_path.samefile(in_path):
        raise InputError(f"{out_path} is input and output at once; write to another file")
    if cloud.crs is not None and start.file_crs is not None and not same_place(cloud.crs, start.file_crs):
        side = "target" if inverse else "source"
        raise CrsError(
            f"{in_path} is in {cloud.crs.name}, and the transform starts from its {side}'s "
            f"{start.file_crs.name}; reproject the cloud first, or check whether --inverse is meant"
        )
    with OutputSet(overwrite) as outputs:
        part = outputs.path(out_path)
        write_cloud(
            part,
            cloud,
            chain.inverse if inverse else chain.forward,
            end.file_crs,
            scale=tuple(returning_scales(cloud, end.file_crs)),
            progress=progress,
        )
        outputs.commit()
    return out_path
