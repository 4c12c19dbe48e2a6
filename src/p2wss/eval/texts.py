"""Tables as CSV and as LaTeX (booktabs)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "{": r"\{",
        "}": r"\}",
        "&": r"\&",
        "%": r"\%",
        "$": r"\$",
        "#": r"\#",
        "_": r"\_",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "±": r"$\pm$",
        "°": r"$^\circ$",
        "²": r"$^2$",
        "μ": r"$\mu$",
        "σ": r"$\sigma$",
        "–": "--",
        "…": r"\dots{}",
    }
)


def to_csv(rows: Sequence[Sequence[Any]]) -> str:
    """Comma-separated text; numbers with four decimals, None and NaN as empty cells."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([[_csv_cell(value) for value in row] for row in rows])
    return text.getvalue()


def to_latex(rows: Sequence[Sequence[Any]], caption: str, label: str) -> str:
    r"""A ``table`` for ``\input``, shrunk to the width of the line if wider; needs booktabs and graphicx.

    Header and rows as for :func:`to_csv`, numbers with two decimals, unknown cells as dashes."""
    header, *body = ([escaped(value) if isinstance(value, str) else value for value in row] for row in rows)
    # as objects: an integer stays one beside an empty cell
    frame = pd.DataFrame(body, columns=header, dtype=object)
    is_text = frame.map(lambda value: isinstance(value, str)).any()
    tabular = frame.to_latex(
        index=False,
        na_rep="--",
        float_format="%.2f",
        column_format="l" + "".join("l" if text else "r" for text in is_text[1:]),
    )
    lines = [
        r"% needs \usepackage{booktabs,graphicx}",
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{escaped(caption)}}}",
        rf"\label{{{label}}}",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        tabular.strip() + "}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def escaped(text: str) -> str:
    r"""Text that LaTeX prints as it is.

    >>> escaped("50 % of #T_mean ± σ")
    '50 \\% of \\#T\\_mean $\\pm$ $\\sigma$'
    """
    return text.translate(_LATEX)


def _csv_cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    return f"{value:.4f}" if isinstance(value, float) else str(value)
