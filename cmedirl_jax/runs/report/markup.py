"""The pieces of a report's pages in HTML; a page needs no other file."""

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; margin: 0 auto; max-width: 66rem;
  padding: 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.5rem; } h3 { font-size: 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.9rem; }
th, td { border-bottom: 1px solid #ddd; padding: 0.3rem 0.5rem; text-align: left;
  vertical-align: top; }
td.number { text-align: right; } td.number, td.name { white-space: nowrap; }
small { color: #555; display: block; }
figure { margin: 2rem 0; overflow-x: auto; } figure img { height: auto; max-width: 100%; }
figure img.broad { min-width: 40rem; }
figcaption { color: #555; font-size: 0.9rem; }
details { margin: 0.3rem 0; } pre { overflow-x: auto; font-size: 0.8rem; }
dl { font-size: 0.9rem; } dt { font-weight: 600; } dd { color: #555; margin: 0 0 0.3rem 1rem; }
.supported { color: #006b4d; } .not { color: #a03000; } .other { color: #555; }
"""


def document(title: str, parts: Iterable[str]) -> str:
    """A page of some parts; empty ones are left out."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{text(title)}</title><style>{_STYLE}</style></head><body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body></html>\n"
    )


def text(value: object) -> str:
    """A value as text."""
    return html.escape(str(value))


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of cells that `name`, `number` and `interval` made; it scrolls where it is wide."""
    lines = ["".join(f"<th>{text(head)}</th>" for head in heads), *map("".join, rows)]
    return f'<div class="wide"><table>{"".join(f"<tr>{line}</tr>" for line in lines)}</table></div>'


def name(value: str, below: str | None = None) -> str:
    """A cell with a name, and words below it."""
    small = f"<small>{text(below)}</small>" if below else ""
    return f'<td class="name">{text(value)}{small}</td>'


def number(value: float | None, form: str = "{:.2f}") -> str:
    """A cell with a number; - where there is none."""
    return f'<td class="number">{"-" if value is None else form.format(value)}</td>'


def interval(values: Sequence[float | None], form: str = "{:.2f}") -> str:
    """A cell with a number and the bounds of its interval, ? for one that is not known."""
    value, *ends = values
    if value is None:
        return number(None)
    bounds = ", ".join("?" if bound is None else form.format(bound) for bound in ends)
    return f'<td class="number">{form.format(value)}<small>[{bounds}]</small></td>'


def definitions(words: Mapping[str, str]) -> str:
    """What names mean, folded away."""
    lines = "".join(f"<dt>{text(name)}</dt><dd>{text(said)}</dd>" for name, said in words.items())
    return f"<details><summary>what these are</summary><dl>{lines}</dl></details>"


def figure(path: Path, caption: str) -> str:
    """A PNG file with its caption; nothing if it is gone."""
    if not path.is_file():
        return ""
    content = path.read_bytes()
    data = base64.b64encode(content).decode()
    # A PNG's width stands in its header. Text is as large in every figure, and a broad figure
    # scrolls on a narrow screen.
    width = int.from_bytes(content[16:20], "big")
    broad = ' class="broad"' if width > 1_200 else ""
    return (
        f'<figure><img{broad} width="{width * 16 // 25}" src="data:image/png;base64,{data}" '
        f'alt="{text(caption)}">'
        f"<figcaption>{text(caption)}</figcaption></figure>"
    )
