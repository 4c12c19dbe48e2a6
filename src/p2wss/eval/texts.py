"""Tables as CSV and as LaTeX (booktabs)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

_LATEX = {
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


def to_csv(rows: Sequence[Sequence[Any]]) -> str:
    """Comma-separated text; numbers with four decimals, None and NaN as empty cells."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([[_cell(value, 4) for value in row] for row in rows])
    return text.getvalue()


def to_latex(rows: Sequence[Sequence[Any]], caption: str, label: str) -> str:
    r"""A ``table`` for ``\input``, shrunk to the width of the line if wider; needs booktabs and graphicx.

    Header and rows as for :func:`to_csv`, numbers with two decimals, unknown cells as dashes."""
    header, *body = rows
    columns = "l" + "".join("l" if _is_text(body, i) else "r" for i in range(1, len(header)))
    lines = [
        r"% needs \usepackage{booktabs,graphicx}",
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{escaped(caption)}}}",
        rf"\label{{{label}}}",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        _line(header),
        r"\midrule",
        *map(_line, body),
        r"\bottomrule",
        r"\end{tabular}}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def escaped(text: str) -> str:
    r"""Text that LaTeX prints as it is.

    >>> escaped("50 % of #T_mean ± σ")
    '50 \\% of \\#T\\_mean $\\pm$ $\\sigma$'
    """
    return "".join(_LATEX.get(letter, letter) for letter in text)


def _line(row: Sequence[Any]) -> str:
    return " & ".join(escaped(_cell(value, 2) or "–") for value in row) + r" \\"


def _is_text(body: Sequence[Sequence[Any]], column: int) -> bool:
    return any(isinstance(row[column], str) for row in body)


def _cell(value: Any, digits: int) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    return f"{value:.{digits}f}" if isinstance(value, float) else str(value)
