"""What the templates of a report are given: pictures, charts and tables, as values without markup."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mtpcr_geo.export import drawing

_QUALITY = 82
_LARGEST_SIDE = 1100
OPAQUE = 255


@dataclass(frozen=True)
class Key:
    """An entry of a legend.

    Attributes:
        css: its colour.
        text: what it stands for.

    """

    css: str
    text: str


@dataclass(frozen=True)
class Tick:
    """A mark of an axis.

    Attributes:
        at: where, in percent of the axis.
        text: its label.

    """

    at: float
    text: str


@dataclass(frozen=True)
class Box:
    """A rectangle over a picture, in percent of its width and height, with a label."""

    left: float
    top: float
    width: float
    height: float
    text: str


@dataclass(frozen=True)
class Shown:
    """A picture of a report.

    Attributes:
        uri: the picture itself, as a data URI.
        width, height: pixels.
        alt: what it shows, for those who do not see it.
        caption: what stands below it.
        title: what stands above it; "" for nothing.
        keys: its legend.
        bar: length of a scale bar in percent of the width, and its label; None for none.
        boxes: rectangles over it.
        x_ticks, y_ticks: its axes; empty where it has none.
        enlarged: whether it has so few pixels that they are shown as squares.

    """

    uri: str
    width: int
    height: int
    alt: str
    caption: str = ""
    title: str = ""
    keys: tuple[Key, ...] = ()
    bar: Tick | None = None
    boxes: tuple[Box, ...] = ()
    x_ticks: tuple[Tick, ...] = ()
    y_ticks: tuple[Tick, ...] = ()
    enlarged: bool = False


@dataclass(frozen=True)
class Plot:
    """A chart with its axes and words.

    Attributes:
        title: above it.
        svg: the chart; it holds no text of others.
        alt: what it shows.
        caption: below it, texts and figures.
        keys: its legend.
        x_ticks: of its x axis.
        top: number at the top of its y axis; "" for none.
        aspect: height over width, where the chart keeps that; 0 where it fills a box.
        bar: length of a scale bar in percent of the width, and its label.

    """

    title: str
    svg: str
    alt: str
    caption: tuple[object, ...]
    keys: tuple[Key, ...] = ()
    x_ticks: tuple[Tick, ...] = ()
    top: str = ""
    aspect: float = 0.0
    bar: Tick | None = None


def key(rgb: Sequence[int], text: str) -> Key:
    """Return an entry of a legend for a colour of 0 to 255 each."""
    return Key(css_of(rgb), text)


def css_of(rgb: Sequence[int]) -> str:
    """Return a colour as CSS writes it."""
    return "#" + "".join(f"{int(part):02x}" for part in rgb[:3])


def data_uri(picture: drawing.Picture, *, exact: bool = False) -> str:
    """Return a picture as a data URI.

    It is a PNG file where it must be exact, a WebP file where it has transparent parts, and else a JPEG
    file: WebP is half the size, and takes thirty times as long.

    Args:
        picture: (h, w), (h, w, 3) RGB or (h, w, 4) RGBA.
        exact: without loss, as drawings want it.

    """
    if picture.ndim == 3:
        seen_through = picture.shape[2] == 4 and (exact or bool((picture[..., 3] < OPAQUE).any()))
        order = [2, 1, 0, 3] if seen_through else [2, 1, 0]
        picture = np.ascontiguousarray(picture[..., order])
    if exact:
        kind, options = "png", [cv2.IMWRITE_PNG_COMPRESSION, 6]
    elif picture.ndim == 3 and picture.shape[2] == 4:
        kind, options = "webp", [cv2.IMWRITE_WEBP_QUALITY, _QUALITY]
    else:
        kind, options = "jpeg", [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    good, data = cv2.imencode(f".{kind}", picture, options)
    if not good:
        raise ValueError(f"a picture of shape {picture.shape} cannot be encoded as {kind}")
    return f"data:image/{kind};base64," + base64.b64encode(bytes(data)).decode("ascii")


def shown(
    picture: drawing.Picture,
    alt: str,
    *,
    cell: float | None = None,
    side: int = _LARGEST_SIDE,
    exact: bool = False,
    **more: object,
) -> Shown:
    """Return a picture as it is shown, shrunk where it is large.

    Args:
        picture: (h, w, 3) RGB or (h, w, 4) RGBA, north up.
        alt: what it shows.
        cell: metres of a pixel, for the scale bar; None for none.
        side: pixels of the longer side at most.
        exact: whether it is encoded without loss.
        more: further attributes of `Shown`.

    """
    width = picture.shape[1]
    bar = None
    if cell is not None:
        length = drawing.round_number(width * cell * 0.3)
        bar = Tick(100.0 * length / (width * cell), f"{length:g} m")
    small = drawing.fit(picture, side)
    enlarged = max(small.shape[:2]) < side // 3
    return Shown(
        data_uri(small, exact=exact),
        small.shape[1],
        small.shape[0],
        alt,
        bar=bar,
        enlarged=enlarged,
        **more,  # type: ignore[arg-type]
    )


def ticks(low: float, high: float, most: int = 7, unit: str = "") -> tuple[Tick, ...]:
    """Return the marks of an axis at round numbers, the first with the unit.

    Args:
        low, high: the values at its ends.
        most: number of marks at most.
        unit: of the values.

    """
    step = drawing.round_number((high - low) / most)
    step = next(
        step * factor for factor in (1.0, 2.0, 2.5, 5.0, 10.0) if (high - low) / (step * factor) <= most
    )
    first = int(np.ceil(low / step - 1e-9))
    last = int(np.floor(high / step + 1e-9))
    digits = next((k for k in range(6) if abs(step - round(step, k)) < 1e-9 * step), 6)
    return tuple(
        Tick(
            round(100.0 * (number * step - low) / (high - low), 2),
            f"{number * step + 0.0:.{digits}f}" + (f" {unit}" if unit and number == last else ""),
        )
        for number in range(first, last + 1)
    )
