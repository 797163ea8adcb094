"""Topics to record: what nodes publish and subscribe to, and how to subscribe to each."""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible

from semiparam_ros.bags import schemas
from semiparam_ros.bags.qos import Qos
from semiparam_ros.ros.discovery import owner
from semiparam_ros.ros.message_types import is_installed
from semiparam_ros.ros.record.options import RecordOptions
from semiparam_ros.ros.recorded_qos import from_rclpy, subscription_qos, to_rclpy

# Every node has these; they say nothing about the robot.
HOUSEKEEPING = ('/parameter_events', '/rosout')


def find(node: Node, options: RecordOptions) -> tuple[dict[str, list[str]], list[str]]:
    """The topics to record and their types, as far as the graph knows them now, and the nodes and
    topics sought that are not there (yet)."""
    graph = dict(node.get_topic_names_and_types())
    named = [node.resolve_topic_name(topic) for topic in options.topics]
    chosen, missing = {*named, *(graph if options.everything else ())}, list[str]()
    for name in options.nodes:
        theirs = node_topics(node, name)
        chosen.update(theirs)
        missing += [] if theirs else [name]
    missing += [topic for topic in named if topic not in graph]
    kept = options.selection.of(sorted(topic for topic in chosen if topic in named or topic not in HOUSEKEEPING))
    return {topic: graph[topic] for topic in kept if topic in graph}, missing


def node_topics(node: Node, full_name: str) -> set[str]:
    """Topics that a node publishes and subscribes to; none when there is no such node."""
    namespace, _, name = full_name.rpartition('/')
    if not any((name, namespace or '/') == known for known in node.get_node_names_and_namespaces()):
        return set()
    try:
        pairs = [*node.get_publisher_names_and_types_by_node(name, namespace or '/'),
                 *node.get_subscriber_names_and_types_by_node(name, namespace or '/')]
    except NodeNameNonExistentError:  # it left between the two questions
        return set()
    return {topic for topic, _ in pairs}


def obstacle(type_name: str) -> str:
    """Reason why messages of a type cannot be recorded, '' when they can."""
    if not is_installed(type_name):
        return f'its type {type_name} is not installed'
    if not schemas.is_jazzy_type(type_name):
        return f'the definition of its type {type_name} is not among those of ROS 2 Jazzy'
    return ''


def offers(node: Node, topic: str, type_name: str) -> list[Qos]:
    """Offers of the publishers of a topic, those of other types apart."""
    return [from_rclpy(info.qos_profile) for info in node.get_publishers_info_by_topic(topic)
            if info.topic_type == type_name]


def sources(node: Node, topics: Iterable[str]) -> set[str]:
    """The nodes that publish any of these topics."""
    return {owner(info) for topic in topics for info in node.get_publishers_info_by_topic(topic)}


def best_qos(node: Node, topic: str, type_name: str) -> QoSProfile:
    """A subscription for all publishers of a topic, or before there are any, for those its subscribers expect."""
    known = offers(node, topic, type_name)
    if not known:
        wanted = [from_rclpy(info.qos_profile) for info in node.get_subscriptions_info_by_topic(topic)]
        latched = [each for each in wanted if each.latched]
        known = latched[:1] or wanted[:1]
    return to_rclpy(subscription_qos(known))


def receives_all(profile: QoSProfile, publishers: Iterable[Qos]) -> bool:
    """Tell whether a subscription matches every one of these publishers."""
    return all(qos_check_compatible(to_rclpy(each), profile)[0] != QoSCompatibility.ERROR for each in publishers)
