"""Rules by which texts match regions: `QueryRules`, its defaults, and what each default was measured on."""

import dataclasses

import jax

from jsecon.errors import require_one_of
from jsecon.field.regions import ALIKE_THRESHOLD
from jsecon.field.similarity import Number
from jsecon.types import static
from jsecon.vision.protocols import Logits

RETRIEVALS = ("apart", "cosine")
"""Ways to compare a text with regions: what sets it apart from unrelated words, or the plain cosine (the paper)."""
QUANTILE = 0.82
"""Smallest share of unrelated words (`LanguageField.unrelated_words`) that must match the scene less than the text
does. It is the least that refuses 0.8 of the absent texts with simulated CLIP at medium noise. Refused of these, and
kept of the others: there 0.81 and 0.95, with errors that views share 0.78 and 0.49; on real words (ConSE, 15 classes of
replica_apartment_0) 0.95 and 0.93, with jsecon's own masks 0.94 and 0.73."""
RETRIEVAL_THRESHOLD = 0.2
"""Smallest cosine of the best region, for fields without unrelated words. The paper has such a threshold and does not
state it. In CLIP ViT-B/16 an image has a cosine of 0.25 to 0.35 with a text that fits and 0.1 to 0.2 with another."""
PRESENCE_THRESHOLD = 0.01
"""Smallest probability that a text is true of the best region, for embedders with logits and fields without unrelated
words. SigLIP (arXiv 2303.15343) is trained at one true pair in 32,768, where 0.01 says that a pair is 300 times
likelier true than at random. Not measured: no trained weights could be had."""
KIND_THRESHOLD = 0.75
"""Relative score, 0 at the median region and 1 at the best, from which a region is of the same kind as the best."""
PIECE_THRESHOLD = 0.5
"""Relative score from which a region that overlaps the best one is another piece of the same object."""
MIN_PIECE_OVERLAP = 0.1
"""Smallest soft IoU of the Gaussians of two pieces. In twins of two scenes 106 of 115 pieces reach it, and 4 of 58
other regions."""
REFERENCE_CUT = 0.1
"""Share of the unrelated words, those nearest to the text, that are left out: the scene often has what is like it."""
EVIDENCE_PRIOR_VIEWS = 2.0
"""Views at which a region's evidence is one half."""
EVIDENCE_FULL_PX = 400.0
"""Pixels of a region that make a full view; a crop of 20 x 20 pixels shows an image encoder little."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class QueryRules:
    """How a text is matched with the regions of a field. A pytree: jit compiles anew only for the two static fields."""

    retrieval: str = static(default="apart")
    """One of RETRIEVALS. A field without unrelated words is always searched by "cosine"."""
    quantile: Number = QUANTILE
    """Smallest share of unrelated words that must match the scene less than the text does; 0 refuses no text."""
    retrieval_threshold: Number | None = None
    """Smallest similarity of the best region, in place of `quantile`; a probability where there are `logits`."""
    alike_threshold: Number | None = ALIKE_THRESHOLD
    """Cosine from which two regions are one object seen twice, and both answer; None disables it."""
    piece_threshold: Number | None = PIECE_THRESHOLD
    """Relative score from which a region that overlaps the best is a piece of it, and joins it; None disables it."""
    all_of_kind: bool = static(default=False)
    """Whether all regions of the best one's kind answer."""
    kind_threshold: Number = KIND_THRESHOLD
    """Relative score from which a region is of that kind."""
    logits: Logits | None = None
    """Scale and bias of an embedder that was trained to tell whether a text is true of an image."""

    @property
    def fixed_threshold(self) -> Number:
        """Threshold on the best region of a text where no quantile decides; a probability where there are `logits`."""
        if self.retrieval_threshold is not None:
            return self.retrieval_threshold
        return RETRIEVAL_THRESHOLD if self.logits is None else PRESENCE_THRESHOLD

    def __post_init__(self):
        """Raises ValueError for an unknown retrieval."""
        require_one_of("QueryRules", self.retrieval, RETRIEVALS, f"{RETRIEVALS[0]!r} is the default.")
