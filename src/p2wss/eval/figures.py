"""Figures of the report: training curves and distributions of errors; the colours of methods and faces."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from io import BytesIO

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

# a $ in a name from the data is no formula
matplotlib.rcParams["text.parse_math"] = False

COLORS = {
    "point2wss": "#e0996f",
    "point2wss+fit": "#b4451f",
    "fit": "#7b5ea7",
    "roofer": "#2a6f97",
    "lod1": "#6c757d",
    "constant": "#b8a13c",
}
_MAX_STEPS = 2000


def data_uri(figure: Figure, dots_per_inch: int = 110) -> str:
    """The figure as a ``data:`` URI of a PNG of 128 colours; closes the figure."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dots_per_inch)
    plt.close(figure)
    buffer.seek(0)
    small = BytesIO()
    # a third of the size, and no date or version in the metadata: equal figures have equal bytes
    Image.open(buffer).convert("RGB").quantize(128, dither=Image.Dither.NONE).save(
        small, "png", optimize=True
    )
    return png_uri(small.getvalue())


def png_uri(content: bytes) -> str:
    """A PNG as a ``data:`` URI."""
    return "data:image/png;base64," + base64.b64encode(content).decode()


def curves(series: Mapping[str, pd.Series], x_label: str, title: str) -> Figure:
    """Lines by name over their index; the y axis is logarithmic if all values are positive and span a decade."""
    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    for name, values in series.items():
        marker = "o" if len(values) < 30 else ""
        axes.plot(values.index, values, label=name, linewidth=1.4, marker=marker, markersize=3)
    every = pd.concat(list(series.values()))
    if every.min() > 0 and every.max() / every.min() > 10:
        axes.set_yscale("log")
        # its own formatter writes formulas
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(
            lambda value, place: f"{value:g}" if every.max() < 30 * every.min() else ""
        )
    return _finished(figure, x_label, title)


def cumulative(
    values: Mapping[str, np.ndarray], names: Mapping[str, str], x_label: str, title: str
) -> Figure:
    """Share of buildings with at most x, one line per method. values: without NaN. names: of the methods."""
    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    for method, sample in values.items():
        # a data set of many buildings needs no point per value
        share = np.linspace(0, 1, min(len(sample), _MAX_STEPS))
        axes.plot(np.quantile(sample, share), share, label=names[method], color=COLORS.get(method))
    axes.set_xlim(0, max(np.quantile(sample, 0.98) for sample in values.values()) or 1.0)
    axes.set(ylim=(0, 1), ylabel="share of buildings")
    return _finished(figure, x_label, title)


def _finished(figure: Figure, x_label: str, title: str) -> Figure:
    (axes,) = figure.axes
    axes.set_xlabel(x_label)
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
