"""Changes of an XML text in place: all that is not changed stays as it was, byte for byte."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from semiparam_ros.errors import SemiparamError

_TAG = re.compile(rb"""(?:[^>"']|"[^"]*"|'[^']*')*>?""")
_ATTRIBUTE = re.compile(rb"""\s+([^\s=]+)\s*=\s*("[^"]*"|'[^']*')""")


@dataclass(eq=False)
class Element:
    """One element and where it stands in the text [bytes]."""

    tag: str
    attributes: dict[str, str]
    start: int
    inside: int = 0
    """End of the start tag."""
    closing: int = 0
    """Start of the end tag; that of the element's end where it is empty."""
    end: int = 0
    children: list[Element] = field(default_factory=list)

    def find(self, tag: str) -> Element | None:
        """The first child of this tag."""
        return next((child for child in self.children if child.tag == tag), None)


class Editor:
    """A text, its elements, and what is to change.

    Raises SemiparamError when it is no XML.
    """

    def __init__(self, text: str, what: str) -> None:
        self._text, self._what = text.encode(), what
        self._edits: list[tuple[int, int, bytes]] = []
        self._open: list[Element] = []
        self.root = Element('', {}, 0)
        self._parser = expat.ParserCreate('utf-8')  # whatever the text declares
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = self._finish
        try:
            self._parser.Parse(self._text, True)
        except expat.ExpatError as error:
            raise SemiparamError(f'{what} is not valid XML ({error}).') from error

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        start = self._parser.CurrentByteIndex
        if self._text[start:start + 1] != b'<':  # it stands where the entity is declared, perhaps for several
            entity = self._text[start:self._text.find(b';', start) + 1].decode(errors='replace')
            raise SemiparamError(f'{self._what} holds <{tag}> by an entity ({entity}); expected it to be written out, '
                                 'to change it in place.')
        whole = _TAG.match(self._text, start)
        element = Element(tag, attributes, start, inside=whole.end() if whole else start)
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def _finish(self, _tag: str) -> None:
        element, place = self._open.pop(), self._parser.CurrentByteIndex
        if self._is_empty(element):
            element.closing = element.end = element.inside
        else:
            element.closing, element.end = place, self._text.index(b'>', place) + 1

    def _is_empty(self, element: Element) -> bool:
        return self._text[element.inside - 2:element.inside] == b'/>'

    def set(self, element: Element, values: Mapping[str, str]) -> None:
        """Give attributes of an element new values; those that it lacks stand last."""
        tag = self._text[element.start:element.inside]
        left = dict(values)
        places = []
        for match in _ATTRIBUTE.finditer(tag):
            name = match[1].decode()
            if name in left:
                places.append((element.start + match.start(2), element.start + match.end(2),
                               quoteattr(left.pop(name)).encode()))
        end = element.inside - (2 if self._is_empty(element) else 1)
        while self._text[end - 1:end].isspace():
            end -= 1
        if left:
            added = ''.join(f' {name}={quoteattr(value)}' for name, value in left.items())
            places.append((end, end, added.encode()))
        self._edits += places

    def append(self, parent: Element, text: str) -> None:
        """Add a child at the end of an element, in a line of its own."""
        if self._is_empty(parent):
            opened = self._text[parent.start:parent.inside - 2].rstrip() + b'>'
            line = f'\n{self._indent(parent)}  {text}\n{self._indent(parent)}</{parent.tag}>'
            self._edits.append((parent.start, parent.inside, opened + line.encode()))
            return
        place = parent.closing
        while self._text[place - 1:place] in (b' ', b'\t'):
            place -= 1
        first = self._indent(parent.children[0]) if parent.children else self._indent(parent) + '  '
        line = f'{first}{text}\n' if self._text[place - 1:place] == b'\n' else text
        self._edits.append((place, place, line.encode()))

    def prepend(self, parent: Element, text: str) -> None:
        """Add a text directly behind the start tag, in a line of its own."""
        first = self._indent(parent.children[0]) if parent.children else '  '
        self._edits.append((parent.inside, parent.inside, f'\n{first}{text}'.encode()))

    def _indent(self, element: Element) -> str:
        """The white space before an element in its line, if there is nothing else."""
        line = self._text[:element.start].rpartition(b'\n')[2]
        return line.decode() if line.isspace() else ''

    def text(self) -> str:
        """Text with all changes."""
        parts, place = [], 0
        for start, end, new in sorted(self._edits, key=lambda edit: edit[:2]):
            parts += [self._text[place:start], new]
            place = end
        return b''.join([*parts, self._text[place:]]).decode()


def comment(sentences: str) -> str:
    """An XML comment, which may hold no two dashes."""
    return '<!-- ' + re.sub('-{2,}', '-', sentences).rstrip('- ') + ' -->'


def number(value: float) -> str:
    """Text of ten digits: finer than anything measured."""
    return f'{value + 0.0:.10g}'
