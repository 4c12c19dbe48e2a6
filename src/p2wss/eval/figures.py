"""Figures of the report: training curves and distributions of errors; the colours of methods and faces."""

import base64
from collections.abc import Mapping
from io import BytesIO

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

# no formulas from a $ in names of the data; equal figures have equal bytes
matplotlib.rcParams |= {"text.parse_math": False, "svg.hashsalt": "p2wss"}

COLORS = {
    "point2wss": "#e0996f",
    "fit": "#b4451f",
    "roofer": "#2a6f97",
    "lod1": "#6c757d",
    "constant": "#b8a13c",
}
_MAX_STEPS = 2000


def data_uri(figure: Figure) -> str:
    """The figure as a ``data:`` URI of an SVG; closes the figure."""
    buffer = BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)
    return image_uri(buffer.getvalue(), "svg+xml")


def image_uri(content: bytes, kind: str) -> str:
    """An image as a ``data:`` URI."""
    return f"data:image/{kind};base64," + base64.b64encode(content).decode()


def curves(series: Mapping[str, pd.Series], x_label: str, y_label: str) -> Figure:
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
    axes.locator_params(axis="x", nbins=6, integer=True)
    axes.set_ylabel(y_label)
    return _finished(figure, x_label)


def cumulative(
    values: Mapping[str, np.ndarray], names: Mapping[str, str], x_label: str, title: str
) -> Figure:
    """Share of buildings with at most x, one line per method. values: without NaN. names: of the methods.

    The x axis ends at the median of the methods' 95th percentiles, so that one bad method does not squeeze the others.
    """
    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
    for method, sample in values.items():
        # a data set of many buildings needs no point per value
        share = np.linspace(0, 1, min(len(sample), _MAX_STEPS))
        axes.plot(np.quantile(sample, share), share, label=names[method], color=COLORS.get(method))
    axes.set_xlim(0, np.median([np.quantile(sample, 0.95) for sample in values.values()]) or 1.0)
    axes.set(ylim=(0, 1), ylabel="share of buildings")
    axes.set_title(title, fontsize=10)
    return _finished(figure, x_label)


def _finished(figure: Figure, x_label: str) -> Figure:
    (axes,) = figure.axes
    axes.set_xlabel(x_label)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
