"""Structure that no kind explains: is any left, what does it depend on, and what formula describes it?"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from semiparam_ros.core.types import Array, Mask, Stamps
from semiparam_ros.diagnosis.config import DiagnosisConfig
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.residual.flexible import StandardisedInputs, explained
from semiparam_ros.diagnosis.residual.formula import Dependence, Formula, dependences, find_formula
from semiparam_ros.diagnosis.residual.noise import coloured_noise, without_input_errors


@dataclass(frozen=True)
class Structure:
    """Share that a smooth function of the motion and of time would still explain of a residual, on unseen blocks.

    ``share`` and ``channel_shares`` (n,): of the squared residual; about 0 where there is nothing. ``variables``:
    what it depends on, the most telling first. ``families``: share by family of functions.
    """

    share: float
    channel_shares: Array
    significant: bool
    channels: tuple[str, ...] = ()
    variables: tuple[Dependence, ...] = ()
    formulas: tuple[Formula, ...] = ()
    families: dict[str, float] = field(default_factory=dict)
    as_slow_noise: bool = False
    """Whether a function explains much, but no more than of noise that changes as slowly."""

    @property
    def sentence(self) -> str:
        """Sentence that a user reads."""
        if not self.significant and self.as_slow_noise:
            return (f'A function of the motion or of time explains {100 * self.share:.0f} % of what is left, at most '
                    f'{100 * self.channel_shares.max():.0f} % of one output: no more than of noise that is as slow.')
        if not self.significant:
            return 'Nothing is left that depends on the motion or on time.'
        names = ', '.join(f'{each.name} ({100 * each.share:.0f} %)' for each in self.variables) or 'no single variable'
        best = max(self.formulas, key=lambda formula: formula.share, default=None)
        said = f' A formula explains {100 * best.share:.0f} % of it in one channel: {best.text}.' if best else ''
        return (f'{100 * self.share:.0f} % of what is left is more than noise, and no kind of effect explains it. It '
                f'shows in {", ".join(self.channels)} and depends on {names}.{said}')

    def as_dict(self) -> dict[str, object]:
        """The entry ``unexplained`` of the machine-readable report."""
        return {'significant': self.significant, 'share': self.share, 'channel_shares': self.channel_shares.tolist(),
                'channels': list(self.channels), 'variables': [each._asdict() for each in self.variables],
                'formulas': [{'channel': formula.channel, 'text': formula.text, 'share': formula.share,
                              'terms': [each._asdict() for each in formula.summands]} for formula in self.formulas],
                'families': self.families, 'sentence': self.sentence}


def remaining_structure(fit: Fit) -> Structure:
    """Look for structure in the residual of a fitted model, where it is fitted."""
    body, config, rows = fit.body, fit.config, samples_to_look_at(fit.train_mask, fit.config)
    if len(rows) < config.structure_least_samples:
        return Structure(share=0.0, channel_shares=np.zeros(body.n_outputs), significant=False)
    motion, counted = StandardisedInputs(body.joints, fit.samples[rows], config), fit.counted[rows]
    guarded = without_input_errors(fit)[rows] / fit.scale * counted
    found, families = explained(motion, guarded, counted=counted)
    gains, power = np.sum(guarded**2 - (guarded - found) ** 2, axis=0), np.sum(guarded**2, axis=0) + 1e-300
    share, shares = float(gains.sum() / power.sum()), gains / power
    together, affected = share > config.structure_share, shares > config.channel_share
    if much := bool(together or affected.any()):
        beyond, beyond_in = _beyond_chance(motion, guarded, counted)
        together, affected = together and beyond, affected & beyond_in
    if not together and not affected.any():
        return Structure(share=share, channel_shares=shares, significant=False, families=families, as_slow_noise=much)
    if not affected.any():
        affected = shares >= shares.max()
    return _described(fit, rows, motion, affected,
                      Structure(share=share, channel_shares=shares, significant=True, families=families))


def _described(fit: Fit, rows: Stamps, motion: StandardisedInputs, affected: Array, structure: Structure) -> Structure:
    """The structure with its channels, its variables and its formulas, from some of the samples."""
    numbers, samples, counted = np.flatnonzero(affected), fit.samples[rows], fit.counted[rows]
    residual = fit.residual[rows] * counted
    variables = dependences(motion, (residual / fit.scale)[:, numbers], float(structure.channel_shares[numbers].mean()),
                            counted[:, numbers])
    names = [each.name for each in variables][:fit.config.most_variables]
    formulas = [find_formula(names, fit.body, samples[use], residual[use, channel], int(channel), fit.config)
                for channel, use in zip(numbers, counted.T[numbers], strict=True)]
    return replace(structure, channels=tuple(fit.body.output_names[k] for k in numbers), variables=variables,
                   formulas=tuple(formula for formula in formulas if formula is not None))


def _beyond_chance(motion: StandardisedInputs, residual: Array, counted: Mask) -> tuple[bool, Mask]:
    """Return whether more is explained than of noise of the residual's colour: in all channels, and (n,) in each.

    Asked twice, for time takes what is slow: once with it, and once of the motion alone.
    """
    config = motion.config
    noise = coloured_noise(residual, config.chance_draws, config=config)
    everything = np.concatenate([residual[None], noise]) * counted
    side_by_side = np.moveaxis(everything, 0, 1).reshape(len(residual), -1)
    power = (everything**2).sum(axis=1) + 1e-300
    beyond, beyond_in = False, np.zeros(residual.shape[1], dtype=bool)
    for with_time in (True, False):
        found, _ = explained(motion, side_by_side, with_time, np.tile(counted, len(everything)))
        gains = (side_by_side**2 - (side_by_side - found) ** 2).sum(axis=0).reshape(power.shape)
        beyond = beyond or bool(_stands_out(gains.sum(axis=1) / power.sum(axis=1), config.beyond_chance))
        beyond_in = beyond_in | _stands_out(gains / power, config.beyond_chance)
    return beyond, beyond_in


def _stands_out(shares: Array, deviations: float) -> Mask:
    """Return whether the first row of shares (1 + draws, ...), the residual's, is beyond the others, those of noise."""
    return np.asarray(shares[0] > shares[1:].mean(axis=0) + deviations * shares[1:].std(axis=0, ddof=1))


def samples_to_look_at(train_mask: Mask, config: DiagnosisConfig) -> Stamps:
    """Numbers of the samples to look at, evenly spread."""
    rows = np.flatnonzero(train_mask)
    return rows[::max(-(-len(rows) // config.most_samples), 1)]
