"""A hook of mkdocs: the links of notebooks, which mkdocs neither sees nor looks up."""

import posixpath
import re
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.utils import get_relative_url

_SOURCE = re.compile(r'href="(?P<source>[\w/.-]+\.md)(?P<anchor>#[\w-]*)?"')


def on_page_content(text: str, page: Any, files: Any, **_: object) -> str:
    """The page with its links to sources as links to pages.

    Raises:
        PluginError: for a link to a page that there is not.
    """
    if not page.file.src_uri.endswith(".ipynb"):
        return text

    def linked(found: re.Match[str]) -> str:
        source = posixpath.join(posixpath.dirname(page.file.src_uri), found["source"])
        target = files.get_file_from_path(source)
        if target is None:
            raise PluginError(f"{page.file.src_uri}: there is no page {source}")
        return f'href="{get_relative_url(target.url, page.url)}{found["anchor"] or ""}"'

    return _SOURCE.sub(linked, text)
