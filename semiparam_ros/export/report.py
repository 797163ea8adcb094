"""Report of an export: a remark for the files, a JSON document, and lines for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from semiparam_ros import __version__
from semiparam_ros.core.types import Array
from semiparam_ros.export.identified import CarriedBody, Identified
from semiparam_ros.export.urdf import changed_links

MARK = 'Identified by semiparam_ros'
"""Mark that all files hold."""


def remark(found: Identified) -> str:
    """Remark for a file on how it was made and how well it predicts; one line that every file can hold, whatever the
    recording is called."""
    how = ''.join(letter if letter.isprintable() else '?' for letter in found.how)
    heading = f'{MARK} {__version__} from {how}.'
    return f'{heading} {price(found)}' if found.price else heading


def price(found: Identified) -> str:
    """A sentence about the errors."""
    if found.price is None:
        return 'No samples judge it.'
    where = 'On the samples that the state keeps'
    if found.price.held_out:
        where = 'On parts left out of the fit'
    return (f'{where} the normalised error is {found.price.consistent:.4g}; without physical '
            f'consistency it is {found.price.unconstrained:.4g}, with the inertias of the '
            f'description {found.price.description:.4g}.')


def document(found: Identified) -> dict[str, Any]:
    """Document of everything, by name, in SI units."""
    joints: dict[str, dict[str, Any]] = {}
    for each in found.joints:
        joints.setdefault(each.joint, {})[each.name] = {
            'value': each.value, 'std': each.std, 'unit': each.unit}
    changed = changed_links(found)
    links = {name: {**_body(values), 'changed': name in changed,
                    'described': _body(found.described[name]),
                    'description_consistent': name not in found.mended}
             for name, values in found.links.items()}
    loads = [{'link': load.link, **_body(load.parameters), 'mass_std': load.mass_std,
              'start_s': load.start_s} for load in found.loads]
    return {'made': remark(found), 'links': links, 'joints': joints, 'loads': loads,
            'offsets': dict(found.offsets), 'left_out': dict(found.left_out),
            'errors': None if found.price is None else found.price._asdict()}


def _body(parameters: Array) -> dict[str, Any]:
    body = CarriedBody('', parameters, 0.0)
    return {'mass': body.mass, 'centre': body.centre.tolist(), 'inertia': body.inertia.tolist()}


def lines(found: Identified) -> list[str]:
    """Lines for each quantity that is not as described, and what to mind."""
    lines = [f'{name}: {found.described[name][0]:.4g} kg to {found.links[name][0]:.4g} kg, centre '
            f'({_row(_body(found.links[name])["centre"])}) m.'
            for name in changed_links(found) if name not in found.mended]
    joints: dict[str, list[str]] = {}
    for each in found.joints:
        joints.setdefault(each.joint, []).append(
            f'{each.name} {each.value:.4g} +- {each.std:.2g} {each.unit}')
    lines += [f'{joint}: {", ".join(values)}.' for joint, values in joints.items()]
    if any(each.name == 'armature' and each.value for each in found.joints):
        lines.append('A robot description holds no armature; MuJoCo models and the JSON file do.')
    for load in found.loads:
        since = '' if load.start_s is None else f', since {load.start_s:.1f} s'
        lines.append(f'load at {load.link}: {load.mass:.4g} +- {load.mass_std:.2g} kg, centre '
                    f'({_row(load.centre)}) m{since}.')
    lines += [f'The samples show no load at {link}: none is written.' for link in found.not_shown]
    lines += [f'They show that the arm is lighter with what is at {link}, as where a load that was there at first is '
              'put down, or exchanged for a lighter one. The files hold neither state; expected a recording of one of '
              'them, or --keep-inertias.' for link in found.lighter]
    still = [name for name in found.links if name not in changed_links(found)]
    if still:
        lines.append(f'As described: {", ".join(still)}.')
    if found.mended:
        lines.append(f'No body has the described inertia of {", ".join(found.mended)}: it is '
                    'mended.')
    alone = {f'offset@{name}': value for name, value in found.offsets.items()} | dict(found.left_out)
    if alone:
        values = ', '.join(f'{name} {value:.3g}' for name, value in alone.items())
        lines.append(f'Of this the JSON file alone tells: {values}.')
    return lines


def _row(values: Sequence[float] | Array) -> str:
    return ' '.join(f'{value:.3f}' for value in values)
