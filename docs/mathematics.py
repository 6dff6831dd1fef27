"""Formulas become MathML when the site is built, so that a reader needs no JavaScript for them.

`pymdownx.arithmatex` marks the formulas up, in pages and in docstrings alike. A formula that
latex2mathml cannot convert fails the build. They are set in STIX Two Math, of which the site has
the characters that they need.
"""

import importlib.resources
import re
from html import unescape
from pathlib import Path

from fontTools import subset
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<latex>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)

# The characters that formulas use: at first letters, and the slanted ones that a browser puts in
# the place of those that are names.
used = {*range(0x20, 0x7F), *range(0x391, 0x3D7), 0x210E, *range(0x1D434, 0x1D468)}
used |= {*range(0x1D6E2, 0x1D71C)}


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
    used.update(map(ord, unescape(converted)))
    return f'<div class="formula">{converted}</div>' if block else converted


def on_page_content(html, **kwargs):
    del kwargs
    return FORMULA.sub(mathml, html)


def on_post_build(config):
    options = subset.Options(flavor="woff", layout_features=["*"])
    with importlib.resources.path("ziamath.fonts", "STIXTwoMath-Regular.ttf") as whole:
        font = subset.load_font(whole, options)
    small = subset.Subsetter(options)
    small.populate(unicodes=used)
    small.subset(font)
    subset.save_font(font, Path(config.site_dir, "assets", "formulas.woff"), options)
