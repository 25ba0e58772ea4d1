"""What a method of the tables is: trained on a setting for so many steps, it answers queries by selecting Gaussians."""

import dataclasses
from collections.abc import Callable

import numpy as np

from experiments.tables.setting import Setting
from jsecon.types import Array, Gaussians, Selection


@dataclasses.dataclass(frozen=True)
class Steps:
    """How long the trained methods train. The papers' schedules are 30,000 steps and more at small rates; these are
    shorter at larger rates, started from random codes: from zero, LangSplat's own start, Adam needs some 18,000
    steps."""

    langsplat: int = 1500
    epochs: int | None = None
    """of the autoencoders; None: LangSplat's."""
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
"""for a look at every row in two minutes: too short for the trained methods to be judged by"""


@dataclasses.dataclass(frozen=True)
class Answers:
    """The answers of a trained method."""

    select: Callable[[int], Selection | None]
    """k -> the Gaussians that the k-th of the benchmark's queries selects; None: no answer."""
    classes: Callable[[], np.ndarray]
    """() -> (N,) the query that fits each Gaussian best, -1 = none: for datasets whose truth is at the points."""
    beside: dict[str, float] = dataclasses.field(default_factory=dict)
    """figures under another protocol, to stand beside the table's."""
    gaussians: Gaussians | None = None
    """that are selected from, where they are not the setting's."""
    features: Array | None = None
    """(N, F) what was learnt of each Gaussian, for pictures."""


Method = Callable[[Setting, Steps], Answers]
"""trains on a setting"""


def by_selection(setting: Setting, select: Callable[[int], Selection | None], features: Array | None = None) -> Answers:
    """Answers of `select`; a Gaussian's class is, of the queries that select it, the one of the highest score."""

    def classes() -> np.ndarray:
        # Where several texts select a Gaussian, the one that fits its anchor best: all may share that anchor.
        best = np.full(setting.evidence.gaussians.count, -np.inf)
        found = np.full(len(best), -1)
        for k in range(len(setting.texts)):
            answer = select(k)
            if answer is not None:
                better = np.asarray(answer.mask) & (float(answer.score) > best)
                best[better], found[better] = float(answer.score), k
        return found

    return Answers(select, classes, features=features)
