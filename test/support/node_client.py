"""The live node as a process, and a peer that talks to it over DDS."""

import math
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from support import forked
from support.replay_peers import PATIENCE_S, ServedNode, meet

POLL_S = 0.005
RECENT = 50
"""Reports to look at: five a second from each of the nodes that talk on the topic."""
KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL, depth=1)
BEST_EFFORT = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
TYPES = {'joint_states': JointState, 'wrench': WrenchStamped, 'joint_accelerations': JointTrajectory,
         'robot_description': String, 'desired_trajectory': JointTrajectory}


class NodeProcess:
    """`semiparam run` with the parameters and ROS arguments given; ``program``: another script, from its start."""

    def __init__(self, folder, params, *ros_arguments, program=()):
        self.log = folder / 'node.log'
        self.stream = self.log.open('wb')
        environment = {**os.environ, 'OMP_NUM_THREADS': '1', 'ROS_LOG_DIR': str(folder / 'ros_log')}
        arguments = ['run', '--params', str(params), *(['--ros-args', *ros_arguments] if ros_arguments else [])]
        self.process = subprocess.Popen(
            [sys.executable, *program, *arguments], stdout=self.stream, stderr=subprocess.STDOUT, env=environment,
        ) if program else forked.start(arguments, self.stream, environment)

    def stop(self, number=signal.SIGINT):
        """Send a signal; the exit code."""
        self.process.send_signal(number)
        return self.process.wait(timeout=PATIENCE_S)

    @property
    def output(self):
        return self.log.read_text()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait(timeout=PATIENCE_S)  # the next test may have its domain
        self.stream.close()


