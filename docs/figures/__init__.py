# SPDX-License-Identifier: Apache-2.0
"""Drawings for the pages, made by the library itself while the site is built.

Each function of the files here draws one figure and returns it as HTML. Lines and letters take the colour of the page's
text, so a figure is readable in the light and in the dark scheme.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Sequence

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

__all__ = [
    "CHARTS",
    "FAINT",
    "INK",
    "MARK",
    "bar_below",
    "bare_axes",
    "new_figure",
    "to_html",
]

#: Stands for the colour of the page's text; ``to_html`` puts that in.
INK = "#123456"
#: For lines in the background; grey on both schemes.
FAINT = "#8a939b"
#: For what the reader should look at.
MARK = "#e4572e"
#: Colours of the five charts of an icosphere, or of the cameras of a rig.
CHARTS = ("#2a9d8f", "#e9b44c", "#5b8fd1", "#e4572e", "#9a6fb0")

STYLE = {
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "axes.titlecolor": INK,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
}


def new_figure(width: float, height: float) -> Figure:
    """An empty figure in the style of the pages, inches."""
    plt.rcParams.update(STYLE)
    return plt.figure(figsize=(width, height))


def bare_axes(figure: Figure, place: Sequence[float], title: str = "") -> Axes:
    """Axes without ticks, as wide as high, at ``(left, bottom, width, height)`` in shares of the figure."""
    axes = figure.add_axes((place[0], place[1], place[2], place[3]))
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title)
    return axes


def bar_below(
    figure: Figure,
    place: Sequence[float],
    colors: str,
    label: str,
    ticks: Sequence[tuple[float, str]],
) -> None:
    """A bar of colours at ``(left, bottom, width, height)``, texts at places from 0 to 1, and a label."""
    bar = figure.colorbar(
        ScalarMappable(cmap=colors),
        cax=figure.add_axes((place[0], place[1], place[2], place[3])),
        orientation="horizontal",
    )
    bar.outline.set_visible(False)
    bar.set_ticks([at for at, _ in ticks], labels=[text for _, text in ticks])
    bar.set_label(label, labelpad=1)
    bar.ax.tick_params(labelsize=9, length=2)


def to_html(figure: Figure, alt: str, caption: str = "") -> str:
    """The figure as SVG inside the page; ``alt`` is read to those who do not see it."""
    inches = figure.get_figwidth()
    text = io.StringIO()
    with plt.rc_context({"svg.fonttype": "none"}):
        figure.savefig(text, format="svg")
    plt.close(figure)
    plt.rcdefaults()  # pictures that the library draws look as they do elsewhere
    svg = text.getvalue()
    svg = re.sub(
        r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL
    )
    svg = re.sub(
        r"font-family: [^;\"]*",
        "font-family: inherit",
        svg.replace(INK, "currentColor"),
    )
    svg = re.sub(
        r"font: ([\d.]+px) [^;\"]*", r"font-size: \1; font-family: inherit", svg
    )
    alt = html.escape(alt)
    svg = svg.replace(
        "<svg",
        f'<svg class="drawing" style="--inches: {inches}" role="img" aria-label="{alt}"',
        1,
    )
    svg = re.sub(r"(<svg[^>]*>)", rf"\1<title>{alt}</title>", svg, count=1)
    below = f"<figcaption>{caption}</figcaption>" if caption else ""
    return f"<figure>{svg}{below}</figure>"
