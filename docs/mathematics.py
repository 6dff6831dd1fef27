"""Formulas become MathML when the site is built, so that a reader needs no JavaScript for them.

`pymdownx.arithmatex` marks the formulas up, in pages and in docstrings alike. A formula that
latex2mathml cannot convert fails the build.
"""

import re
from html import unescape

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<latex>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)


def mathml(match: re.Match[str]) -> str:
    # A name of several letters is upright: slanted it reads as a product.
    latex = re.sub(r"(?<![\\{\w])args\b", r"\\mathrm{args}", unescape(match["latex"]).strip())
    block = match["tag"] == "div"
    try:
        converted = convert(latex, display="block" if block else "inline")
    except Exception as error:
        raise PluginError(f"latex2mathml cannot convert {latex!r}: {error!r}") from error
    # latex2mathml leaves a command that it does not know as it is, and the dollars between two
    # formulas that no empty line separates.
    if re.search(r"[\\$]", unescape(converted)):
        raise PluginError(f"latex2mathml does not know all of {latex!r}: {converted}")
    return f'<div class="formula">{converted}</div>' if block else converted


def on_page_content(html, **kwargs):
    del kwargs
    return FORMULA.sub(mathml, html)