class Client(ServedNode):
    """Publishes inputs, keeps every answer, calls services and sets parameters of one estimator."""

    def __init__(self, node='estimator', namespace=''):
        super().__init__('client', namespace=namespace, start_parameter_services=False)
        self.target, self.heard, self.outputs, self.clients = node, defaultdict(list), {}, {}

    def listen(self, kind, *topics, qos=KEEP_ALL):
        """Hear these topics, the node's own and those with a leading slash, from the next message on."""
        self.subscribe(kind, *topics, qos=qos)
        self.meet()

    def subscribe(self, kind, *topics, qos=KEEP_ALL):
        """The same without waiting until the node knows it."""
        for topic in topics:
            name = topic if topic.startswith('/') else f'{self.target}/{topic}'
            self.node.create_subscription(kind, name, self.heard[topic].append, qos)

    def offer(self, *topics, qos=KEEP_ALL):
        """Publish on these topics, as soon as the node listens."""
        for topic in topics:
            profile = LATCHED if topic == 'robot_description' else qos
            self.outputs[topic] = self.node.create_publisher(TYPES[topic], topic, profile)
        self.wait(lambda: all(output.get_subscription_count() for output in self.outputs.values()), 'the node listens')
        self.meet()

    def connect(self, outputs='wrench'):
        """Hear every answer, and the reports."""
        kind = WrenchStamped if outputs == 'wrench' else JointState
        self.subscribe(kind, f'predicted_{outputs}', f'predicted_{outputs}_std', 'residual')
        self.subscribe(JointState, 'horizon_error')
        self.subscribe(DiagnosticArray, '/diagnostics')
        self.meet()

    def meet(self):
        """Wait until the node knows every reader and writer that there is here."""
        meet(self.node, self.target, self.wait)

    def wait(self, condition, what='', timeout_s=PATIENCE_S):
        """Until a condition holds; time in which the machine stood still does not count."""
        for _ in range(round(timeout_s / POLL_S)):
            if condition():
                return
            time.sleep(POLL_S)
        raise AssertionError(f'waited in vain: {what}')

    # Inputs

    def state(self, sample, joints, **fields):
        message = JointState(name=list(joints), position=sample.position.tolist(), velocity=sample.velocity.tolist())
        set_stamp(message.header.stamp, sample.stamp)
        for name, value in fields.items():
            setattr(message, name, value)
        self.outputs['joint_states'].publish(message)

    def wrench(self, sample, frame='ft'):
        message = WrenchStamped()
        set_stamp(message.header.stamp, sample.stamp)
        message.header.frame_id = frame
        force, torque = message.wrench.force, message.wrench.torque
        force.x, force.y, force.z, torque.x, torque.y, torque.z = sample.outputs.tolist()
        self.outputs['wrench'].publish(message)

    def accelerations(self, sample, joints):
        if 'joint_accelerations' not in self.outputs:
            return
        point = JointTrajectoryPoint(accelerations=sample.acceleration.tolist())
        message = JointTrajectory(joint_names=list(joints), points=[point])
        set_stamp(message.header.stamp, sample.stamp)
        self.outputs['joint_accelerations'].publish(message)

    def play(self, samples, joints, ahead=200):
        """Publish samples with their accelerations, never more than ``ahead`` before the answers."""
        start = len(self.heard['residual'])
        for index, sample in enumerate(samples):
            self.state(sample, joints)
            self.accelerations(sample, joints)
            self.wrench(sample)
            self.wait(lambda index=index: index - (len(self.heard['residual']) - start) < ahead, 'the node follows')
        self.wait(lambda: len(self.heard['residual']) - start >= len(samples), 'every sample is answered')

    def play_at_a_pace(self, samples, joints, efforts=False):
        """Publish samples with their accelerations, 500 a second at most, and wait until the last is answered."""
        for sample in samples:
            self.accelerations(sample, joints)
            if efforts:
                self.state(sample, joints, effort=sample.outputs.tolist())
            else:
                self.state(sample, joints)
                self.wrench(sample)
            time.sleep(0.002)
        self.wait(lambda: self.stamps('residual')[-1:] == [samples[-1].stamp], 'every sample is answered')

    # Services and parameters

    def play_window(self, samples, joints, count):
        """Play so many samples, those of the initial window, and wait until the variant has taken over; the others."""
        self.play(samples[:count], joints)
        self.take_over()
        return samples[count:]

    def take_over(self):
        """Wait until the variant has its hyperparameters; samples from each window to its takeover."""
        _, _, values = self.wait_report('learning', lambda level, message, values: message.startswith('learning with')
                                        and not message.endswith('is being built.'))
        return [int(count) for count in values['samples from each window to its takeover'].split(',') if count]

    def begin(self, kind, name, request):
        """Call a service; a future of its answer."""
        key = (kind, name)
        if key not in self.clients:
            service = name if name.startswith('/') else f'{self.target}/{name}'
            self.clients[key] = self.node.create_client(kind, service)
            self.wait(self.clients[key].service_is_ready, f'service {name}')
            meet(self.node, service.rpartition('/')[0], self.wait)
        return self.clients[key].call_async(request)

    def call(self, kind, name, request):
        future = self.begin(kind, name, request)
        self.wait(future.done, f'answer of {name}')
        return future.result()

    def trigger(self, name):
        return self.call(Trigger, name, Trigger.Request())

    def pause(self, paused):
        return self.call(SetBool, 'pause_learning', SetBool.Request(data=paused))

    def get(self, *names):
        return self.call(GetParameters, 'get_parameters', GetParameters.Request(names=list(names))).values

    def describe(self, *names):
        return self.call(DescribeParameters, 'describe_parameters',
                         DescribeParameters.Request(names=list(names))).descriptors

    def set(self, **values):
        """One result for each parameter, set one after the other; double underscores stand for dots."""
        return self.call(SetParameters, 'set_parameters', SetParameters.Request(parameters=messages(values))).results

    def set_together(self, **values):
        request = SetParametersAtomically.Request(parameters=messages(values))
        return self.call(SetParametersAtomically, 'set_parameters_atomically', request).result

    # Answers

    def stamps(self, topic):
        return [stamp_of(message) for message in self.heard[topic]]

    def values(self, topic):
        return [values_of(message) for message in self.heard[topic]]

    def forget(self):
        for messages_heard in self.heard.values():
            messages_heard.clear()

    def report(self, title):
        """(level, message, values) of the node's latest report; others report on the same topic."""
        self.wait(lambda: self._reports(title), f'report {title}')
        return self._reports(title)[-1]

    def wait_report(self, title, condition, timeout_s=PATIENCE_S, heard=False):
        """The first report that fulfils a condition, from now on or, if ``heard``, since the last :meth:`forget`.

        A report that holds for a second may be followed by many others before this looks again: each is looked at.
        """
        if not heard:
            self.heard['/diagnostics'].clear()
        looked, found = 0, []

        def fulfilling():
            nonlocal looked
            new = self.heard['/diagnostics'][looked:]
            looked += len(new)
            found.extend(each for each in self._told(title, new) if condition(*each))
            return found
        self.wait(fulfilling, f'report {title}', timeout_s)
        return found[0]

    def _reports(self, title):
        """The node's latest reports, in order."""
        return self._told(title, self.heard['/diagnostics'][-RECENT:])

    def _told(self, title, heard):
        """Those of one title among what was heard."""
        name = f'{self.node.get_namespace()}/{self.target}: {title}'.lstrip('/')
        return [(status.level, status.message, {entry.key: entry.value for entry in status.values})
                for message in heard for status in message.status if status.name == name]


