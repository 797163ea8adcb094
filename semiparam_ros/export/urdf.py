"""A robot description with identified inertias, friction and damping, and loads as fixed links."""

from __future__ import annotations

from collections.abc import Mapping
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.identified import CarriedBody, Identified
from semiparam_ros.export.xml_edit import Editor, Element, comment, number

UNCHANGED = 1e-9
"""Relative change of a link's parameters that is rounding."""
AXES = ('ixx', 'ixy', 'iyy', 'ixz', 'iyz', 'izz')


def described_links(urdf: str) -> dict[str, Array]:
    """Parameters (10,) of links with an inertial: m, m c and inertia about the link's origin.

    Raises SemiparamError when the text is no URDF.
    """
    editor = Editor(urdf, 'the robot description')
    links: dict[str, Array] = {}
    for link in editor.root.children:
        inertial = link.find('inertial') if link.tag == 'link' else None
        if inertial is not None:
            links[link.attributes.get('name', '')] = _read(inertial)
    return links


def _read(inertial: Element) -> Array:
    origin, mass, inertia = (inertial.find(tag) for tag in ('origin', 'mass', 'inertia'))
    if mass is None or inertia is None:
        raise SemiparamError('the robot description has an inertial without mass or inertia.')
    place = {} if origin is None else origin.attributes
    centre, turn = (np.array(place.get(name, '0 0 0').split(), dtype=float)
                    for name in ('xyz', 'rpy'))
    xx, xy, yy, xz, yz, zz = (float(inertia.attributes[name]) for name in AXES)
    rotation = pin.rpy.rpyToMatrix(*turn)
    about_centre = rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
    weight = float(mass.attributes['value'])
    shift = centre @ centre * np.eye(3) - np.outer(centre, centre)
    about_origin = (about_centre + weight * shift)[np.tril_indices(3)]
    return np.concatenate([[weight], weight * centre, about_origin])


def identified_urdf(urdf: str, found: Identified, remark: str) -> str:
    """The description with what was found; comments, order and all else stay.

    :param remark: how it was made, for a comment.
    """
    editor = Editor(urdf, 'the robot description')
    named = {(each.tag, each.attributes.get('name', '')): each for each in editor.root.children}
    for name in changed_links(found):
        inertial = named['link', name].find('inertial')
        assert inertial is not None  # it had a mass
        _write(editor, inertial, found.links[name])
    dynamics: dict[str, dict[str, str]] = {}
    for each in found.joints:
        if each.name != 'armature':
            dynamics.setdefault(each.joint, {})[each.name] = number(each.value)
    for joint, values in dynamics.items():
        element = named['joint', joint].find('dynamics')
        if element is not None:
            editor.set(element, values)
        else:
            editor.append(named['joint', joint], _tag('dynamics', values))
    taken = {name for _, name in named}
    for load in found.loads:
        for element_text in _load_elements(load, taken):
            editor.append(editor.root, element_text)
    editor.prepend(editor.root, comment(remark))
    return editor.text()


def changed_links(found: Identified) -> list[str]:
    """Names of the links whose parameters are no longer the description's."""
    return [name for name, values in found.links.items()
            if not np.allclose(values, found.described[name], rtol=0.0,
                               atol=UNCHANGED * float(np.linalg.norm(found.described[name])))]


def _write(editor: Editor, inertial: Element, parameters: Array) -> None:
    """Write new numbers for an inertial, in the axes of its link."""
    values = inertial_values(CarriedBody('', parameters, 0.0))
    for tag, attributes in values.items():
        element = inertial.find(tag)
        if element is None:
            editor.append(inertial, _tag(tag, attributes))
        else:
            editor.set(element, attributes)


def inertial_values(body: CarriedBody) -> dict[str, dict[str, str]]:
    """The elements of an inertial with their attributes."""
    inertia = body.inertia[np.tril_indices(3)]  # xx, xy, yy, xz, yz, zz
    return {'origin': {'xyz': ' '.join(map(number, body.centre)), 'rpy': '0 0 0'},
            'mass': {'value': number(body.mass)},
            'inertia': dict(zip(AXES, map(number, inertia), strict=True))}


def _load_elements(load: CarriedBody, taken: set[str]) -> list[str]:
    """A link with the load's inertial, and the joint that fixes it; their names are taken then."""
    name = f'payload_{load.link}'
    while name in taken or f'{name}_joint' in taken:
        name += '_'
    taken |= {name, f'{name}_joint'}
    inertial = ''.join(_tag(tag, values) for tag, values in inertial_values(load).items())
    own, joint, carrier = (quoteattr(text) for text in (name, f'{name}_joint', load.link))
    return [f'<link name={own}><inertial>{inertial}</inertial></link>',
            f'<joint name={joint} type="fixed"><parent link={carrier}/>'
            f'<child link={own}/><origin xyz="0 0 0" rpy="0 0 0"/></joint>']


def _tag(tag: str, attributes: Mapping[str, str]) -> str:
    return f'<{tag} ' + ' '.join(f'{name}="{value}"' for name, value in attributes.items()) + '/>'
