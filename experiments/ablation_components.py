"""Table 4: what each component brings, one added or exchanged at a time.

    python -m experiments.ablation_components [--quick] [--root FOLDER] [--out FOLDER] [--processes N]

On LERF-OVS or its twins, under the protocol of `experiments.lerf`, whose cells are taken where a row is the same.
"""

from experiments import lerf
from experiments.tables import layout, published
from experiments.tables.answers import Method
from experiments.tables.fill import Plan, options_of
from experiments.tables.methods import METHODS, langsplat
from experiments.tables.ours import BY_COSINE, asked, paper, untracked

COMPONENTS: dict[str, Method] = {
    "LangSplat-m": langsplat,
    "each frame's own masks, anchored by code": untracked,
    "masklets, one-step": asked("one_step", clean=False),
    "masklets, anchored by code": asked("code", clean=False, **BY_COSINE),
    "+ DBSCAN (the paper, distilled by votes)": asked("code", **BY_COSINE),
    "uniform instead of pixel weights": asked("code", uniform=True, **BY_COSINE),
    "3-d autoencoder codes instead of spread ones": asked("code", latent=3, **BY_COSINE),
    "the paper's path": paper,
    "membership by votes of all views": asked("all_views", **BY_COSINE),
    "membership by votes of the views that show it": asked("votes", **BY_COSINE),
    "the region apart from words": asked("votes"),
    "ours, tracks": METHODS["ours, tracks"],
    "ours, consensus, the region by cosine": asked("votes", by="consensus", **BY_COSINE),
    "ours, consensus, without pieces": asked("votes", by="consensus"),
    "ours, consensus": METHODS["ours, consensus"],
}
"""the rows of Table 4: per-frame masks asked in one step (LangSplat-m) and anchored, then the paper's parts distilled
by votes, the whole of the paper's path, and ours: the region apart from unrelated words and its pieces, by the tracks
or by consensus"""
PLAN = lerf.beside(lerf.PLAN, "ablation_components", COMPONENTS)
QUICK = lerf.beside(lerf.QUICK, "ablation_components", COMPONENTS)


def main(plan: Plan) -> str:
    """The table, written."""
    beside = published.table("seconGS's components", published.COMPONENTS, ("figurines",))
    return layout.make(plan, COMPONENTS, lerf.FIGURES, notes=lerf.NOTES, published=beside)


if __name__ == "__main__":
    main(options_of(PLAN, QUICK))
