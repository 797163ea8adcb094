"""A MuJoCo model of the identified robot, written by MuJoCo itself."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.identified import Identified
from semiparam_ros.export.xml_edit import Editor, comment

GEOMETRY = ('visual', 'collision')


def identified_mjcf(urdf: str, found: Identified, remark: str) -> str:
    """Convert the identified URDF. Shapes, whose files may not be there, are left out.

    Raises SemiparamError when MuJoCo cannot read it, and ModuleNotFoundError where MuJoCo is not
    installed.
    """
    import mujoco

    try:
        spec = mujoco.MjSpec.from_string(without_geometry(urdf))
        for each in found.joints:
            if each.name == 'armature':
                spec.joint(each.joint).armature = each.value
        spec.compile()
        text = spec.to_xml()
    except ValueError as error:
        reason = ' '.join(str(error).split())
        raise SemiparamError(f'MuJoCo cannot read the robot description: {reason}') from error
    editor = Editor(text, 'the MuJoCo model')
    editor.prepend(editor.root, comment(remark))
    return editor.text()


def without_geometry(urdf: str) -> str:
    """The links and joints of a description, which MuJoCo takes as they are; what moves without a
    mass gets a trace."""
    robot = ElementTree.fromstring(urdf)
    for link in robot.findall('link'):
        for name in GEOMETRY:
            for part in link.findall(name):
                link.remove(part)
    for part in [part for part in robot if part.tag not in ('link', 'joint')]:
        robot.remove(part)
    options = ElementTree.SubElement(ElementTree.SubElement(robot, 'mujoco'), 'compiler')
    options.attrib |= {'fusestatic': 'false', 'boundmass': '1e-9', 'boundinertia': '1e-12'}
    return ElementTree.tostring(robot, encoding='unicode')