class Gaps:
    """The longest time [s] in which nothing was answered although something was published.

    Looked at again and again; time in which this process, or the node's main thread, was not given the machine does not
    count. How long the thread waited is known once it has run again, so a silence is measured when it is over.
    """

    LONGEST_LOOK_S = 0.05

    def __init__(self, node):
        self.worst = self._silent = 0.0
        self._node, self._delayed = node, 0.0
        self._delayed = self._delay()
        self._looked, self._answers = time.monotonic(), 0

    def _delay(self):
        """[s] that the node's main thread could have run and did not; as before once it has ended."""
        try:
            return 1e-9 * int(Path(f'/proc/{self._node.process.pid}/schedstat').read_text().split()[1])
        except FileNotFoundError:
            return self._delayed

    def look(self, published, answered):
        """So many samples so far."""
        now = time.monotonic()
        self._silent, self._looked = self._silent + min(now - self._looked, self.LONGEST_LOOK_S), now
        if published > answered == self._answers:
            return
        delayed = self._delay()
        self.worst = max(self.worst, self._silent - (delayed - self._delayed))
        self._silent, self._delayed, self._answers = 0.0, delayed, answered


class Robot:
    """A motion that goes on from one ``move`` to the next, and the check that each of its samples is answered once."""

    def __init__(self, client, samples, joints):
        self.client, self.samples, self.joints, self.played = client, samples, joints, 0

    def move(self, count):
        """So many samples, each answered in order by finite numbers."""
        self.client.play(self.samples[self.played:self.played + count], self.joints)
        self.played += count
        assert self.client.stamps('residual') == [sample.stamp for sample in self.samples[:self.played]]
        for topic in ('predicted_wrench', 'predicted_wrench_std'):
            self.client.wait(lambda topic=topic: len(self.client.heard[topic]) >= self.played, topic)
            numbers = (value for message in self.client.heard[topic][-count:] for value in values_of(message))
            assert all(math.isfinite(number) for number in numbers)


def resident_mb(process_id):
    """Memory that a process holds now [MB]."""
    status = Path(f'/proc/{process_id}/status').read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith('VmRSS')) / 1024


def children_of(process_id):
    """The processes that any thread of a process has begun."""
    threads = Path(f'/proc/{process_id}/task').iterdir()
    return [int(child) for thread in threads for child in (thread / 'children').read_text().split()]


def messages(values):
    return [item if isinstance(item, ParameterMessage) else
            Parameter(name.replace('__', '.'), value=item).to_parameter_msg()
            if not isinstance(item, ParameterValue) else ParameterMessage(name=name.replace('__', '.'), value=item)
            for name, item in values.items()]


def set_stamp(stamp, nanoseconds):
    stamp.sec, stamp.nanosec = divmod(nanoseconds, 10**9)


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def values_of(message):
    if isinstance(message, JointState):
        return list(message.effort or message.position)
    force, torque = message.wrench.force, message.wrench.torque
    return [force.x, force.y, force.z, torque.x, torque.y, torque.z]
