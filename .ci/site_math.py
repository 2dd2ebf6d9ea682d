"""A hook of mkdocs: formulas become MathML, and links of notebooks links of the site."""

import html
import posixpath
import re
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.utils import get_relative_url

_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<formula>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)


_SOURCE = re.compile(r'href="(?P<source>[\w/.-]+\.md)(?P<anchor>#[\w-]*)?"')


def on_page_content(text: str, page: Any, files: Any, **_: object) -> str:
    """The page with its formulas converted, and the links that mkdocs does not see in notebooks.

    Raises:
        PluginError: for a link to a page that there is not.
    """

    def linked(found: re.Match[str]) -> str:
        source = posixpath.join(posixpath.dirname(page.file.src_uri), found["source"])
        target = files.get_file_from_path(source)
        if target is None:
            raise PluginError(f"{page.file.src_uri}: there is no page {source}")
        return f'href="{get_relative_url(target.url, page.url)}{found["anchor"] or ""}"'

    if page.file.src_uri.endswith(".ipynb"):
        text = _SOURCE.sub(linked, text)

    def mathml(found: re.Match[str]) -> str:
        display = "block" if found["tag"] == "div" else "inline"
        return convert(html.unescape(found["formula"]), display=display)

    return _FORMULA.sub(mathml, text)
