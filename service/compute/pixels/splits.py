"""Splits of the views of a data set: dense, sparse, train and test; the same for the same views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.core.errors import DataError

SPARSE_VIEWS = 8
TEST_EVERY = 8  # as in LLFF and 3D Gaussian splatting


@dataclass(frozen=True, slots=True)
class Splits:
    """Names of views: `dense` is all, `sparse` a few that see the specimen best; train and test share none."""

    dense: tuple[str, ...]
    sparse: tuple[str, ...]
    train: tuple[str, ...]
    test: tuple[str, ...]

    def named(self) -> dict[str, tuple[str, ...]]:
        """The splits by name."""
        return {"dense": self.dense, "sparse": self.sparse, "train": self.train, "test": self.test}


def splits(sees: Mapping[str, NDArray[np.bool_]], sparse_views: int = SPARSE_VIEWS) -> Splits:
    """Splits of views, each with the points (N,) of the specimen that it sees.

    Raises:
        DataError: there is no view.
    """
    names = tuple(sorted(sees))
    if not names:
        raise DataError("a data set needs at least one view", remedy="Export a run with registered images")
    test = names[TEST_EVERY // 2 :: TEST_EVERY]
    train = tuple(name for name in names if name not in set(test))
    return Splits(names, sparse_choice(names, [sees[name] for name in names], sparse_views), train, test)


def sparse_choice(names: Sequence[str], sees: Sequence[NDArray[np.bool_]], count: int) -> tuple[str, ...]:
    """The `count` views that see most together, in the order of `names`; of equal choices the first.

    A point counts fully for the first view that sees it, half for the second, a quarter for the third: reconstruction
    needs two views of a point, and further ones help less. Chosen one after the other, which is within 63 % of the
    best choice (Nemhauser, Wolsey, Fisher, 1978).
    """
    seen, worth = np.array(sees, dtype=np.float64), np.ones(len(sees[0]))
    chosen: list[int] = []
    while len(chosen) < min(count, len(names)):
        gain = seen @ worth
        gain[chosen] = -1.0
        best = int(gain.argmax())
        chosen.append(best)
        worth *= np.where(sees[best], 0.5, 1.0)
    return tuple(names[i] for i in sorted(chosen))
