"""Make the pictures of README and these pages from a run of the demonstration.

    mtpcr-geo demo --overwrite && python docs/make_pictures.py mtpcr-demo

Needs matplotlib and pyogrio (extra `test`). Without Chromium the picture of the report stays as it is, and
without xvfb-run that of the recording (Debian's xvfb, xauth and mesa-vulkan-drivers draw without a display).
A picture taken in QGIS, of any size, takes the place of the layers drawn here with ``--qgis PICTURE``.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path

import cv2
import laspy
import matplotlib
import numpy as np
import pyogrio.raw
import rasterio
from matplotlib.axes import Axes
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

IMAGES = Path(__file__).parent / "images"
SOURCE, TARGET = "#e4572e", "#3b3f46"
CELL_M = 0.6
WIDTHS = (1100, 900, 720, 600, 480)
LARGEST_BYTES = 150_000


def heights(
    xyz: NDArray[np.float64], cell: float
) -> tuple[NDArray[np.float64], tuple[float, float, float, float]]:
    """Return the highest z of each cell of points, north up, NaN where there is none, and the extent."""
    low = np.floor(xyz[:, :2].min(0))
    cells = ((xyz[:, :2] - low) / cell).astype(int)
    columns, rows = cells.max(0) + 1
    image = np.full((rows, columns), -np.inf)
    np.maximum.at(image, (cells[:, 1], cells[:, 0]), xyz[:, 2])
    image[np.isneginf(image)] = np.nan
    return image[::-1], (low[0], low[0] + columns * cell, low[1], low[1] + rows * cell)


def draw(axes: Axes, xyz: NDArray[np.float64], colour: str, opacity: float, cell: float = CELL_M) -> None:
    """Draw a cloud from above: a colour, shaded by height."""
    image, extent = heights(xyz, cell)
    low, high = np.nanpercentile(image, (2, 98))
    share = np.clip((image - low) / max(high - low, 1e-9), 0, 1)
    rgb = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    # roofs pale, ground dark
    shaded = rgb * (1 - 0.65 * share[..., None]) + 0.65 * share[..., None]
    rgba = np.dstack([shaded, np.where(np.isnan(image), 0.0, opacity)])
    axes.imshow(np.nan_to_num(rgba), extent=extent, interpolation="nearest")


def before_after(demo: Path) -> Figure:
    """Draw both clouds: before, with their middles put together, and after."""
    ground, aerial, moved = (
        laspy.read(path).xyz
        for path in (demo / "ground.laz", demo / "aerial.laz", demo / "result" / "registered.laz")
    )
    middle = aerial.mean(0)
    figure = Figure(figsize=(12.6, 4.6), dpi=85, layout="constrained")
    panels = figure.subplots(1, 3)
    for axes, source, title in zip(
        panels[:2],
        (ground - ground.mean(0), moved - middle),
        ("before (middles put together)", "after"),
        strict=True,
    ):
        draw(axes, aerial - middle, TARGET, 1.0)
        draw(axes, source, SOURCE, 0.75)
        axes.set(xlim=(-150, 150), ylim=(-110, 170), xticks=[], yticks=[], aspect="equal")
        axes.set_title(title, fontsize=11)
    draw(panels[2], aerial - middle, TARGET, 1.0, cell=0.7)
    # of the scan what stands, such as walls: its points well above the lowest around them
    x, y, z = (moved - middle).T
    cells = np.floor(np.column_stack([x, y]) / 2.0).astype(int)
    _, cell_of = np.unique(cells, axis=0, return_inverse=True)
    lowest = np.full(cell_of.max() + 1, np.inf)
    np.minimum.at(lowest, cell_of.ravel(), z)
    stands = z > lowest[cell_of.ravel()] + 1.5
    panels[2].plot(x[stands], y[stands], ".", ms=1, color=SOURCE)
    panels[2].set(xlim=(-55, 35), ylim=(-12, 72), xticks=[], yticks=[], aspect="equal")
    panels[2].set_title("after, where both see", fontsize=11)
    figure.axes[0].text(-145, 160, "scan from the street", color=SOURCE, va="top", weight="bold")
    figure.axes[0].text(-145, 146, "airborne lidar", color=TARGET, va="top", weight="bold")
    return figure


def layers(result: Path) -> Figure:
    """Draw the target's height raster as a relief, the registered source's over it, and the tie points."""
    figure = Figure(figsize=(6.4, 4.6), dpi=110, layout="constrained")
    axes = figure.subplots()
    sun = LightSource(315, 45)
    for name, colours, opacity in (("target", "Greys_r", 1.0), ("registered", "YlOrBr_r", 0.55)):
        with rasterio.open(result / "bev" / f"{name}.tif") as raster:
            image = raster.read(1).astype(float)
            if raster.nodata is not None:
                image[image == raster.nodata] = np.nan
            bounds = raster.bounds
            cell = raster.res[0]
        empty = np.isnan(image)
        # small holes would shade as pits
        filled = cv2.inpaint(np.nan_to_num(image, nan=0).astype(np.float32), empty.astype(np.uint8), 2, 0)
        low, high = np.nanpercentile(image, (2, 98))
        shaded = sun.shade(
            filled,
            matplotlib.colormaps[colours],
            vert_exag=0.7,
            dx=cell,
            dy=cell,
            vmin=low,
            vmax=high,
            blend_mode="soft",
        )
        shaded[..., 3] = np.where(empty, 0, opacity)
        axes.imshow(shaded, extent=(bounds.left, bounds.right, bounds.bottom, bounds.top))
    table = pyogrio.raw.read(result / "ties.gpkg", layer="tie_points")
    # a point as WKB: byte order and type, then its coordinates
    xy = np.array([np.frombuffer(bytes(point)[5:21], "<f8") for point in table[2]])
    axes.plot(*xy.T, "o", ms=4, mfc="#19a7ce", mec="white", mew=0.6, label="tie points")
    axes.legend(loc="upper left", fontsize=8)
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize=6)
    middle = xy.mean(0)
    axes.set(xlim=middle[0] + np.array((-95, 95)), ylim=middle[1] + np.array((-75, 55)), aspect="equal")
    return figure


def report(page: Path, chromium: str, picture: Path) -> None:
    """Take a picture of the first screen of a report."""
    command = [
        chromium,
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        "--force-device-scale-factor=0.6",
        "--window-size=1200,860",
        f"--screenshot={picture}",
        page.resolve().as_uri(),
    ]
    with tempfile.TemporaryDirectory() as profile:
        subprocess.run([*command, f"--user-data-dir={profile}"], check=True, capture_output=True, timeout=120)


def recording(file: Path, picture: Path) -> None:
    """Take a picture of a recording as the viewer opens it, on a display that is not there."""
    screen = ["xvfb-run", "-a", "-s", "-screen 0 1600x1000x24"]
    viewer = ["rerun", "--renderer", "vulkan", "--window-size", "1400x860", "--screenshot-to", str(picture)]
    subprocess.run([*screen, *viewer, str(file)], check=True, capture_output=True, timeout=300)


def main() -> None:
    """Make every picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("demo", type=Path, help="folder of mtpcr-geo demo")
    parser.add_argument("--qgis", type=Path, help="picture taken in QGIS, for the layers")
    parser.add_argument("--images", type=Path, default=IMAGES)
    arguments = parser.parse_args()
    arguments.images.mkdir(parents=True, exist_ok=True)
    picture = arguments.images / "before_after.png"
    before_after(arguments.demo).savefig(picture)
    smaller(picture)
    picture = arguments.images / "layers.png"
    if arguments.qgis:
        shutil.copyfile(arguments.qgis, picture)
    else:
        layers(arguments.demo / "result").savefig(picture)
    smaller(picture)
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium:
        picture = arguments.images / "report.png"
        report(arguments.demo / "result" / "report.html", chromium, picture.resolve())
        smaller(picture)
    if shutil.which("xvfb-run"):
        picture = arguments.images / "recording.png"
        recording(arguments.demo / "result" / "audit.rrd", picture.resolve())
        smaller(picture)


def smaller(path: Path) -> None:
    """Keep a picture in 128 colours, in the largest width in which its file is small."""
    image = Image.open(path).convert("RGB")
    for width in WIDTHS:
        image.thumbnail((width, width))
        image.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)
        if path.stat().st_size < LARGEST_BYTES:
            break


if __name__ == "__main__":
    main()
