"""Changes of an XML text in place."""

import xml.etree.ElementTree as ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.xml_edit import Editor, comment, number

TEXT = """<?xml version="1.0" encoding="latin-1"?>
<!-- Größe: über allem -->
<robot name='r' >
\t<link name="a>b"><mass  value = '1.0' unit="kg"/></link>  <!-- <mass value="9"/> -->\r
  <joint name="j"/>
</robot>
<!-- after -->
"""


def test_nothing_changed_is_the_same_text():
    assert Editor(TEXT, 'it').text() == TEXT


def test_values_change_and_all_around_stays():
    editor = Editor(TEXT, 'it')
    link, joint = editor.root.children
    editor.set(link.children[0], {'value': '2', 'more': 'a "b"'})
    editor.append(joint, '<dynamics damping="1"/>')
    expected = TEXT.replace('value = \'1.0\' unit="kg"/>', 'value = "2" unit="kg" more=\'a "b"\'/>')
    expected = expected.replace(
        '  <joint name="j"/>', '  <joint name="j">\n    <dynamics damping="1"/>\n  </joint>'
    )
    assert editor.text() == expected


def test_children_are_added_in_lines_of_their_own():
    editor = Editor('<a>\n    <b>\n      <c/>\n    </b>\n</a>', 'it')
    editor.append(editor.root.children[0], '<d/>')
    editor.append(editor.root, '<e/>')
    editor.prepend(editor.root, comment('how -- made -'))
    assert editor.text() == (
        '<a>\n    <!-- how - made -->\n    <b>\n      <c/>\n      <d/>\n    </b>\n    <e/>\n</a>'
    )


@given(st.text(st.characters(blacklist_categories=('Cs', 'Cc')), max_size=30), st.floats(-1e6, 1e6))
def test_any_value_can_be_written_and_read(text, value):
    editor = Editor('<a>é<b c="x"/></a>', 'it')
    editor.set(editor.root.children[0], {'c': text, 'd': number(value)})
    root = ElementTree.fromstring(editor.text())
    assert root.find('b').get('c') == text and root.text == 'é'
    assert float(root.find('b').get('d')) == pytest.approx(value, rel=1e-9, abs=1e-9)


@given(st.text(max_size=40))
def test_any_sentence_can_be_a_comment(text):
    kept = ''.join(letter for letter in text if letter.isprintable())
    ElementTree.fromstring(f'<a>{comment(kept)}</a>')


def test_elements_of_an_entity_are_refused():
    """Its attributes were written into the end tag behind it: the file was no XML any more."""
    text = '<!DOCTYPE r [<!ENTITY body "<mass value=\'1\'/>">]><r><link>&body;</link></r>'
    with pytest.raises(SemiparamError, match=r'the model holds <mass> by an entity \(&body;\); expected it to be'):
        Editor(text, 'the model')


def test_what_is_no_xml_is_refused():
    with pytest.raises(SemiparamError, match='the robot description is not valid XML'):
        Editor('<robot>', 'the robot description')
