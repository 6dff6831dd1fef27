"""Formulas become MathML when the site is built, so that a reader needs no JavaScript for them.

`pymdownx.arithmatex` marks the formulas up, in pages and in docstrings alike. A formula that
latex2mathml cannot convert, or that nobody marked up, fails the build. They are set in STIX Two
Math, and the text in Source Sans, of which the site has the characters that it needs: a reader
fetches nothing from elsewhere.
"""

import re
from html import unescape
from importlib.metadata import distribution
from pathlib import Path

from fontTools import subset
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<latex>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)
MARKED = re.compile(r'(<math[^>]*"inline">(?:(?!</math>).)*</math>[.,:;)]+)')
VERBATIM = re.compile(r"<(pre|code|script|style)\b.*?</\1>|<[^>]*>", re.DOTALL)
LATEX = re.compile(r"\\[A-Za-z(\[{]|\$[^$]+\$")

# At first letters, and the slanted ones that a browser puts in the place of those that are names.
used = set(map(chr, [*range(0x20, 0x7F), *range(0x391, 0x3D7), 0x210E, *range(0x1D434, 0x1D468)]))
used.update(map(chr, range(0x1D6E2, 0x1D71C)))

# Letters of Latin alphabets, Greek ones, punctuation, digits above and below the line, signs.
TEXT = "--unicodes=U+20-17F,U+391-3C9,U+2010-2026,U+2032-2033,U+2070-2094,U+2190-2194,U+21D2"
TEXT += ",U+2200-22FF,U+27E8-27E9"


def mathml(match: re.Match[str]) -> str:
    # A name of several letters is upright: slanted it reads as a product.
    latex = re.sub(r"(?<![\\{\w])args\b", r"\\mathrm{args}", unescape(match["latex"]).strip())
    block = match["tag"] == "div"
    try:
        converted = convert(latex, display="block" if block else "inline")
    except Exception as error:
        raise PluginError(f"latex2mathml cannot convert {latex!r}: {error!r}") from error
    used.update(unescape(converted))
    return f'<div class="formula">{converted}</div>' if block else converted


def on_page_content(html, **kwargs):
    del kwargs
    # A line is not broken between a formula and its comma.
    return MARKED.sub(r'<span class="marked">\1</span>', FORMULA.sub(mathml, html))


def on_post_page(output, page, **kwargs):
    del kwargs
    # Also a command that latex2mathml does not know, which it leaves as it is.
    if found := LATEX.findall(unescape(VERBATIM.sub("", output))):
        raise PluginError(f"{page.file.src_uri} shows raw LaTeX: {found}")


def ship(config, package: str, file: str, characters: str, name: str) -> None:
    """Writes the characters of a font of a package into the site."""
    font = distribution(package).locate_file(file)
    out = Path(config.site_dir, "assets", name)
    options = ["--flavor=woff", "--layout-features=*", f"--output-file={out}"]
    subset.main([str(font), characters, *options])


def on_post_build(config):
    formulas = "ziamath/fonts/STIXTwoMath-Regular.ttf"
    ship(config, "ziamath", formulas, f"--text={''.join(sorted(used))}", "formulas.woff")
    for face in ("Regular", "It", "Bold"):
        file = f"font_source_sans_pro/files/SourceSansPro-{face}.ttf"
        ship(config, "font-source-sans-pro", file, TEXT, f"text-{face}.woff")
