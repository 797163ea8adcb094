"""Another DDS vendor's node, without a line of ROS: Eclipse Cyclone DDS speaks to the estimator on the wire.

Run inside a network namespace of its own: ``counterpart_cyclone.py BAG PARAMS OUT.json`` starts the estimator, plays
the bag to it as a robot's driver would, receives its predictions, and works on its parameters as a tuning tool would.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import annotations as annotate
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

PATIENCE_S = 60.0
AHEAD = 50
BOOL, DOUBLE, STRING = 1, 3, 4
COMMON = (Policy.Reliability.Reliable(duration(seconds=5)), Policy.History.KeepAll,
          Policy.DataRepresentation(use_cdrv0_representation=True))


@dataclass
@annotate.final
class Time(IdlStruct, typename='builtin_interfaces.msg.dds_.Time_'):
    sec: idl.int32 = 0
    nanosec: idl.uint32 = 0


@dataclass
@annotate.final
class Header(IdlStruct, typename='std_msgs.msg.dds_.Header_'):
    stamp: Time = field(default_factory=Time)
    frame_id: str = ''


@dataclass
@annotate.final
class String(IdlStruct, typename='std_msgs.msg.dds_.String_'):
    data: str = ''


@dataclass
@annotate.final
class JointState(IdlStruct, typename='sensor_msgs.msg.dds_.JointState_'):
    header: Header = field(default_factory=Header)
    name: idl.sequence[str] = field(default_factory=list)
    position: idl.sequence[idl.float64] = field(default_factory=list)
    velocity: idl.sequence[idl.float64] = field(default_factory=list)
    effort: idl.sequence[idl.float64] = field(default_factory=list)


@dataclass
@annotate.final
class Vector3(IdlStruct, typename='geometry_msgs.msg.dds_.Vector3_'):
    x: idl.float64 = 0.0
    y: idl.float64 = 0.0
    z: idl.float64 = 0.0


@dataclass
@annotate.final
class Wrench(IdlStruct, typename='geometry_msgs.msg.dds_.Wrench_'):
    force: Vector3 = field(default_factory=Vector3)
    torque: Vector3 = field(default_factory=Vector3)


@dataclass
@annotate.final
class WrenchStamped(IdlStruct, typename='geometry_msgs.msg.dds_.WrenchStamped_'):
    header: Header = field(default_factory=Header)
    wrench: Wrench = field(default_factory=Wrench)


@dataclass
@annotate.final
class ParameterValue(IdlStruct, typename='rcl_interfaces.msg.dds_.ParameterValue_'):
    type: idl.uint8 = 0
    bool_value: bool = False
    integer_value: idl.int64 = 0
    double_value: idl.float64 = 0.0
    string_value: str = ''
    byte_array_value: idl.sequence[idl.uint8] = field(default_factory=list)
    bool_array_value: idl.sequence[bool] = field(default_factory=list)
    integer_array_value: idl.sequence[idl.int64] = field(default_factory=list)
    double_array_value: idl.sequence[idl.float64] = field(default_factory=list)
    string_array_value: idl.sequence[str] = field(default_factory=list)


@dataclass
@annotate.final
class Parameter(IdlStruct, typename='rcl_interfaces.msg.dds_.Parameter_'):
    name: str = ''
    value: ParameterValue = field(default_factory=ParameterValue)


@dataclass
@annotate.final
class SetParametersResult(IdlStruct, typename='rcl_interfaces.msg.dds_.SetParametersResult_'):
    successful: bool = False
    reason: str = ''


@dataclass
@annotate.final
class ListParametersResult(IdlStruct, typename='rcl_interfaces.msg.dds_.ListParametersResult_'):
    names: idl.sequence[str] = field(default_factory=list)
    prefixes: idl.sequence[str] = field(default_factory=list)


@dataclass
@annotate.final
class ListParameters_Request(IdlStruct, typename='rcl_interfaces.srv.dds_.ListParameters_Request_'):
    prefixes: idl.sequence[str] = field(default_factory=list)
    depth: idl.uint64 = 0


@dataclass
@annotate.final
class ListParameters_Response(IdlStruct, typename='rcl_interfaces.srv.dds_.ListParameters_Response_'):
    result: ListParametersResult = field(default_factory=ListParametersResult)


@dataclass
@annotate.final
class SetParameters_Request(IdlStruct, typename='rcl_interfaces.srv.dds_.SetParameters_Request_'):
    parameters: idl.sequence[Parameter] = field(default_factory=list)


@dataclass
@annotate.final
class SetParameters_Response(IdlStruct, typename='rcl_interfaces.srv.dds_.SetParameters_Response_'):
    results: idl.sequence[SetParametersResult] = field(default_factory=list)


@dataclass
@annotate.final
class GetParameters_Request(IdlStruct, typename='rcl_interfaces.srv.dds_.GetParameters_Request_'):
    names: idl.sequence[str] = field(default_factory=list)


@dataclass
@annotate.final
class GetParameters_Response(IdlStruct, typename='rcl_interfaces.srv.dds_.GetParameters_Response_'):
    values: idl.sequence[ParameterValue] = field(default_factory=list)


NOTHING = {ListParameters_Request: ListParameters_Request(['no parameter has this prefix']),
           SetParameters_Request: SetParameters_Request(), GetParameters_Request: GetParameters_Request()}


def wait(condition, what):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f'waited in vain: {what}')
        time.sleep(0.005)


class Vendor:
    """One participant: writers and readers by ROS topic name, and clients of ROS services."""

    def __init__(self, domain):
        self.participant = DomainParticipant(domain)
        self.heard, self.readers = {}, {}

    def writer(self, name, kind, *policies):
        return DataWriter(self.participant, Topic(self.participant, name, kind), Qos(*COMMON, *policies))

    def reader(self, name, kind):
        self.readers[name] = DataReader(self.participant, Topic(self.participant, name, kind), Qos(*COMMON))
        self.heard[name] = []
        return self.readers[name]

    def take(self, name):
        """Everything received so far."""
        self.heard[name] += self.readers[name].take(N=1000)
        return self.heard[name]

    def call(self, service, request, response, empty):
        """The reply of `/estimator/SERVICE` to a request, one call at a time.

        The service may still be unaware of a reader that already knows it, and its reply is lost then: a request that
        does nothing is repeated until it is answered. What answers those says nothing (``empty`` tells).
        """
        ask = self.writer(f'rq/estimator/{service}Request', type(request))
        reply = f'rr/estimator/{service}Reply'
        reader = self.reader(reply, response)
        wait(lambda: ask.get_matched_subscriptions() and reader.get_matched_publications(), service)
        asked = 0.0

        def greeted():
            nonlocal asked
            if time.monotonic() > asked + 1.0:
                ask.write(NOTHING[type(request)])
                asked = time.monotonic()
            return self.take(reply)
        wait(greeted, f'any reply of {service}')
        ask.write(request)
        wait(lambda: [each for each in self.take(reply) if not empty(each)], f'a reply of {service}')
        return next(each for each in self.heard[reply] if not empty(each))

    def list_parameters(self):
        response = self.call('list_parameters', ListParameters_Request(), ListParameters_Response,
                             lambda reply: not reply.result.names)
        return list(response.result.names)

    def set_parameter(self, name, value):
        response = self.call('set_parameters', SetParameters_Request([Parameter(name, value)]),
                             SetParameters_Response, lambda reply: not reply.results)
        return [response.results[0].successful, response.results[0].reason]

    def get_parameters(self, *names):
        response = self.call('get_parameters', GetParameters_Request(list(names)), GetParameters_Response,
                             lambda reply: not reply.values)
        return response.values


def stamp(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def header(theirs):
    return Header(Time(theirs.stamp.sec, theirs.stamp.nanosec), theirs.frame_id)


def joint_state(data):
    return JointState(header(data.header), list(data.name), list(data.position), list(data.velocity), [])


def wrench(data):
    force, torque = data.wrench.force, data.wrench.torque
    return WrenchStamped(header(data.header), Wrench(Vector3(force.x, force.y, force.z),
                                                     Vector3(torque.x, torque.y, torque.z)))


def drive(vendor, bag):
    """Play the bag to the estimator; stamp and predicted wrench of every answer."""
    from semiparam_ros.bags.reader import open_bag
    latched = vendor.writer('rt/robot_description', String, Policy.Durability.TransientLocal)
    writers = {'/joint_states': (vendor.writer('rt/joint_states', JointState), joint_state),
               '/wrench': (vendor.writer('rt/wrench', WrenchStamped), wrench)}
    predicted = 'rt/estimator/predicted_wrench'
    reader = vendor.reader(predicted, WrenchStamped)
    wait(lambda: all(writer.get_matched_subscriptions() for writer, _ in writers.values()), 'subscriptions')
    with open_bag(bag) as recording:
        messages = list(recording.messages())
    latched.write(String(next(each.data.data for each in messages if each.topic == '/robot_description')))
    wait(reader.get_matched_publications, 'the predictions')
    # Its reply proves that the estimator knows the reader, which is older than the client.
    vendor.list_parameters()
    sent = 0
    for each in messages:
        if each.topic in writers:
            writer, convert = writers[each.topic]
            sent += each.topic == '/wrench'
            wait(lambda sent=sent: sent - len(vendor.take(predicted)) < AHEAD, 'answers')
            writer.write(convert(each.data))
    wait(lambda: len(vendor.take(predicted)) >= sent, 'the last answers')
    return [[stamp(each.header), [each.wrench.force.x, each.wrench.force.y, each.wrench.force.z,
                                  each.wrench.torque.x, each.wrench.torque.y, each.wrench.torque.z]]
            for each in vendor.heard[predicted]]


def tune(vendor):
    """List, set, set wrongly in four ways, and read back."""
    wanted = [('forgetting', ParameterValue(DOUBLE, double_value=0.999)), ('learning', ParameterValue(BOOL)),
              ('forgetting', ParameterValue(DOUBLE, double_value=7.0)),
              ('forgetting', ParameterValue(STRING, string_value='little')),
              ('variant', ParameterValue(STRING, string_value='SPQ-ML')),
              ('forgeting', ParameterValue(DOUBLE, double_value=1.0))]
    listed = vendor.list_parameters()
    results = [vendor.set_parameter(name, value) for name, value in wanted]
    values = vendor.get_parameters('forgetting', 'learning', 'variant')
    return {'listed': listed, 'results': results,
            'values': [values[0].double_value, values[1].bool_value, values[2].string_value]}


def main(bag, params, out):
    log = Path(out).with_suffix('.log').open('wb')
    node = subprocess.Popen([sys.executable, '-m', 'semiparam_ros.cli.main', 'run', '--params', params],
                            stdout=log, stderr=subprocess.STDOUT)
    try:
        vendor = Vendor(int(os.environ['ROS_DOMAIN_ID']))
        result = {'answers': drive(vendor, bag), **tune(vendor)}
    finally:
        node.send_signal(signal.SIGINT)
        code = node.wait(PATIENCE_S)
    told = re.findall(r'(\d+) samples after the end of the initial window', Path(log.name).read_text())
    takeovers = [int(count) for count in told] or [len(result['answers'])]
    Path(out).write_text(json.dumps({**result, 'exit': code, 'takeovers': takeovers}))


if __name__ == '__main__':
    main(*sys.argv[1:])
    # All is written. The binding's finalisers race with Cyclone's threads and now and then corrupt the heap.
    os._exit(0)
