"""Formulas become MathML when the site is built, so that a reader needs no JavaScript for them.

`pymdownx.arithmatex` marks the formulas up, in pages and in docstrings alike. A formula that
latex2mathml cannot convert fails the build. They are set in STIX Two Math, and the text in Source
Sans, of which the site has the characters that it needs: a reader fetches nothing from elsewhere.
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

# Letters of Latin alphabets, Greek ones, punctuation, digits above and below the line, signs.
TEXT = {*range(0x20, 0x180), *range(0x391, 0x3CA), *range(0x2010, 0x2027), *range(0x2070, 0x2095)}
TEXT |= set(map(ord, "′″→←↔⇒∂∆∇∈∑−∓√∞∫≈≠≡≤≥·⟨⟩…"))


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


def ship(config, package: str, file: str, characters: set[int], name: str) -> None:
    """Writes the characters of a font of a package into the site."""
    options = subset.Options(flavor="woff", layout_features=["*"])
    with importlib.resources.path(package, file) as whole:
        font = subset.load_font(whole, options)
    small = subset.Subsetter(options)
    small.populate(unicodes=characters)
    small.subset(font)
    subset.save_font(font, Path(config.site_dir, "assets", name), options)


def on_post_build(config):
    ship(config, "ziamath.fonts", "STIXTwoMath-Regular.ttf", used, "formulas.woff")
    for face in ("Regular", "It", "Bold"):
        file = f"SourceSansPro-{face}.ttf"
        ship(config, "font_source_sans_pro.files", file, TEXT, f"text-{face}.woff")
