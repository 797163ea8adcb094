"""The files that a running node writes of what it has learnt: a URDF and a JSON document."""

from __future__ import annotations

import json
from pathlib import Path

from semiparam_ros.atomic_write import write_text
from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.estimate import Estimate
from semiparam_ros.export.identified import identify
from semiparam_ros.export.report import MARK, document, remark
from semiparam_ros.export.urdf import described_links, identified_urdf


def export_to(folder: Path, name: str, urdf: str, estimate: Estimate) -> str:
    """Write ``name.urdf`` and ``name.json``; the sentence returned says where.

    Raises SemiparamError, with nothing written, when something else than an export has their names, or no folder of
    theirs can be made.
    """
    paths = [folder / f'{name}{suffix}' for suffix in ('.urdf', '.json')]
    for path in paths:
        _require_replaceable(path)
    found = identify(estimate, described_links(urdf))
    texts = [identified_urdf(urdf, found, remark(found)),
             json.dumps(document(found), indent=2) + '\n']
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SemiparamError(f'there is no folder {folder} and none can be made: {error.strerror}.') from error
    for path, text in zip(paths, texts, strict=True):
        write_text(path, text)
    loads = ' and '.join(f'a load of {load.mass:.4g} kg at {load.link}' for load in found.loads)
    return f'{paths[0]} and {paths[1].name} are written, from {estimate.how}{loads and ", with "}{loads}.'


def _require_replaceable(path: Path) -> None:
    try:
        if path.is_symlink():
            raise SemiparamError(f'{path} is a link, which is not followed; expected an export or no '
                                 'file.')
        foreign = path.exists() and (
            not path.is_file() or MARK not in path.read_text(encoding='utf-8', errors='replace'))
    except OSError as error:
        raise SemiparamError(f'{path} cannot be read, so it is not replaced: {error.strerror}.') from error
    if foreign:
        raise SemiparamError(f'{path} is no export, so it is not replaced; move it away, or choose '
                             'another state_file.')
