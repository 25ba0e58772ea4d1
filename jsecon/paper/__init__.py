"""The published method (seconGS, arXiv 2503.21767), part by part, as pure functions but for the first.

| the paper                                              | here                                     |
|--------------------------------------------------------|------------------------------------------|
| Algorithm 1: masks to masklets S_r                     | `algorithm1.masklets` (host code)        |
|   its tracker, SAM 2 or through the Gaussians          | `networks/sam2`, `tracker.GeometricTracker` |
| phi_bar_r = sum_t omega_t phi_rt, by pixels            | `field/regions.region_embeddings`        |
| l_r = E(phi_bar_r), LangSplat's autoencoder            | `autoencoder.train_autoencoder`, `encode`, `decode` |
| L = sum_p |F_p - l_r(p)|, by Adam                      | `distill.rendered_l1`, `distill_l1`      |
|   its closed forms, from votes                         | `distill.distill_votes`                  |
| one-step, canonical and GT-anchored queries            | `queries`                                |
| DBSCAN                                                 | `query/outliers.remove_outliers`         |

`jsecon run --tracker geometric --paper` takes this way; its codes follow from votes. experiments/tables/ours.py
trains them.
"""
