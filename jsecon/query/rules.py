"""The rules by which a question is answered: every threshold, its default, and what that was measured on."""

import dataclasses

import jax

from jsecon.errors import require_one_of
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.field.regions import DUPLICATE_COSINE
from jsecon.field.similarity import Number
from jsecon.numerics import array_module
from jsecon.types import static

RETRIEVALS = ("contrast", "cosine")
"""Ways to compare a text with regions: what sets it apart from unrelated words, or the plain cosine (the paper)."""
STATES = ("absent", "unsure", "found")
"""Whether the scene has what a text names. If "unsure", the best match is selected, and may be something else."""
ABSENT, UNSURE, FOUND = range(3)
MIN_MARGIN, FOUND_MARGIN = 0.7, 1.45
"""Margins of a text among unrelated words (query/match.py) from which it is unsure, and from which it is found."""
MIN_RANK = 0.82
"""Smallest share of unrelated words (`LanguageField.unrelated_words`) that must match a region less than its class of
a list does. Of whole scenes it is the least that refuses 0.8 of absent texts with simulated CLIP at medium noise."""
MIN_COSINE = 0.2
"""Smallest cosine of the best region, for fields without unrelated words. The paper has such a threshold and does not
state it. In CLIP ViT-B/16 an image has a cosine of 0.25 to 0.35 with a text that fits and 0.1 to 0.2 with another."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class QueryRules:
    """How a question is answered. A pytree: jit compiles anew only for the two static fields."""

    retrieval: str = static(default="contrast")
    """One of RETRIEVALS. A field without unrelated words is always searched by "cosine"."""
    min_rank: Number | None = None
    """Smallest share of unrelated words that must match the scene less than the text does, else it is absent; 0 refuses
    no text. None judges by the margin among these words."""
    min_score: Number | None = None
    """Smallest similarity of the best region, in place of a comparison with words."""
    duplicate_cosine: Number | None = DUPLICATE_COSINE
    """Cosine from which two regions are one object seen twice, and both answer; None disables it."""
    fragment_score: Number | None = 0.5
    """Relative score, 0 at the median region and 1 at the best, from which a region that overlaps the best is a
    fragment of it, and joins it; None disables it."""
    all_of_class: bool = static(default=False)
    """Whether all regions of the best one's class answer."""
    same_class_score: Number = 0.75
    """Relative score from which a region is of that class."""
    min_share: Number = SHARE_THRESHOLD
    """Smallest share of the regions in a selected Gaussian."""
    code_threshold: Number | None = None
    """Smallest cosine of a selected Gaussian's code with that of the best region (the paper), in place of `min_share`;
    None selects by votes."""

    def __post_init__(self):
        """Raises ValueError for an unknown retrieval."""
        require_one_of("QueryRules", self.retrieval, RETRIEVALS, f"{RETRIEVALS[0]!r} is the default.")

    def judge(self, rank_and_margin, similarity):
        """Decides whether the scene has what a text names: the one judgement of texts and of regions.

        `rank_and_margin` are the text's among unrelated words (query/match.py), None without such words; the margin is
        None where a region is compared with a list of classes. Returns an index of STATES.
        """
        if self.min_score is not None or rank_and_margin is None:
            return FOUND * (similarity >= (MIN_COSINE if self.min_score is None else self.min_score))
        rank, margin = rank_and_margin
        if margin is None:
            return FOUND * (rank >= (MIN_RANK if self.min_rank is None else self.min_rank))
        state = UNSURE * (margin >= MIN_MARGIN) + (FOUND - UNSURE) * (margin >= FOUND_MARGIN)
        if self.min_rank is None:
            return state
        xp = array_module(rank, margin)
        return xp.where(rank >= self.min_rank, xp.maximum(state, UNSURE), ABSENT)


RULES = QueryRules()
"""The defaults."""
ALL_OF_CLASS = QueryRules(all_of_class=True)
"""All regions of a class answer."""
ONE_REGION = QueryRules(duplicate_cosine=None, fragment_score=None)
"""A region alone: who points at one of two red chairs means that one."""
