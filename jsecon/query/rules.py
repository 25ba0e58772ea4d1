"""The rules by which a question is answered: every threshold, its default, and what that was measured on."""

import dataclasses

import jax

from jsecon.errors import require_one_of
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.field.regions import ALIKE_THRESHOLD
from jsecon.field.similarity import Number
from jsecon.types import static
from jsecon.vision.protocols import Logits

RETRIEVALS = ("contrast", "cosine")
"""Ways to compare a text with regions: what sets it apart from unrelated words, or the plain cosine (the paper)."""
MIN_RANK = 0.82
"""Smallest share of unrelated words (`LanguageField.unrelated_words`) that must match the scene less than the text
does. It is the least that refuses 0.8 of the absent texts with simulated CLIP at medium noise. Refused of these, and
kept of the others: there 0.81 and 0.95, with errors that views share 0.78 and 0.49; on real words (ConSE, 15 classes of
replica_apartment_0) 0.95 and 0.93, with jsecon's own masks 0.94 and 0.73."""
MIN_COSINE = 0.2
"""Smallest cosine of the best region, for fields without unrelated words. The paper has such a threshold and does not
state it. In CLIP ViT-B/16 an image has a cosine of 0.25 to 0.35 with a text that fits and 0.1 to 0.2 with another."""
MIN_PRESENCE = 0.01
"""Smallest probability that a text is true of the best region, for embedders with logits and fields without unrelated
words. SigLIP (arXiv 2303.15343) is trained at one true pair in 32,768, where 0.01 says that a pair is 300 times
likelier true than at random. Not measured: no trained weights could be had."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class QueryRules:
    """How a question is answered. A pytree: jit compiles anew only for the two static fields."""

    retrieval: str = static(default="contrast")
    """One of RETRIEVALS. A field without unrelated words is always searched by "cosine"."""
    min_rank: Number = MIN_RANK
    """Smallest share of unrelated words that must match the scene less than the text does; 0 refuses no text."""
    min_score: Number | None = None
    """Smallest similarity of the best region, in place of `min_rank`; a probability where there are `logits`."""
    duplicate_cosine: Number | None = ALIKE_THRESHOLD
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
    logits: Logits | None = None
    """Scale and bias of an embedder that was trained to tell whether a text is true of an image."""

    def __post_init__(self):
        """Raises ValueError for an unknown retrieval."""
        require_one_of("QueryRules", self.retrieval, RETRIEVALS, f"{RETRIEVALS[0]!r} is the default.")

    def accept(self, rank, similarity, presence):
        """Decides whether the scene answers a text: the one refusal of texts, of regions and of parts.

        `rank` is None without unrelated words, and `presence`, the probability that the text is true, without `logits`.
        """
        if self.min_score is None and rank is not None:
            return rank >= self.min_rank
        value, default = (similarity, MIN_COSINE) if presence is None else (presence, MIN_PRESENCE)
        return value >= (default if self.min_score is None else self.min_score)


RULES = QueryRules()
"""The defaults."""
ALL_OF_CLASS = QueryRules(all_of_class=True)
"""All regions of a class answer."""
ONE_REGION = QueryRules(duplicate_cosine=None, fragment_score=None)
"""A region alone: who points at one of two red chairs means that one."""
