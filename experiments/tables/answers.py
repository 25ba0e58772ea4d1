"""Methods of the tables: a method trains on a setting and answers queries by selecting Gaussians."""

import dataclasses
from collections.abc import Callable

import numpy as np

from experiments.tables.setting import Setting
from jsecon.types import Array, Gaussians, Selection


@dataclasses.dataclass(frozen=True)
class Steps:
    """Lengths of the trainings.

    The papers' schedules take 30,000 steps and more at small rates. These are shorter, at larger rates and from random
    codes: from zero, which is LangSplat's start, Adam needs about 18,000 steps.
    """

    langsplat: int = 1500
    epochs: int | None = None
    """Epochs of the autoencoders; None: LangSplat's."""
    grouping: int = 800
    grouping_rates: tuple[float, float] = (0.025, 0.005)
    instance: int = 800
    coarse: int = 200
    fine: int = 200
    roots: int = 64
    leaves: int = 10
    opengaussian_rate: float = 0.02
    paper: int = 1500


QUICK_STEPS = Steps(
    langsplat=60,
    epochs=40,
    grouping=50,
    grouping_rates=(0.05, 0.02),
    instance=50,
    coarse=5,
    fine=5,
    roots=8,
    leaves=3,
    opengaussian_rate=0.05,
    paper=60,
)
"""Steps of a quick run, too few to judge the trained methods by."""


@dataclasses.dataclass(frozen=True)
class Answers:
    """Answers of a trained method."""

    select: Callable[[int], Selection | None]
    """Gaussians that the k-th query of the benchmark selects; None: no answer."""
    classes: Callable[[], np.ndarray]
    """(N,) query that fits each Gaussian best, -1 = no query; for datasets with truth at the points."""
    beside: dict[str, float] = dataclasses.field(default_factory=dict)
    """Figures under another protocol."""
    gaussians: Gaussians | None = None
    """Gaussians that are selected from, if they are not those of the setting."""
    features: Array | None = None
    """(N, F) learnt features of the Gaussians, for pictures."""


Method = Callable[[Setting, Steps], Answers]
"""Trains on a setting and returns its answers."""


def by_selection(setting: Setting, select: Callable[[int], Selection | None], features: Array | None = None) -> Answers:
    """Answers of `select`. The class of a Gaussian is the query with the highest score that selects it."""

    def classes() -> np.ndarray:
        best = np.full(setting.evidence.gaussians.count, -np.inf)
        query = np.full(len(best), -1)
        for k in range(len(setting.texts)):
            answer = select(k)
            if answer is not None:
                better = np.asarray(answer.mask) & (float(answer.score) > best)
                best[better], query[better] = float(answer.score), k
        return query

    return Answers(select, classes, features=features)
