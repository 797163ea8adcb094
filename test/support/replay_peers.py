"""The other side of replay and record tests: the tools as processes, and nodes in this one that talk to them."""

import os
import signal
import threading
import time

import rclpy
from rcl_interfaces.srv import GetParameters
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.ros.message_types import message_class
from support import forked

SECOND = 10**9
START = 1_700_000_000 * SECOND
WRENCH, STATES, TEXT = 'geometry_msgs/msg/WrenchStamped', 'sensor_msgs/msg/JointState', 'std_msgs/msg/String'
PATIENCE_S = 240.0

EVERYTHING = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=1, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def stamp(k, rate_hz):
    return START + k * SECOND // rate_hz


def fields(ns):
    return {'stamp': {'sec': ns // SECOND, 'nanosec': ns % SECOND}, 'frame_id': 'sensor'}


def write_robot(path, count, rate_hz=100, **topics):
    """A bag of ``count`` joint states and wrenches at equal stamps, with a latched description before them."""
    with BagWriter(path, chunk_bytes=4096) as bag:
        bag.write('/robot_description', TEXT, {'data': '<robot name="arm"/>'}, START)
        for topic, qos in topics.items():
            bag.add_topic(f'/{topic}', WRENCH if topic == 'wrench' else STATES, qos)
        for k in range(count):
            now = stamp(k, rate_hz)
            bag.write('/joint_states', STATES, {'header': fields(now), 'name': ['a', 'b'], 'position': [k * 0.1, 1.0]},
                      now)
            bag.write('/wrench', WRENCH, {'header': fields(now), 'wrench': {'force': {'x': float(k)}}}, now)
    return path


class Tool:
    """`semiparam ...` as a process of its own; whatever it says goes to a file."""

    def __init__(self, tmp_path, *arguments):
        self.log = tmp_path / f'{arguments[0]}-{time.monotonic_ns()}.log'
        with self.log.open('wb') as log:
            self.process = forked.start([*map(str, arguments)], log, {**os.environ, 'COLUMNS': '400'})

    def wait(self):
        """The exit code."""
        return self.process.wait(PATIENCE_S)

    def said(self, text):
        return text in self.output

    @property
    def output(self):
        return self.log.read_text()

    def interrupt(self, number=signal.SIGINT):
        self.process.send_signal(number)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def meet(node, other, wait_for):
    """Wait until another node knows every reader and writer of this one.

    Participants learn of each other's readers, and of the writers, in the order in which these were made. A call with a
    writer of requests and a reader of answers of its own is answered once the other knows both, and so all that was
    made before. An answer that is sent before its reader is known is lost: it is asked for again.
    """
    client, calls, due = node.create_client(GetParameters, f'{other}/get_parameters'), [], 0.0

    def answered():
        nonlocal due
        if client.service_is_ready() and time.monotonic() > due:
            calls.append(client.call_async(GetParameters.Request()))
            due = time.monotonic() + 1.0
        return any(call.done() for call in calls)

    wait_for(answered, f'{other} knows {node.get_name()}')


class ServedNode:
    """A node in this process, with a context of its own and a thread that serves it."""

    def __init__(self, name, domain=None, **options):
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, domain_id=domain,
                   signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
        self.node = rclpy.create_node(name, context=self.context, **options)
        self.executor = EventsExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.closing = False
        self.thread = threading.Thread(target=self._spin, daemon=True)

    def _spin(self):
        while not self.closing:
            self.executor.spin_once(timeout_sec=0.1)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.closing = True
        self.thread.join()
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


class Peer(ServedNode):
    """Keeps what it receives in ``heard[topic]``."""

    def __init__(self, name='peer', domain=None):
        super().__init__(name, domain)
        self.heard, self.clients, self.changed = {}, {}, threading.Condition()

    def listen(self, topic, type_name, qos=EVERYTHING, raw=False):
        heard = self.heard.setdefault(topic, [])

        def receive(message):
            with self.changed:
                heard.append(message)
                self.changed.notify_all()
        self.node.create_subscription(message_class(type_name), topic, receive, qos, raw=raw)

    def answer(self, topic, type_name, answers='~/residual', refuses=lambda count: False, depth=100):
        """Answer every message on ``topic`` with itself, but those whose number ``refuses`` says."""
        heard = self.heard.setdefault(topic, [])
        output = self.node.create_publisher(message_class(type_name), answers, EVERYTHING)

        def receive(raw):
            heard.append(raw)
            if not refuses(len(heard)):
                self._publish(output, raw)
        self.node.create_subscription(message_class(type_name), topic, receive, depth, raw=True)

    def _publish(self, output, raw):
        """Again while the listener's queue is full, of which DDS tells after a tenth of a second."""
        while not self.closing:
            try:
                return output.publish(raw)
            except RuntimeError:  # RCLError, which rclpy does not export
                pass

    def wait_for(self, condition, what=''):
        """Until ``condition()`` holds, looked at whenever a message arrives and now and then."""
        looks = round(PATIENCE_S / 0.05)  # counted, so that time in which the machine stood still is none
        with self.changed:
            while not condition():
                assert looks, what or {topic: len(each) for topic, each in self.heard.items()}
                looks -= not self.changed.wait(0.05)

    def meet(self, other):
        """Wait until a node knows every writer of this one: messages sent before may come seconds late."""
        meet(self.node, other, self.wait_for)

    def call(self, kind, service, request=None):
        """The response of one service call. One that is sent before the client's reader is known is lost."""
        if service not in self.clients:
            self.clients[service] = self.node.create_client(kind, service)
            self.meet(service.rpartition('/')[0])
        client = self.clients[service]
        assert client.wait_for_service(PATIENCE_S), service
        future = client.call_async(request or kind.Request())
        self.wait_for(future.done, service)
        return future.result()
