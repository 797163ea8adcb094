"""The one table of parameters: declaration, checks, snapshot, parameter files and documentation come from it.

Add a parameter by adding a field here. Rules that tie several parameters together are in ``rules``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import Field, dataclass, field, fields
from typing import Any, TypeAlias, TypeGuard

from semiparam_ros.core.variants import CHOICES, FREQUENCIES, PRIORS

Value: TypeAlias = bool | int | float | str | tuple[str, ...] | tuple[float, ...]

KINDS = {'bool': 'bool', 'int': 'integer', 'int | str': 'integer', 'float': 'double', 'float | str': 'double',
         'str': 'string', 'tuple[str, ...]': 'string_array', 'tuple[float, ...]': 'double_array'}
"""ROS parameter type of each annotation in the table."""

EXPECTED = {'bool': 'true or false', 'integer': 'an integer', 'double': 'a number', 'string': 'a text',
            'string_array': 'a list of texts', 'double_array': 'a list of numbers'}

AUTO, OFF = 'auto', 'off'
OUTPUTS = (AUTO, 'wrench', 'effort')


@dataclass(frozen=True)
class Parameter:
    """One row of the table; ``minimum`` and ``maximum`` are inclusive and bind every item of an array.

    ``words`` are texts that stand in place of a number; ``most`` is how many items an array has at most.
    """

    name: str
    default: Value
    kind: str
    description: str
    unit: str = ''
    choices: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    most: int | None = None
    live: bool = False

    @property
    def field(self) -> str:
        """Attribute of the snapshot: the name with dots as underscores."""
        return self.name.replace('.', '_')

    @property
    def permitted(self) -> str:
        """The permitted values in words, empty when any value of the type will do."""
        count = '' if self.most is None else f'at most {self.most} of them'
        return ', '.join(filter(None, [self._permitted_values, count]))

    @property
    def _permitted_values(self) -> str:
        return ', or '.join(filter(None, [self._permitted_numbers, *self.words]))

    @property
    def _permitted_numbers(self) -> str:
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if self.minimum is not None and self.maximum is not None:
            return f'{_number(self.minimum)} to {_number(self.maximum)}'
        if self.minimum is not None:
            return f'at least {_number(self.minimum)}'
        return '' if self.maximum is None else f'at most {_number(self.maximum)}'

    def convert(self, value: object) -> object:
        """Meet the spellings of YAML and of ROS: 1 for 1.0, false for off, and empty or unset lists; anything else
        unchanged."""
        if value is False and OFF in self.choices:
            return OFF  # which YAML reads as false
        if self.kind == 'double' and _is_integer(value):
            return _as_float(value)
        if self.kind.endswith('_array'):
            return _convert_items(value, self.kind)
        return value

    def refusal(self, value: object) -> str | None:
        """A sentence saying why a (converted) value is refused, or None."""
        if isinstance(value, str) and value in self.words:
            return None
        if not _has_kind(value, self.kind):
            hint = f', {self.permitted}' if self.permitted else ''
            return f'{self.name} is {shown(value)}; expected {EXPECTED[self.kind]}{hint}.'
        items = value if isinstance(value, tuple) else (value,)
        if self.most is not None and len(items) > self.most:
            return f'{self.name} holds {len(items)} values; expected at most {self.most}.'
        for item in items:
            if not self._permits(item):
                return f'{self.name} is {shown(value)}; expected {self._wanted()}.'
        return None

    def _permits(self, item: Any) -> bool:
        if self.choices:
            return item in self.choices
        if isinstance(item, float) and not math.isfinite(item):
            return False
        above = self.minimum is None or item >= self.minimum
        return above and (self.maximum is None or item <= self.maximum)

    def _wanted(self) -> str:
        text = self._permitted_values or 'finite numbers'
        return f'{text} [{self.unit}]' if self.unit else text


def declare(name: str, default: Value, description: str, **details: object) -> Any:
    """A row of the table, written as a field of the snapshot."""
    return field(default=default, metadata={'name': name, 'description': description, **details})


def from_field(row: Field[Any]) -> Parameter:
    """Read a row back."""
    default: Any = row.default
    return Parameter(default=default, kind=KINDS[str(row.type)], **row.metadata)


def shown(value: object) -> str:
    """A value as it would stand in a parameter file, shortened."""
    text = f"'{value}'" if isinstance(value, str) else str(list(value) if isinstance(value, Sequence) else value)
    text = {'True': 'true', 'False': 'false', 'None': 'empty'}.get(text, text)
    return text if len(text) <= 80 else f'{text[:77]}...'


def _number(bound: float) -> str:
    return str(int(bound)) if bound == int(bound) else f'{bound:g}'


def _is_integer(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _convert_items(value: object, kind: str) -> object:
    if value is None:
        return ()  # ROS reads an empty list in a file as an unset value
    if isinstance(value, str | bytes | set) or not hasattr(value, '__iter__'):
        return value
    items = tuple(value)
    if kind == 'string_array':
        return () if items == ('',) else items
    return tuple(_as_float(item) if _is_integer(item) else item for item in items)


def _as_float(value: int) -> int | float:
    """The number as a float, unchanged where it is beyond all floats."""
    try:
        return float(value)
    except OverflowError:
        return value


def _has_kind(value: object, kind: str) -> bool:
    if kind.endswith('_array'):
        item = str if kind == 'string_array' else float
        return isinstance(value, tuple) and all(isinstance(entry, item) for entry in value)
    if kind == 'integer':
        return _is_integer(value)
    return isinstance(value, {'bool': bool, 'double': float, 'string': str}[kind])


@dataclass(frozen=True)
class Table:
    """Table of parameters. Field: name with dots as underscores; its metadata: the row.

    ``outputs`` is never ``auto`` here: what it stands for follows from ``sensor_frame``.
    """

    def __post_init__(self) -> None:
        if self.outputs == AUTO:
            object.__setattr__(self, 'outputs', 'wrench' if self.sensor_frame else 'effort')

    # Robot
    robot_description_file: str = declare(
        'robot_description_file', '', 'URDF file: a path, or package://PACKAGE/PATH. A relative path counts from the '
        'parameter file, else from the working folder. Empty: robot_description, the latched topic robot_description, '
        'or the one recorded in the bag.')
    robot_description: str = declare(
        'robot_description', '', 'The URDF itself as text. Empty: see robot_description_file.')
    joints: tuple[str, ...] = declare(
        'joints', (), 'Moving joints, in the order of the inputs. Empty: every moving joint of the URDF that is not '
        'locked.')
    sensor_frame: str = declare(
        'sensor_frame', '', 'Link or fixed joint of the URDF that carries the force/torque sensor. Empty: there is '
        'none.')
    outputs: str = declare(
        'outputs', AUTO, 'What is predicted: the wrench at the sensor frame, or the effort of every joint. auto: the '
        'wrench where sensor_frame is given, else the efforts.', choices=OUTPUTS)
    output_joints: tuple[str, ...] = declare(
        'output_joints', (), 'Of joints, those whose efforts are predicted; the others, such as a passive one or a '
        'gripper, are inputs only, and their efforts may be missing. With outputs effort alone. Empty: all of them.')
    temperatures: tuple[str, ...] = declare(
        'temperatures', (), 'Whose temperatures are taken from the topic temperature, by the frame_id of its messages: '
        'joints, where efforts are predicted; with a wrench one name, that of its sensor there. Empty: none, and the '
        'topic is not listened to.')
    wrench_convention: str = declare(
        'wrench_convention', 'action', 'Whether the measured wrench acts on the distal links (action) or is their '
        'reaction on the sensor (reaction).', choices=('action', 'reaction'))
    locked_joints_names: tuple[str, ...] = declare(
        'locked_joints.names', (), 'Joints held at the posture given in locked_joints.positions; joints named neither '
        'here nor in joints are held at 0.')
    locked_joints_positions: tuple[float, ...] = declare(
        'locked_joints.positions', (), 'One position for each of locked_joints.names.', unit='rad')

    # Model
    variant: str = declare(
        'variant', 'SPK-ML', 'Model variant: rigid body (P), random features (NP), rigid body as the mean (SP, SP2) '
        'or in the kernel (SPK); hyperparameters by marginal likelihood (ML) or validation set (VS). auto: several of '
        'them side by side, averaged by their running evidence.', choices=CHOICES, live=True)
    shadow_variants: tuple[str, ...] = declare(
        'shadow_variants', (), 'Variants that learn beside the active one, to compare their horizon errors.',
        choices=CHOICES, live=True)
    effects: tuple[str, ...] = declare(
        'effects', (), "Declared effects, each 'kind' or 'kind@where', optionally followed by {json} with values that "
        'a diagnosis found.', most=200, live=True)
    effects_reference: tuple[float, ...] = declare(
        'effects_reference', (), 'Base parameters that predict the load on which effects such as load_friction depend; '
        'a diagnosis writes them. Empty: those of the robot description.', most=1000, live=True)
    joint_friction: bool = declare(
        'joint_friction', True, 'With outputs effort, viscous and dry friction, rotor inertia and an offset of every '
        "output joint are part of the rigid body's model. false: the rigid body alone, as in the paper.", live=True)
    priors: str = declare(
        'priors', PRIORS[0], 'What is held of the model before anything is measured. physical: the inertias are near '
        'the robot description, as far as the robot is large; random features explain no more than the rigid body '
        'leaves, and the rigid body alone is averaged with them. paper: inertias have one variance about zero, and '
        'nothing else is held.', choices=PRIORS, live=True)
    learning: bool = declare('learning', True, 'Learn from every sample; false: predict only.', live=True)
    learn_every: int = declare(
        'learn.every', 1, 'Of the samples to learn, after the initial window, each so-many-th is learnt; all are '
        'answered. For fast robots, whose next sample tells little more.', minimum=1, maximum=1000)
    learn_least_gain: float = declare(
        'learn.least_gain', 0.0, 'A sample that tells the model less than this, by how sure it is of its answer, is '
        'answered but not learnt. 0: all are learnt.', unit='nat', minimum=0.0, maximum=100.0)
    forgetting: float | str = declare(
        'forgetting', 'auto', 'auto: the model forgets nothing, and what it leaves is followed by an offset that '
        'wanders at the pace that is seen. Or a forgetting factor for each sample: 1.0 forgets nothing, 0.999 has a '
        'memory of about 1000 samples.', minimum=0.5, maximum=1.0, words=('auto',), live=True)
    noise: str = declare(
        'noise', 'output', 'One standard deviation of the noise for all outputs, or one for each output.',
        choices=('one', 'output'), live=True)
    initial_samples: int = declare(
        'initial.samples', 1000, 'Samples of motion in the initial window, from which the hyperparameters are '
        'estimated. Of the samples of one step of 4 ms it takes the first: at 1 kHz a thousand last four seconds.',
        minimum=20, maximum=1000000)

    # Random features
    features_count: int | str = declare(
        'features.count', 200, 'Number D of random features (cosines and sines, hence even). auto: the fewest, up to '
        '500, that explain the initial window as well as 500.', minimum=2, maximum=20000, words=('auto',))
    features_seed: int = declare('features.seed', 0, 'Seed of the random frequencies.', minimum=0, maximum=2**31 - 1)
    features_frequencies: str = declare(
        'features.frequencies', FREQUENCIES[0], 'How the random frequencies are drawn. orthogonal: rows of random '
        'rotations, which need fewer features for the same kernel; independent: as in the paper.',
        choices=FREQUENCIES)
    features_length_scales: str = declare(
        'features.length_scales', 'kind', 'One length scale for all inputs, one for each kind (position, velocity, '
        'acceleration), or one for each input.', choices=('one', 'kind', 'input'))

    # Hyperparameters
    hyperparameters_gamma: tuple[float, ...] = declare(
        'hyperparameters.gamma', (), 'Prior standard deviation of the base parameters (one value). Empty, here and '
        'below: estimated from the initial window.', minimum=0.0)
    hyperparameters_rho: tuple[float, ...] = declare(
        'hyperparameters.rho', (), 'Prior standard deviation of the non-parametric part, in output scales (one value).',
        minimum=0.0)
    hyperparameters_tau: tuple[float, ...] = declare(
        'hyperparameters.tau', (), 'Length scales in units of input_scale: 1, 3 or one for each input, as '
        'features.length_scales says.', minimum=1e-9)
    hyperparameters_sigma: tuple[float, ...] = declare(
        'hyperparameters.sigma', (), 'Standard deviation of the noise, in output scales (one value).', minimum=1e-12)
    hyperparameters_autocorrelation_time: tuple[float, ...] = declare(
        'hyperparameters.autocorrelation_time', (),
        'Samples that tell as much of the rigid body as one would if noise did not stay '
        'alike for a while (one value); empty: 1.', minimum=1.0)
    hyperparameters_output_scale: tuple[float, ...] = declare(
        'hyperparameters.output_scale', (), 'Scale of each output.', unit='N, N m', minimum=1e-12)
    hyperparameters_pi: tuple[float, ...] = declare(
        'hyperparameters.pi', (), 'Base parameters that are the fixed mean of SP and SP2.')
    hyperparameters_input_mean: tuple[float, ...] = declare(
        'hyperparameters.input_mean', (), 'Mean of each input: positions, then velocities, then accelerations.',
        unit='rad, rad/s, rad/s^2')
    hyperparameters_input_scale: tuple[float, ...] = declare(
        'hyperparameters.input_scale', (), 'Scale of each input.', unit='rad, rad/s, rad/s^2', minimum=1e-12)

    # Horizon error
    horizon_length: int = declare(
        'horizon.length', 25, 'Length T of the horizon error. The time that a sample takes grows with it.',
        unit='samples', minimum=1, maximum=1000, live=True)

    # Time
    alignment_tolerance: float = declare(
        'alignment.tolerance', 0.02, 'Largest distance from a wrench to the joint state it is matched with; between '
        'two joint states the inputs are interpolated.', unit='s', minimum=0.0, maximum=10.0)
    acceleration_source: str = declare(
        'acceleration.source', 'auto', 'Accelerations measured on joint_accelerations, or filtered from the '
        'velocities; auto: measured where that topic is published.', choices=('auto', 'measured', 'filter'))
    acceleration_cutoff: float = declare(
        'acceleration.cutoff', 5.0, 'Cut-off frequency of the causal acceleration filter.', unit='Hz', minimum=1e-3,
        maximum=1e5)

    # Contact gate
    gate_enabled: bool = declare(
        'gate.enabled', False, 'Do not learn from samples that the model finds implausible, such as contacts.',
        live=True)
    gate_false_alarms_per_hour: float = declare(
        'gate.false_alarms_per_hour', 2.0, 'How often the gate may close in an hour of free motion. The thresholds '
        'follow, from the innovations of free motion; fewer false alarms mean that small contacts are missed.',
        unit='1/h', minimum=1e-3, maximum=3600.0, live=True)
    gate_hold: float = declare(
        'gate.hold', 0.2, 'The gate opens again when the innovations have been as usual for so long.', unit='s',
        minimum=0.0, maximum=60.0, live=True)
    gate_timeout: float = declare(
        'gate.timeout', 5.0, 'A gate closed for longer opens: the robot has changed, it is not touched. 0: never.',
        unit='s', minimum=0.0, maximum=1e6, live=True)

    # Forces from outside
    external_wrench_frame: str = declare(
        'external_wrench.frame', '', 'Link at whose origin, and along whose axes, ~/external_wrench is told. Empty: '
        'the sensor_frame, or without one the last link that the efforts feel.', live=True)
    compensated_wrench_time_constant: float = declare(
        'compensated_wrench.time_constant', 0.5, 'Within it ~/compensated_wrench follows a tare, a tool that is '
        'declared, or another model: it never jumps by itself. 0: at once.', unit='s', minimum=0.0, maximum=3600.0,
        live=True)
    tools: tuple[str, ...] = declare(
        'tools', (), 'Known bodies that the arm carries and that are not to be learnt: each \'LINK {"mass": kg, '
        '"centre": [x, y, z], "inertia": [ixx, ixy, ixz, iyy, iyz, izz]}\', centre in the frame of the link, inertia '
        'about the centre, or a piece of URDF. A minus before it: one that was taken off.', most=100, live=True)

    # What is told of the model
    parameters_consistent: bool = declare(
        'parameters.consistent', False, 'Tell inertial parameters that bodies can have, as near to the learnt ones as '
        'these allow: on ~/parameters, ~/payload and in the status parameters. Predictions stay as they are.',
        live=True)

    # Feedforward
    feedforward_before_ready: str = declare(
        'feedforward.before_ready', 'withhold', 'What answers desired_trajectory until the initial window is over: '
        'nothing but a refusal, or the robot description alone.', choices=('withhold', 'description'), live=True)

    # Node
    queue_depth: int = declare(
        'queue_depth', 0, 'Messages kept for each input topic while the node is busy; 0 keeps 20000.', minimum=0,
        maximum=100000)
    reliability: str = declare(
        'reliability', 'auto', 'Reliability asked of the input topics; auto: reliable, until a publisher offers only '
        'best_effort.', choices=('auto', 'reliable', 'best_effort'))
    realtime_priority: int = declare(
        'realtime_priority', 0, 'Priority by which the node runs before everything without one (SCHED_FIFO), for '
        'robots of several hundred samples a second; the system must permit it. 0: none.', minimum=0, maximum=99)
    retained_samples: int = declare(
        'retained.samples', 60000, 'Latest samples kept, beside the initial window, to build another variant or to '
        'diagnose.', minimum=0, maximum=10000000)
    diagnosis_window: float = declare(
        'diagnosis.window', 300.0, 'Span of the latest samples that ~/diagnose looks at, as far as they are retained.',
        unit='s', minimum=1.0, maximum=1e6, live=True)
    diagnosis_auto: str = declare(
        'diagnosis.auto', 'report', 'What follows when the robot changes while it works. report: the '
        'change is told on ~/change, named in the background, and written to changes.jsonl in '
        'state_folder. apply: what was named is then tried beside the model, predicts with it from the moment on at '
        'which the outputs speak for it, and is taken back when it is over. off: nobody looks for changes.',
        choices=('off', 'report', 'apply'), live=True)
    state_file: str = declare(
        'state_file', 'semiparam_state.npz', 'File of save_state and load_state: a plain name in state_folder.',
        live=True)
    state_folder: str = declare(
        'state_folder', '', 'Folder of all states and checkpoints. A relative path counts from the parameter file that '
        'gives it, else from the working folder. Empty: $ROS_HOME/semiparam, with ~/.ros where ROS_HOME is not set.')
    checkpoint_period: float = declare(
        'checkpoint.period', 0.0, 'The node saves its state by itself this often, and when it ends. 0: never.',
        unit='s', minimum=0.0, maximum=86400.0)
    checkpoint_resume: bool = declare(
        'checkpoint.resume', False, 'Go on from the newest checkpoint when the node starts.')


PARAMETERS: tuple[Parameter, ...] = tuple(from_field(row) for row in fields(Table))
BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}

# use_sim_time and its kind belong to every ROS node; they stand in parameter files beside ours.
ROS_NAMES = ('use_sim_time', 'start_type_description_service')
ROS_PREFIXES = ('qos_overrides.',)
