"""Design matrix of a model in parts, and their products block by block.

The columns C of a model are those of the rigid body, the offset and each effect. Models of a search differ by few of
them, so they share the others, and each pair of parts remembers its products: C'C of a further model costs the products
of what is new in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from semiparam_ros.core.types import Array, Indices, Mask


class Part:
    """Columns of one part of a model, of each channel those that act there: a joint feels few bodies of a robot with
    limbs, and nothing of what rubs in other joints.

    :ivar count: c, how many there are. :ivar shape: (N, n) of the outputs.
    :ivar acting: (a_k,) of each channel k the numbers of those that act there.
    :ivar values: (a_k, N) of each channel k where some act.
    """

    def __init__(self, columns: Array) -> None:
        """:param columns: (N, n, c)."""
        *self.shape, self.count = columns.shape
        acts = np.asarray(columns.any(axis=0))
        self.acting = [np.flatnonzero(channel) for channel in acts]
        self.values = {channel: np.ascontiguousarray(columns[:, channel].T[acting])
                       for channel, acting in enumerate(self.acting) if len(acting)}


class SamplesInUse:
    """Samples that fit and whose output counts, of each channel, in blocks of about as many samples that fit each.

    :ivar numbers: (M_k,) of each channel k those of its samples.
    :ivar edges: (B - 1,) sample numbers at which blocks begin but for the first.
    :ivar ends: of each channel (B + 1,) where blocks begin and end among its samples.
    """

    def __init__(self, train_mask: Mask, counted: Mask, blocks: int) -> None:
        """:param train_mask: (N,). :param counted: (N, n)."""
        self.blocks = blocks
        self.numbers = [np.flatnonzero(train_mask & counts) for counts in counted.T]
        fitting = np.flatnonzero(train_mask)
        self.edges = fitting[np.arange(1, blocks) * len(fitting) // blocks]
        self.ends = [[0, *np.searchsorted(used, self.edges).tolist(), len(used)] for used in self.numbers]

    @cached_property
    def _filled(self) -> list[tuple[Indices, Mask]]:
        """Sample numbers of rows (B L,) of each channel's blocks, L the length of the longest, and where a block is
        over before."""
        found = []
        for numbers, ends in zip(self.numbers, self.ends, strict=True):
            lengths = np.diff(ends)[:, None]
            within = np.arange(lengths.max())
            rows = np.minimum(np.array(ends[:-1])[:, None] + within, max(len(numbers) - 1, 0))
            found.append((np.append(numbers, 0)[rows].ravel(), (within >= lengths).ravel()))
        return found

    def of(self, channel: int, values: Array) -> Array:
        """(a, B, L) of values (a, N) of a channel those in use, block by block, filled up with zeros."""
        numbers, filling = self._filled[channel]
        rows = np.take(values, numbers, axis=1)
        rows[:, filling] = 0.0
        return rows.reshape(len(values), self.blocks, len(numbers) // self.blocks)

    def without_filling(self, channel: int, rows: Array) -> Array:
        """(a, M_k) of rows (a, B, L) as :meth:`of` gives them."""
        return np.asarray(flat(rows)[:, ~self._filled[channel][1]])


class Product(NamedTuple):
    """Products of the columns of two parts in a channel: (B, a, b) block by block and (a, b) in all."""

    blocks: Array
    whole: Array

    @property
    def turned(self) -> Product:
        """The same of the second part with the first."""
        return Product(self.blocks.transpose(0, 2, 1), self.whole.T)


class PartInUse:
    """Part of a model at the samples in use. It remembers its products with other such parts while they exist.

    :ivar rows: (a_k, B, L) of each channel k where some act, see :meth:`SamplesInUse.of`.
    """

    def __init__(self, part: Part, samples: SamplesInUse) -> None:
        self.part, self.samples = part, samples
        self.rows = {channel: samples.of(channel, values) for channel, values in part.values.items()}
        self._products: WeakKeyDictionary[PartInUse, dict[int, Product]] = WeakKeyDictionary()

    def products(self, other: PartInUse) -> dict[int, Product]:
        """Products of its columns with those of another part, in each channel where both act."""
        found = self._products.get(other)
        if found is None:
            found = {}
            for channel in self.rows.keys() & other.rows.keys():
                blocks = _by_block(self.rows[channel]) @ _by_block(other.rows[channel]).transpose(0, 2, 1)
                found[channel] = Product(blocks, blocks.sum(axis=0))
            self._products[other] = found
            if other is not self:
                other._products[self] = {channel: product.turned for channel, product in found.items()}
        return found


def moments(rows: Array, values: Array) -> Array:
    """(B, a) products of rows (a, B, L) with values (B, L), block by block."""
    return np.asarray((_by_block(rows) @ values[:, :, None])[:, :, 0])


def _by_block(rows: Array) -> Array:
    """(B, a, L) of (a, B, L)."""
    return rows.transpose(1, 0, 2)


def flat(rows: Array) -> Array:
    """(a, B L) of (a, B, L)."""
    return rows.reshape(len(rows), rows.shape[1] * rows.shape[2])


def _acting(parts: Sequence[PartInUse], channel: int) -> list[PartInUse]:
    """Parts of which some column acts in a channel."""
    return [each for each in parts if channel in each.rows]


class Design:
    """Design matrix C of a model at the samples in use, from its parts."""

    def __init__(self, parts: Sequence[PartInUse], samples: SamplesInUse) -> None:
        self.parts, self.samples = tuple(parts), samples
        self._starts = np.cumsum([0, *(each.part.count for each in parts)]).tolist()

    @property
    def n_columns(self) -> int:
        """p."""
        return int(self._starts[-1])

    @cached_property
    def support(self) -> list[Indices]:
        """(p_k,) of each channel k the numbers of the columns that act there."""
        return [np.concatenate([each.part.acting[channel] + start for each, start in zip(
            self.parts, self._starts, strict=False)]) for channel in range(len(self.samples.numbers))]

    def predicted(self, theta: Array) -> Array:
        """(N, n) C theta at all samples."""
        count, channels = self.parts[0].part.shape
        outputs = np.zeros((channels, count))
        for each, start in zip(self.parts, self._starts, strict=False):
            own = theta[start:start + each.part.count]
            if own.any():
                for channel, values in each.part.values.items():
                    outputs[channel] += own[each.part.acting[channel]] @ values
        return outputs.T

    @cached_property
    def grams(self) -> list[Array]:
        """(p_k, p_k) of each channel k the products of its columns."""
        return [self._assembled(channel, self.parts, ()) for channel in range(len(self.support))]

    def block_grams(self, further: PartInUse) -> list[Array]:
        """(B, p_k, p_k) of each channel k the products of its columns, those of a further part last, block by block."""
        return [self._assembled(channel, [*self.parts, further], (self.samples.blocks,))
                for channel in range(len(self.support))]

    def _assembled(self, channel: int, parts: Sequence[PartInUse], shape: tuple[int, ...]) -> Array:
        """(..., p_k, p_k) products of all pairs of parts, of each block where ``shape`` is (B,)."""
        parts = _acting(parts, channel)
        edges = np.cumsum([0, *(len(each.rows[channel]) for each in parts)]).tolist()
        ends, gram = [slice(*pair) for pair in pairwise(edges)], np.empty((*shape, edges[-1], edges[-1]))
        for number, (one, own) in enumerate(zip(parts, ends, strict=True)):
            for other, its in zip(parts[:number + 1], ends, strict=False):
                product = one.products(other)[channel]
                found = product.blocks if shape else product.whole
                gram[..., own, its] = found
                gram[..., its, own] = found.swapaxes(-1, -2)
        return gram

    def moments(self, values: Array, further: Sequence[PartInUse] = ()) -> list[Array]:
        """(B, p_k) of each channel k the products of its columns, of further parts too, with values (N, n)."""
        parts, found = (*self.parts, *further), []
        for channel, own in enumerate(values.T):
            used = self.samples.of(channel, own[None])[0]
            acting = (moments(each.rows[channel], used) for each in _acting(parts, channel))
            found.append(np.concatenate([np.zeros((self.samples.blocks, 0)), *acting], axis=1))
        return found

    def cross(self, channel: int, rows: Array) -> Array:
        """(p_k, b) products of the columns that act in a channel with rows (b, B L)."""
        return np.concatenate([np.zeros((0, len(rows))), *(
            flat(each.rows[channel]) @ rows.T for each in _acting(self.parts, channel))])

    @cached_property
    def rows(self) -> list[Array]:
        """(M_k, p_k) of each channel k its columns at its samples in use."""
        return [np.concatenate([np.zeros((0, len(used))), *(
            self.samples.without_filling(channel, each.rows[channel]) for each in _acting(self.parts, channel))]).T
            for channel, used in enumerate(self.samples.numbers)]
