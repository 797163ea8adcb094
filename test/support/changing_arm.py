"""A simulated arm that changes while it works: a load from one time to another, a push, a jump of
the sensor."""

from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.settings import Settings
from semiparam_ros.simulation.arm import Arm
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate, true_arm
from support.arms import noisy
from support.learner_stage import Stage
from support.node_helpers import InlineBackground

SETTINGS = Settings(outputs='wrench', variant='P', initial_samples=200)
SECONDS = 130.0
LOADED_S = 70.0, 100.0
CALM = 1380
"""So many samples most recordings have in common, before anything happens."""


@lru_cache(maxsize=8)
def _recording(load: bool, seed: int):
    return simulate(_scenario(load, seed))


def _scenario(load: bool, seed: int):
    effects = (EffectRequest('payload', size=2.0, start_s=0.0),) if load else ()
    return Scenario(motion='mixed', samples=round(SECONDS * 20), seed=seed, effects=effects)


def free(seed=3):
    """The body, and its samples as nothing happens."""
    return _free(seed)


@lru_cache(maxsize=8)
def _free(seed):
    found = _recording(False, seed)
    return body_of(found), samples_of(found)


def described(seed=3):
    """Settings of the arm that hold its description."""
    found = _recording(False, seed)
    return replace(
        SETTINGS,
        robot_description=found.urdf,
        joints=tuple(found.joint_names),
        sensor_frame=found.frame_id,
        wrench_convention=found.convention,
    )


def heavier(times, samples, seed=3):
    """The body of an arm so many times as heavy, and samples of which all outputs are so large."""
    found = _recording(False, seed)
    tree = ElementTree.fromstring(found.urdf)
    for element in [*tree.iter('mass'), *tree.iter('inertia')]:
        for name, value in element.attrib.items():
            element.set(name, repr(times * float(value)))
    body = RigidBody.from_urdf(
        ElementTree.tostring(tree, encoding='unicode'),
        found.joint_names,
        'wrench',
        found.frame_id,
        found.convention,
    )
    return body, replace(samples, outputs=times * samples.outputs)


def loaded(between=LOADED_S, seed=3):
    """The same with a load between two times [s], and its mass [kg]."""
    (body, samples), with_it = free(seed), _recording(True, seed)
    inside = (samples.time >= between[0]) & (samples.time < between[1])
    outputs = np.where(inside[:, None], samples_of(with_it).outputs, samples.outputs)
    return body, replace(samples, outputs=outputs), with_it.truth[0]['parameters']['mass']['value']


def pushed(start=70.0, seconds=5.0, newton=15.0, seed=3, force=None):
    """The same while a hand pushes the last link, by a ``force`` (3,) [N] or so many newtons."""
    found, (body, samples) = _recording(False, seed), free(seed)
    arm = Arm.from_urdf(found.urdf, found.joint_names, 'wrench', found.frame_id, found.convention)
    rise = np.clip(np.minimum(samples.time - start, start + seconds - samples.time) / 0.4, 0.0, 1.0)
    sway = 1.0 + 0.2 * np.sin(4.4 * (samples.time - start))
    along = newton * np.array([0.6, -0.7, 0.39]) if force is None else np.array(force)
    force = (rise * sway)[:, None] * along
    change = arm.load_of_force(arm.pose(arm.tip, samples.position), force, samples.position)
    return body, replace(samples, outputs=samples.outputs + change)


def caught(start=70.0, stiffness=20.0, seed=3):
    """The same with a spring, as of a cable, that holds the last link from a time [s] on."""
    found, (body, samples) = _recording(False, seed), free(seed)
    arm = Arm.from_urdf(found.urdf, found.joint_names, 'wrench', found.frame_id, found.convention)
    pose = arm.pose(arm.tip, samples.position)
    force = -stiffness * (pose.place - pose.place.mean(axis=0) - np.array([0.2, -0.1, 0.1]))
    change = arm.load_of_force(pose, force * (samples.time >= start)[:, None], samples.position)
    return body, replace(samples, outputs=samples.outputs + change)


def turned(start=70.0, degrees=(4.0, -3.0, 0.0), seed=3):
    """The same with a base that is turned from a time [s] on."""
    (body, samples), arm = free(seed), true_arm(_scenario(False, seed))
    states = samples.position, samples.velocity, samples.acceleration
    turn = pin.exp3(np.deg2rad(degrees))
    tilted = arm.with_gravity(turn.T @ arm.model.gravity.linear)
    change = tilted.evaluate(*states) - arm.evaluate(*states)
    late = (samples.time >= start)[:, None]
    return body, replace(samples, outputs=samples.outputs + late * change)


def exchanged(start=70.0, seed=3):
    """The same with a tool, and another one in its place from a time [s] on."""
    (body, samples), arm = free(seed), true_arm(_scenario(False, seed))
    states = samples.position, samples.velocity, samples.acceleration
    tools = [
        pin.Inertia(mass, np.array(centre), 1e-3 * np.eye(3))
        for mass, centre in ((0.5, [0.03, 0.0, 0.05]), (0.4, [0.0, -0.04, 0.1]))
    ]
    frame, level = arm.distal_frames()[-1], arm.evaluate(*states)
    before, after = (arm.with_body(frame, tool).evaluate(*states) - level for tool in tools)
    late = (samples.time >= start)[:, None]
    return body, replace(samples, outputs=samples.outputs + np.where(late, after, before))


def elbow_rests(until=70.0, seed=4):
    """The body, and samples of an arm with another hand than described, whose last joint begins to
    move at a time [s]."""
    found, (body, samples) = _recording(False, seed), free(seed)
    arm = Arm.from_urdf(found.urdf, found.joint_names, 'wrench', found.frame_id, found.convention)
    hand = pin.Inertia(0.6, np.array([0.02, -0.03, 0.06]), 6e-4 * np.eye(3))
    arm = arm.with_body(arm.distal_frames()[-1], hand)
    position, velocity, acceleration = (
        getattr(samples, name).copy() for name in ('position', 'velocity', 'acceleration')
    )
    rests = samples.time < until
    position[rests, -1] = position[~rests, -1][0]
    velocity[rests, -1] = acceleration[rests, -1] = 0.0
    outputs = noisy(arm.evaluate(position, velocity, acceleration), seed=seed)
    return body, replace(samples, position=position, velocity=velocity, acceleration=acceleration, outputs=outputs)


def offered(body, samples, **settings):
    """A learner that has seen samples; what they begin with as most do is seen once for all."""
    settings, (usual, calm) = replace(SETTINGS, **settings), free()
    if body is usual and len(samples) >= CALM and _same(samples[:CALM], calm[:CALM]):
        before = _calm(settings)
        stage = deepcopy(before, {id(each): each for each in (body, *before.answers)})
        stage.offer(samples[CALM:])
    else:
        stage = Stage(settings, background=InlineBackground(), body=body)
        stage.offer(samples)
    assert not stage.failures
    return stage


@lru_cache(maxsize=8)
def _calm(settings):
    """A learner that has seen the first samples of the arm to which nothing happens."""
    body, samples = free()
    stage = Stage(settings, background=InlineBackground(), body=body)
    stage.offer(samples[:CALM])
    return stage


def _same(samples, others):
    return all(
        np.array_equal(getattr(samples, name), getattr(others, name))
        for name in ('stamps', 'position', 'velocity', 'acceleration', 'outputs')
    )
