"""A hook of mkdocs: formulas become MathML, which browsers show without anything loaded."""

import html
import re

from latex2mathml.converter import convert

_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<formula>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)


def on_page_content(text: str, **_: object) -> str:
    """The page with its formulas converted."""

    def mathml(found: re.Match[str]) -> str:
        display = "block" if found["tag"] == "div" else "inline"
        return convert(html.unescape(found["formula"]), display=display)

    return _FORMULA.sub(mathml, text)
