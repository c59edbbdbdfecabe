"""Charts with a label at every mark or curve."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from typing import Any, NamedTuple

COLOURS = ("#0b6e99", "#b5532a", "#7a7a7a", "#5b8c3a")


class Mark(NamedTuple):
    """A point with a label; marks of a group share a colour."""

    label: str
    x: float
    y: float
    group: str


def scatter(marks: Sequence[Mark], *, title: str, x: str, y: str, suffix: str, logarithmic: str = "xy") -> bytes:
    """Draw labelled marks; return an image in the format of the suffix (.png, .svg).

    logarithmic: names of the axes with a logarithmic scale; decibels are logarithms already.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    with _drawn(suffix) as (figure, axes, image):
        for colour, group in zip(cycle(COLOURS), dict.fromkeys(mark.group for mark in marks), strict=False):
            mine = [mark for mark in marks if mark.group == group]
            x_own, y_own = [mark.x for mark in mine], [mark.y for mark in mine]
            axes.scatter(x_own, y_own, s=28, color=colour, label=group, zorder=3)
        axes.set(title=title, xlabel=x, ylabel=y)
        for name in logarithmic:
            axis = getattr(axes, f"{name}axis")
            axes.set(**{f"{name}scale": "log"})
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
        axes.margins(0.12)
        axes.legend(frameon=False)
        figure.canvas.draw()
        _label(axes, marks)
    return image.getvalue()


def lines(curves: Mapping[str, Sequence[tuple[float, float]]], *, title: str, x: str, y: str, suffix: str) -> bytes:
    """Draw curves, each with its name at its last point; return an image. The points are in the order of their x."""
    with _drawn(suffix) as (_, axes, image):
        for colour, (name, points) in zip(cycle(COLOURS), curves.items(), strict=False):
            across, up = zip(*points, strict=True)
            axes.plot(across, up, color=colour, marker="o", markersize=4, zorder=3)
            axes.annotate(name, points[-1], (7, 0), textcoords="offset points", va="center", color=colour)
        axes.set(title=title, xlabel=x, ylabel=y)
        axes.margins(0.12)
    return image.getvalue()


@contextmanager
def _drawn(suffix: str) -> Iterator[tuple[Any, Any, io.BytesIO]]:
    """A figure, its axes, and the image that is written at the end of the block, with reproducible bytes."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot

    image = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "nerfbake", "svg.fonttype": "none", "font.size": 9}):
        figure, axes = pyplot.subplots(figsize=(9, 6), layout="constrained")
        try:
            axes.grid(which="both", color="#e6e6e6", linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)
            yield figure, axes, image
            metadata = {"Date": None} if suffix == ".svg" else {}
            figure.savefig(image, format=suffix.removeprefix("."), dpi=140, metadata=metadata)
        finally:
            pyplot.close(figure)


def _label(axes: object, marks: Sequence[Mark]) -> None:
    """Place each label as near to its mark as possible without covering another label or a mark."""
    from matplotlib.text import Text
    from matplotlib.transforms import Bbox

    transform = axes.transData.transform  # type: ignore[attr-defined]
    renderer = axes.figure.canvas.get_renderer()  # type: ignore[attr-defined]
    spots = [transform((mark.x, mark.y)) for mark in marks]
    taken = [Bbox.from_bounds(px - 5, py - 5, 10, 10) for px, py in spots]
    for mark in sorted(marks, key=lambda mark: (mark.y, mark.x)):
        best = None
        for reach in (7, 16, 27, 40, 55):
            for dx, dy, ha, va in _PLACES:
                text = axes.annotate(  # type: ignore[attr-defined]
                    mark.label,
                    (mark.x, mark.y),
                    (dx * reach, dy * reach),
                    textcoords="offset points",
                    ha=ha,
                    va=va,
                    fontsize=7.5,
                    arrowprops={"arrowstyle": "-", "color": "#aaaaaa", "linewidth": 0.5} if reach > 7 else None,
                )
                text.update_positions(renderer)  # without it the box has only the offset's position
                box = Text.get_window_extent(text, renderer)  # without its arrow
                if not any(box.overlaps(other) for other in taken):
                    best = box
                    break
                text.remove()
            if best is not None:
                taken.append(best)
                break


_PLACES = (
    (1, 0, "left", "center"),
    (-1, 0, "right", "center"),
    (0, 1, "center", "bottom"),
    (0, -1, "center", "top"),
    (0.8, 0.8, "left", "bottom"),
    (0.8, -0.8, "left", "top"),
    (-0.8, 0.8, "right", "bottom"),
    (-0.8, -0.8, "right", "top"),
)
