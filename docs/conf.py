"""How Sphinx makes a site of the documents: `make docs`."""

from __future__ import annotations

import re
from importlib.metadata import version as _version
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from pygments.lexers.special import TextLexer

project = "orthocapture"
version = release = _version("orthocapture")
html_title = f"orthocapture {release}"
html_theme = "furo"
html_static_path: list[str] = []
html_copy_source = False
html_show_sphinx = False
extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["generate", "screens"]


def _math(visitor: Any, node: nodes.Element) -> None:
    """Formulas as MathML, which browsers draw by themselves: the site fetches nothing from elsewhere."""
    block = isinstance(node, nodes.math_block)
    visitor.body.append(tex2mathml(node.astext(), as_block=block))
    raise nodes.SkipNode


_RESULT = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+bench/results/[^)]+)\)")


def _offer_results(_app: Any, _page: str, source: list[str]) -> None:
    """Turn links to bench/results, which lies outside the site, into downloads; in the repository they are links."""
    source[0] = _RESULT.sub(r"{download}`\1 <\2>`", source[0])


def setup(app: Any) -> None:
    """Register how formulas, results and Mermaid diagrams (which this site shows as text) are rendered."""
    app.connect("source-read", _offer_results)
    app.add_html_math_renderer("mathml", (_math, None), (_math, None))
    app.add_lexer("mermaid", TextLexer)


html_math_renderer = "mathml"
