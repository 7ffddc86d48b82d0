"""Tables as a LaTeX file that compiles as it is; its packages are booktabs, amssymb, graphicx and geometry."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

from apex_lab.tables.build import Built
from apex_lab.tables.definition import Column
from apex_lab.tables.missing_runs import Command
from apex_lab.tables.rows import TRACKING, Cell, Line, rounded

PREAMBLE = r"""\documentclass{article}
\usepackage[a4paper,landscape,margin=15mm]{geometry}
\usepackage{amssymb}
\usepackage{booktabs}
\usepackage{graphicx}
\setlength{\belowcaptionskip}{6pt}
\newcommand{\yes}{\ensuremath{\checkmark}}
\newcommand{\no}{\ensuremath{\times}}
\newcommand{\published}[1]{{\scriptsize(#1)}}
\begin{document}
"""

ARROWS = {"up": r" $\uparrow$", "down": r" $\downarrow$", None: ""}

ESCAPES = {
    "\\": r"\textbackslash{}",
    **{sign: f"\\{sign}" for sign in "&%#_{}"},
    "$": r"$\mathdollar$",  # \$ would need a font that small installations lack
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"$<$",
    ">": r"$>$",
    "|": r"$|$",
    '"': "''",
    "±": r"$\pm$",
    "×": r"$\times$",
    "—": "---",
}


def document(tables: Sequence[Built], published: bool, commands: Sequence[Command]) -> str:
    """A whole file with one table per page at most; missing runs stand at its end as comments."""
    remarks = ["% Missing runs:", *(f"% {command}" for command in commands)] if commands else []
    comments = "".join(f"{_one_line(text)}\n" for text in remarks)
    return PREAMBLE + "\n".join(_table(table, published) for table in tables) + "\\end{document}\n" + comments


def escape(text: str) -> str:
    """Text as LaTeX prints it; what plain LaTeX has no letter for loses its accent or becomes a question mark."""
    escaped = "".join(ESCAPES.get(sign) or _plain(sign) for sign in re.sub("-(?=-)", "-\0", text))
    return escaped.replace("\0", "{}")


def _plain(sign: str) -> str:
    if sign.isascii():
        return sign if sign.isprintable() or sign == "\0" else " "
    plain = unicodedata.normalize("NFKD", sign).encode("ascii", "ignore").decode()
    return plain if plain.isalnum() else "?"


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _table(table: Built, published: bool) -> str:
    width = len(table.columns) + 2
    head = ["", *(_heading(column, table.arrows) for column in table.columns), "Seeds"]
    body = [_row(head), r"\midrule"]
    for number, block in enumerate(table.blocks):
        if number:
            body.append(r"\midrule")
        if block.title:
            body.append(f"\\multicolumn{{{width}}}{{l}}{{\\emph{{{escape(block.title)}}}}} \\\\")
        body += [_row([_label(line), *_entries(table, line, published), line.seeds]) for line in block.lines]
    lines = [
        r"\begin{table}[p]",
        r"\centering",
        f"\\renewcommand{{\\thetable}}{{{escape(table.number)}}}",
        f"\\caption{{{escape(table.caption)}}}",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        f"\\begin{{tabular}}{{l{'c' * (width - 1)}}}",
        r"\toprule",
        *body,
        r"\bottomrule",
        r"\end{tabular}}",
        *_notes(table),
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def _notes(table: Built) -> list[str]:
    notes = [escape(note) for note in (*table.footnotes, *table.notes)]
    if not notes:
        return []
    text = "\\par\n".join(notes)
    return [
        r"\par\medskip",
        f"\\begin{{minipage}}{{\\linewidth}}\\footnotesize\\raggedright\n{text}\n\\end{{minipage}}",
    ]


def _heading(column: Column, arrows: bool) -> str:
    return escape(column.label) + (ARROWS[column.better] if arrows else "")


def _label(line: Line) -> str:
    told = "".join(f", {word}" for word in line.told)
    return (f"{line.latex}{escape(told)}" if line.latex else escape(line.label)) + ("*" if line.asterisk else "")


def _entries(table: Built, line: Line, published: bool) -> list[str]:
    found = []
    for column in table.columns:
        if column.key == TRACKING:
            found.append({True: r"\yes", False: r"\no", None: "---"}[line.tracking])
            continue
        cell = line.cells[column.key]
        text = _ours(cell, table.decimals)
        if published and cell.published is not None:
            text += f" \\published{{${_number(*cell.published, table.decimals)}$}}"
        found.append(text)
    return found


def _ours(cell: Cell, decimals: int) -> str:
    if cell.summary is None:
        return "---"
    if not cell.summary.n:
        return "n/a"
    text = _number(cell.summary.mean, cell.summary.std, decimals)
    return f"$\\mathbf{{{text}}}$" if cell.best else f"${text}$"


def _number(mean: float, std: float | None, decimals: int) -> str:
    return rounded(mean, decimals) + ("" if std is None else f"\\pm {rounded(std, decimals)}")


def _row(cells: Sequence[str]) -> str:
    return f"{' & '.join(cells)} \\\\"
