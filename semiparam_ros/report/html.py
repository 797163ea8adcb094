"""HTML pages from the templates of this package, with matplotlib figures inside as SVG."""

from __future__ import annotations

import io
import re
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import matplotlib
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup
from matplotlib.figure import Figure

# Colours that no figure uses otherwise; the page replaces them, so that one picture serves light and dark.
INK, FAINT = '#010203', '#010204'
_PAGE_COLOURS = {INK: 'currentColor', FAINT: 'var(--faint)'}

PLAIN: Any = {'parse_math': False}
"""Properties of a text with the name of a joint or a link, whose dollars are no formula."""

# Any, because the type of matplotlib's keys differs between its versions
STYLE: Any = {
    'svg.fonttype': 'none', 'font.family': 'sans-serif', 'font.size': 9.0, 'axes.edgecolor': FAINT,
    'axes.labelcolor': INK, 'axes.titlecolor': INK, 'axes.titlesize': 10.0, 'axes.titlelocation': 'left',
    'axes.spines.top': False, 'axes.spines.right': False, 'xtick.color': INK, 'ytick.color': INK, 'text.color': INK,
    'grid.color': FAINT, 'grid.linewidth': 0.6, 'axes.grid': True, 'axes.axisbelow': True, 'legend.frameon': False,
    'lines.linewidth': 1.3, 'figure.constrained_layout.use': True,
}


def environment() -> Environment:
    """Templates in which everything is escaped and a missing value is an error."""
    return Environment(loader=PackageLoader('semiparam_ros', 'report/templates'), undefined=StrictUndefined,
                       autoescape=select_autoescape(default=True, default_for_string=True), trim_blocks=True,
                       lstrip_blocks=True)


class Picture(NamedTuple):
    """A figure and the caption that says what to see."""

    title: str
    svg: Markup
    caption: str


def picture(title: str, name: str, figure: Figure, caption: str) -> Picture:
    """A figure as it stands on a page. :param name: unique on the page."""
    return Picture(title, Markup(inline_svg(figure, name, title.replace('"', ''))), caption)


def page_style() -> AbstractContextManager[None]:
    """Figures made within look like the page."""
    return matplotlib.rc_context(STYLE)


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """An <svg> element to stand inside HTML.

    :param name: unique on the page; the same figure always gives the same text. :param description: for readers who
        do not see it.
    """
    stream = io.StringIO()
    with matplotlib.rc_context({**STYLE, 'svg.hashsalt': name}):
        figure.savefig(stream, format='svg', transparent=True, metadata={'Date': None, 'Creator': None})
    text = stream.getvalue()
    text = text[text.index('<svg'):]
    text = re.sub(r'<metadata>.*?</metadata>', '', text, flags=re.DOTALL)
    for colour, replacement in _PAGE_COLOURS.items():
        text = text.replace(colour, replacement)
    text = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', text)
    text = re.sub(r'(url\(#|href="#)', rf'\1{name}-', text)
    # the width is the page's affair; the view box keeps the proportions
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r'\1', re.sub(r'(<svg[^>]*?) height="[^"]*"', r'\1', text, count=1),
                  count=1)
    return text.replace('<svg', f'<svg role="img" aria-label="{description}"', 1)
