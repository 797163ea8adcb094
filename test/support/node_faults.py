"""Every kind of bad message, thrown at a live node between good ones, by a seeded choice."""

import random
import struct
from collections import Counter
from contextlib import suppress

from rclpy.serialization import serialize_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from support.node_client import TYPES

NAN, INFINITE = float('nan'), float('inf')
LARGEST, SMALLEST = 1.7976931348623157e308, 5e-324
FIRST_STAMP_NS, LAST_STAMP = -2**31 * 10**9, (2**31 - 1, 2**32 - 1)
"""Of the types that a header's stamp has."""
GAP_NS = 100_000_000
ANSWERS = ('predicted_wrench', 'predicted_wrench_std', 'residual')
CHECK_EVERY = 500
COUNTED_WITHIN_S = 60.0
"""What DDS lost it repeats after three seconds, and a busy machine takes its time."""


def with_gaps(samples, every=10):
    """The same samples, a tenth of a second missing before every tenth, too long for a wrench in between."""
    return [sample._replace(stamp=sample.stamp + index // every * GAP_NS) for index, sample in enumerate(samples)]


def counts_in(values):
    """Messages that a node refused or ignored so far, by reason, from the figures of its report on inputs."""
    return Counter({name.partition(': ')[2]: int(value) for name, value in values.items()
                    if name.startswith(('refused: ', 'ignored: '))})


class Fuzzer:
    """Publishes good samples, and bad messages of all kinds among them. ``kinds``: name to (reason, how)."""

    def __init__(self, client, joints, first_stamp, seed):
        self.client, self.joints, self.first_stamp = client, list(joints), first_stamp
        self.chance, self.thrown, self.last = random.Random(seed), Counter(), None
        one, (a, *_) = self.joints[:1], self.joints
        strangers = [f'j{number}' for number in range(100)]
        self.kinds = {
            'NaN position': ('not_finite', lambda sample: self.state(sample, position=[NAN, 0.0])),
            'infinite velocity': ('not_finite', lambda sample: self.state(sample, velocity=[0.0, INFINITE])),
            'velocity of 1e160': ('out_of_range', lambda sample: self.state(sample, velocity=[1e160, 0.0])),
            'joint missing': ('missing_joint', lambda sample: client.state(sample, one, position=[0.0],
                                                                           velocity=[0.0])),
            'joint twice': ('missing_joint', lambda sample: client.state(sample, [a, a])),
            'no joint': ('missing_joint', lambda sample: client.state(sample, [], position=[], velocity=[])),
            'a hundred joints, not ours': ('other_joints', lambda sample: client.state(
                sample, strangers, position=[0.0] * 100, velocity=[0.0] * 100)),
            'no velocities': ('wrong_length', lambda sample: self.state(sample, velocity=[])),
            'too many positions': ('wrong_length', lambda sample: self.state(sample, position=[0.0] * 3)),
            'joint state of the past': ('backward_stamp', lambda sample: self.state(self.past(sample))),
            'joint state again': ('duplicate_stamp', lambda sample: self.state(self.again(sample))),
            'joint state, cut bytes': ('joint_states', lambda sample: self.torn(
                'joint_states', TYPES['joint_states'](name=self.joints))),
            'NaN force': ('not_finite', lambda sample: self.wrench(sample, 0, NAN)),
            'infinite torque': ('not_finite', lambda sample: self.wrench(sample, 5, -INFINITE)),
            'force of 1e300 N': ('out_of_range', lambda sample: self.wrench(sample, 2, 1e300)),
            'wrench in another frame': ('wrong_frame', lambda sample: client.wrench(sample, frame='elsewhere')),
            'wrench in no frame': ('wrong_frame', lambda sample: client.wrench(sample, frame='')),
            'wrench of the past': ('backward_stamp', lambda sample: client.wrench(self.past(sample))),
            'wrench again': ('duplicate_stamp', lambda sample: client.wrench(self.again(sample))),
            'wrench, cut bytes': ('wrench', lambda sample: self.torn('wrench', TYPES['wrench']())),
            'wrench without a joint state': ('unmatched', lambda sample: client.wrench(self.between(sample))),
            'NaN acceleration': ('not_finite', lambda sample: self.accelerations(sample, [[NAN, 1.0]])),
            'acceleration of -1e160': ('out_of_range', lambda sample: self.accelerations(sample, [[-1e160, 1.0]])),
            'no point': ('wrong_length', lambda sample: self.accelerations(sample, [])),
            'two points': ('wrong_length', lambda sample: self.accelerations(sample, [[0.0, 0.0]] * 2)),
            'acceleration missing': ('wrong_length', lambda sample: self.accelerations(sample, [[0.0]])),
            'acceleration of one joint': ('missing_joint', lambda sample: self.accelerations(sample, [[0.0]], one)),
            'acceleration of the past': ('backward_stamp', lambda sample: client.accelerations(self.past(sample),
                                                                                               joints)),
            'position of the largest double': ('out_of_range', lambda sample: self.state(
                sample, position=[LARGEST, 0.0])),
            'velocity of minus the largest double': ('out_of_range', lambda sample: self.state(
                sample, velocity=[0.0, -LARGEST])),
            'force of the largest double': ('out_of_range', lambda sample: self.wrench(sample, 0, LARGEST)),
            'acceleration of the largest double': ('out_of_range', lambda sample: self.accelerations(
                sample, [[LARGEST, -LARGEST]])),
            'the smallest doubles, again': ('duplicate_stamp', lambda sample: self.state(
                self.again(sample), position=[SMALLEST, -0.0], velocity=[-SMALLEST, 0.0])),
            'efforts at the ends of doubles, again': ('duplicate_stamp', lambda sample: self.state(
                self.again(sample), effort=[NAN, -INFINITE])),
            'joint state of the first stamp': ('backward_stamp', lambda sample: self.state(
                sample._replace(stamp=FIRST_STAMP_NS))),
            'wrench of the first stamp': ('backward_stamp', lambda sample: client.wrench(
                sample._replace(stamp=FIRST_STAMP_NS))),
            'joint state of the last stamp': ('out_of_range', lambda sample: self.stamped(
                'joint_states', TYPES['joint_states'](name=self.joints, position=[0.0] * 2, velocity=[0.0] * 2))),
            'wrench of the last stamp': ('out_of_range', lambda sample: self.stamped('wrench', TYPES['wrench']())),
            'a joint without a name': ('missing_joint', lambda sample: client.state(sample, ['', self.joints[1]])),
            'wrench in a frame of 2000 letters': ('wrong_frame', lambda sample: client.wrench(
                sample, frame='f' * 2000)),
            'joint state, a name that is no text': ('missing_joint', lambda sample: self.changed(
                'joint_states', TYPES['joint_states'](name=self.joints), b'a\0', b'\xff\0')),
            'wrench, a frame that is no text': ('wrong_frame', lambda sample: self.changed(
                'wrench', self.framed(), b'ft\0', b'\xc3\x28\0')),
            'joint state, 2^32 - 1 names': ('joint_states', lambda sample: self.counted(2**32 - 1)),
            'joint state, 2^27 names': ('joint_states', lambda sample: self.counted(2**27)),
            'acceleration again': ('duplicate_stamp', lambda sample: client.accelerations(self.again(sample), joints)),
        }

    def throw(self, sample, bad):
        """So many bad messages, then a good sample whose topics come in any order, its joints in any order too."""
        for name in self.choose(sample, bad):
            self.thrown[name] += 1
            self.kinds[name][1](sample)
        good = [lambda: self.shuffled_state(sample), lambda: self.client.accelerations(sample, self.joints),
                lambda: self.client.wrench(sample)]
        self.chance.shuffle(good)
        for publish in good:
            publish()
        self.last = sample

    def choose(self, sample, bad):
        """Kinds that are possible now; the wrench in a gap comes last, so that stamps before it stay duplicates."""
        names = list(self.kinds)
        if self.last is None:
            # Without a sample before it there is no stamp to repeat, and velocities may be missing from all messages.
            names = [name for name in names if 'again' not in name and 'past' not in name and name != 'no velocities']
        gap = self.last is not None and sample.stamp - self.last.stamp >= GAP_NS
        names.remove('wrench without a joint state')
        chosen = self.chance.sample(names, bad)
        return [*chosen[1:], 'wrench without a joint state'] if gap else chosen

    def rejections(self):
        """How often the node must have refused for each reason."""
        counts = Counter()
        for name, count in self.thrown.items():
            if name in self.kinds:
                counts[self.kinds[name][0]] += count
        return dict(counts)

    def shuffled_state(self, sample):
        """Joints in any order, at times with one that is not ours."""
        order = self.chance.sample(range(len(self.joints)), len(self.joints))
        names = [self.joints[index] for index in order]
        position, velocity = sample.position[order].tolist(), sample.velocity[order].tolist()
        self.thrown['joints in another order'] += names != self.joints
        if self.chance.random() < 0.1:
            self.thrown['a further joint, with NaN'] += 1
            names, position, velocity = [*names, 'finger'], [*position, NAN], [*velocity, NAN]
        self.client.state(sample, names, position=position, velocity=velocity)

    def state(self, sample, **fields):
        self.client.state(sample, self.joints, **fields)

    def wrench(self, sample, index, value):
        outputs = sample.outputs.copy()
        outputs[index] = value
        self.client.wrench(sample._replace(outputs=outputs))

    def accelerations(self, sample, points, joints=None):
        message = JointTrajectory(joint_names=joints or self.joints,
                                  points=[JointTrajectoryPoint(accelerations=point) for point in points])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(sample.stamp, 10**9)
        self.client.outputs['joint_accelerations'].publish(message)

    def torn(self, topic, message):
        """The beginning of a message's bytes."""
        data = serialize_message(message)
        self.client.outputs[topic].publish(data[:self.chance.randrange(6, len(data) // 2)])

    def changed(self, topic, message, old, new):
        """The bytes of a message, some of them replaced."""
        data = serialize_message(message)
        assert old in data
        self.client.outputs[topic].publish(data.replace(old, new, 1))

    def counted(self, count):
        """A joint state that says it has so many names."""
        self.changed('joint_states', TYPES['joint_states'](name=self.joints), struct.pack('<I', len(self.joints)),
                     struct.pack('<I', count))

    def stamped(self, topic, message):
        message.header.stamp.sec, message.header.stamp.nanosec = LAST_STAMP
        message.header.frame_id = 'ft'
        self.client.outputs[topic].publish(message)

    def framed(self):
        message = TYPES['wrench']()
        message.header.frame_id = 'ft'
        return message

    def past(self, sample):
        return sample._replace(stamp=self.chance.choice([5, 0, -10**9, self.first_stamp - 1]))

    def again(self, sample):
        return sample._replace(stamp=self.last.stamp)

    def between(self, sample):
        return sample._replace(stamp=self.last.stamp + GAP_NS // 2)


def counts_of(client, wanted):
    """What the node says that it has refused, one report after all is there, for what is too much comes later."""
    def complete(level, message, values):
        said = counts_in(values)
        return all(said[reason] == count for reason, count in wanted.items())
    with suppress(AssertionError):  # the caller compares
        client.wait_report('inputs', complete, COUNTED_WITHIN_S)
    client.heard['/diagnostics'].clear()
    said = counts_in(client.report('inputs')[2])
    return {reason: (said[reason], count) for reason, count in wanted.items()}


def tell_thrown(fuzzer, invalid_requests, counted):
    """Print how often each kind was thrown and what the node says that it has refused."""
    thrown = fuzzer.thrown + invalid_requests.thrown
    print('| thrown | times | answer |\n|---|---|---|')
    for name in [*fuzzer.kinds, *sorted(thrown.keys() - fuzzer.kinds.keys())]:
        reason = fuzzer.kinds[name][0] if name in fuzzer.kinds else invalid_requests.answers.get(name, 'answered')
        print(f'| {name} | {thrown[name]} | {f"`{reason}`" if reason in counted else reason} |')
    print(f'\n{sum(thrown.values())} altogether. Counted by the node, and thrown:')
    for reason, (found, wanted) in sorted(counted.items()):
        print(f'    {reason:20}{found:8}{wanted:8}{"" if found == wanted else "   DIFFERENT"}')
    for sentence in invalid_requests.wrong:
        print(f'NOT ANSWERED AS IT MUST BE: {sentence}')
