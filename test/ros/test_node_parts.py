"""The layouts for plotting tools name topics and fields that exist."""

import json
import re
import xml.etree.ElementTree as ElementTree

from semiparam_ros.ros.estimator.publishers import HorizonMessage

AXES = ('fx', 'fy', 'fz', 'tx', 'ty', 'tz')
WRENCHES = ('/wrench', '/estimator/predicted_wrench', '/estimator/residual')


def test_the_foxglove_layout_plots_what_the_node_publishes(repository):
    layout = json.loads((repository / 'config' / 'foxglove_layout.json').read_text())
    names = HorizonMessage(AXES, wrench=True).names
    curves = [path for panel in layout['configById'].values() for path in panel.get('paths', ())]
    assert len(curves) == 22
    for curve in curves:
        wrench = re.fullmatch(r'(/[\w/]+)\.wrench\.(force|torque)\.[xyz]', curve['value'])
        horizon = re.fullmatch(r'/estimator/horizon_error\.position\[(\d+)\]', curve['value'])
        assert (wrench and wrench[1] in WRENCHES) or horizon, curve
        if horizon:
            label = curve['label'].replace(', mean removed', '_centred')
            assert names[int(horizon[1])] == label
    assert set(panels(layout['layout'])) == set(layout['configById'])


def panels(tree):
    return [tree] if isinstance(tree, str) else panels(tree['first']) + panels(tree['second'])


def test_the_plotjuggler_layout_plots_what_the_node_publishes(repository):
    root = ElementTree.parse(repository / 'config' / 'plotjuggler_layout.xml').getroot()
    names = HorizonMessage(AXES, wrench=True).names
    curves = [curve.get('name') for curve in root.iter('curve')]
    assert len(curves) == 22
    for curve in curves:
        horizon = re.fullmatch(r'/estimator/horizon_error/(\w+)/position', curve)
        wrench = re.fullmatch(r'(/[\w/]+)/wrench/(force|torque)/[xyz]', curve)
        assert (horizon and horizon[1] in names) or (wrench and wrench[1] in WRENCHES), curve
