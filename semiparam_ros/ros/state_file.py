"""What a node has learnt, in a file: numbers and JSON in an .npz archive, so that loading one cannot run code."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from semiparam_ros.atomic_write import replacing
from semiparam_ros.core.hyperparameters import Hyperparameters
from semiparam_ros.core.model import Estimator
from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.history import Chapter, arrays_of, chapter_from
from semiparam_ros.ros.jobs import Known, absorb, known_of, new_estimator
from semiparam_ros.settings.snapshot import Settings

FORMAT, VERSION = 'semiparam_ros state', 1
ADOPTED = ('variant', 'effects', 'noise', 'forgetting', 'horizon.length')
"""Parameters that the file brings along."""

FIXED = ('outputs', 'features.count', 'features.seed', 'features.length_scales', 'initial.samples')
"""Parameters that cannot change while a node runs, and so must agree."""


class SavedState(NamedTuple):
    """A learner's model, the settings it was built with, the samples it keeps, and the bias (n,) of the tare."""

    settings: Settings
    estimator: Estimator
    chapter: Chapter
    bias: Array


def save(path: Path, state: SavedState) -> None:
    """Write the whole file or nothing. Raises SemiparamError when it cannot be written."""
    arrays = {'meta': np.array(json.dumps(_meta(state))), 'bias': state.bias, 'probe': probe(state.estimator.body)}
    arrays |= {f'history.{name}': values for name, values in arrays_of(state.chapter).items()}
    if known_of(state.estimator) is not None:  # before that, the samples say everything
        arrays |= {f'recursion.{name}': values for name, values in state.estimator.model.recursion.state().items()}
    with replacing(path, durable=True) as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def load(path: Path, settings: Settings, body: RigidBody) -> SavedState:
    """Read a state for this robot and these settings; ``settings`` of the result hold what the file brings along.

    Raises SemiparamError when the file cannot be read, is of another kind or version, or of another robot.
    """
    arrays = _read(path)
    try:
        meta = _meta_of(path, arrays)
        _check_robot(path, arrays, meta, settings, body)
        settings = settings.changed({name: meta['settings'][name] for name in ADOPTED}, where=str(path))
        for name, values in arrays.items():
            if name != 'meta' and not np.isfinite(values).all():
                raise SemiparamError(f"{path} holds a value in '{name}' that is not finite.")
        chapter = chapter_from(_group(arrays, 'history'), body.n_joints)
        bias = arrays['bias']
        if bias.shape != (body.n_outputs,):
            raise SemiparamError(f"{path} holds a 'bias' of shape {bias.shape}; expected ({body.n_outputs},).")
        return SavedState(settings, _estimator(settings, body, arrays, meta, chapter), chapter, bias)
    except SemiparamError:
        raise
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise SemiparamError(f'{path} is damaged ({error}); expected a file that save_state wrote.') from error


def probe(body: RigidBody) -> Array:
    """(1 + 3 n, p) base parameters, and regressors at three fixed states: equal for the same robot, outputs and
    convention, whatever the text of its description."""
    rng = np.random.default_rng(1)
    regressors = [body.regressor(*rng.uniform(-1.0, 1.0, (3, body.n_joints))) for _ in range(3)]
    return np.vstack([body.base_parameters[None], *regressors])


def _meta(state: SavedState) -> dict[str, Any]:
    estimator = state.estimator
    values = state.settings.mapping()
    known = known_of(estimator)
    return {'format': FORMAT, 'version': VERSION, 'joints': list(estimator.body.joints),
            'settings': {name: values[name] for name in (*ADOPTED, *FIXED)},
            'known': None if known is None else [asdict(known.hyperparameters), known.input_mean, known.input_scale]}


def _read(path: Path) -> dict[str, Array]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise SemiparamError(f'there is no file {path}; save_state writes it.') from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, AttributeError) as error:
        raise SemiparamError(f'{path} cannot be read ({error}); expected a file that save_state wrote.') from error


def _meta_of(path: Path, arrays: Mapping[str, Array]) -> dict[str, Any]:
    meta = json.loads(str(arrays['meta'])) if 'meta' in arrays else {}
    if not isinstance(meta, dict) or meta.get('format') != FORMAT:
        raise SemiparamError(f'{path} is no saved state; expected a file that save_state wrote.')
    if meta.get('version') != VERSION:
        raise SemiparamError(f'{path} is of version {meta.get("version")}; this node reads version {VERSION}.')
    return meta


def _check_robot(path: Path, arrays: Mapping[str, Array], meta: Mapping[str, Any], settings: Settings,
                 body: RigidBody) -> None:
    """A model means nothing on another robot, and nothing with other features."""
    if list(meta['joints']) != list(body.joints):
        raise SemiparamError(f'{path} is of another robot, with the joints {", ".join(meta["joints"])}; expected '
                             f'{", ".join(body.joints)}.')
    for name in FIXED:
        if meta['settings'][name] != settings.mapping()[name]:
            raise SemiparamError(f'{path} was learnt with {name} {meta["settings"][name]}; this node has '
                                 f'{settings.mapping()[name]}.')
    ours = probe(body)
    if arrays['probe'].shape != ours.shape or not np.allclose(arrays['probe'], ours, rtol=1e-9, atol=1e-9):
        raise SemiparamError(f'{path} is of another robot: its description, sensor frame or wrench convention differs.')


def _estimator(settings: Settings, body: RigidBody, arrays: Mapping[str, Array], meta: Mapping[str, Any],
               chapter: Chapter) -> Estimator:
    """The model as it was. Before the end of the initial window it is learnt again, which gives the same."""
    if meta['known'] is None:
        return absorb(new_estimator(settings, body), chapter)
    hyperparameters, mean, scale = meta['known']
    for name in ('tau', 'output_scale', 'pi'):
        hyperparameters[name] = None if hyperparameters[name] is None else tuple(hyperparameters[name])
    estimator = new_estimator(settings, body, Known(Hyperparameters(**hyperparameters), tuple(mean), tuple(scale)))
    estimator.model.recursion.restore(_group(arrays, 'recursion'))
    if chapter.samples is not None:
        # What no array holds: where time begins, and what effects remember, which they gain from the samples anew.
        estimator.origin = chapter.samples.origin
        estimator._newest = int(chapter.samples.stamps[-1])
        estimator._memory = estimator.columns.batch(chapter.samples)[1] if settings.effects else None
    return estimator


def _group(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    return {name.removeprefix(f'{prefix}.'): values for name, values in arrays.items()
            if name.startswith(f'{prefix}.')}
