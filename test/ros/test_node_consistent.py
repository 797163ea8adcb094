"""Bodies that can be, of a running node: ~/parameters, ~/payload and the status."""

import json
from dataclasses import replace

import numpy as np
from geometry_msgs.msg import InertiaStamped
from std_msgs.msg import String

from semiparam_ros.ros.estimator.publishers import LATCHED
from support.node_helpers import JOINTS, SETTINGS, motion


def test_a_node_tells_bodies_that_can_be_once_it_is_asked_to(start_node):
    settings = replace(SETTINGS, acceleration_source='measured', variant='P',
                       parameters_consistent=True)
    _, client = start_node(settings)
    client.listen(String, 'parameters', qos=LATCHED)
    client.listen(InertiaStamped, 'payload', 'payload_std')
    client.offer('joint_states', 'joint_accelerations', 'wrench')
    _, _, values = client.wait_report('parameters',
                                      lambda level, message, values: 'consistent' in values)
    assert 'holds no model yet' in values['consistent']
    samples = motion(400)
    client.play(client.play_window(samples, JOINTS, 60), JOINTS)
    client.wait_report('parameters', lambda level, message, values:
                       values.get('consistent', '').startswith('yes, of the model ')
                       and 'kg at ft' in values['payload'])
    (document, *_) = client.heard['parameters'][-1:]
    links = json.loads(document.data)['links']
    for link in links.values():
        moments = np.linalg.eigvalsh(link['inertia'])
        assert link['mass'] > 0.0 and moments[0] > 0.0 and moments[0] + moments[1] > moments[2]
    told = client.heard['payload'][-1].inertia
    inertia = np.array([[told.ixx, told.ixy, told.ixz], [told.ixy, told.iyy, told.iyz],
                        [told.ixz, told.iyz, told.izz]])
    assert np.isnan(inertia).all() == np.isnan(told.com.x)
    moments = np.linalg.eigvalsh(inertia)
    assert np.isnan(told.com.x) or (moments[0] > 0.0 and moments[0] + moments[1] > moments[2])

    assert client.set(parameters__consistent=False)[0].successful
    client.wait_report('parameters', lambda level, message, values: 'consistent' not in values)
    # the stamp of the answer that it is of, not of the clock; and never without its deviations
    client.wait(lambda: client.stamps('payload')[-1] == samples[-1].stamp, 'the load of the latest answer')
    client.wait(lambda: client.stamps('payload_std') == client.stamps('payload'), 'deviations of each')
    assert set(client.stamps('payload')) <= {sample.stamp for sample in samples}
    assert min(message.inertia.m for message in client.heard['payload_std']) > 0.0
    assert client.set(variant='NP-ML', parameters__consistent=True)[1].successful
    client.take_over()
    _, _, values = client.wait_report('parameters', lambda level, message, values:
                                      'learns no inertial' in values.get('consistent', ''))
    assert values['payload'].startswith('withheld')
    errors = client.wait_report('errors', lambda level, message, values: True)[2]
    assert errors['internal errors'] == '0'
