"""Masklets by consensus of the views, from the masks of single frames and the Gaussians of the scene. Host code.

Two Gaussians belong together if most views that see both put both into one mask: evidence accumulation (Fred & Jain,
PAMI 2005) with views as the ensemble and rendering weights as the evidence. A mask that merges two objects or cuts one
is outvoted by the other views. Frames have no order and there is no tracking, so errors do not propagate. The idea is
mask clustering by view consensus (Yan et al., CVPR 2024), between pieces of the scene instead of masks.

Pieces off each other's plane need more views to join. So a chair that many masks merge with the floor leaves it, and
the floor stays whole from wall to wall.

Groups that fewer views agree on are joined further, to a tree (`Objects.tree`): what fell apart, or belongs together as
a mug and its handle do, has a common node.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int16, Int32, Integer, UInt8
from scipy import sparse

from jsecon.association.frame_superpixels import FrameSuperpixels, SceneSuperpixels, Sparse, assign_superpixels, one_hot
from jsecon.errors import require
from jsecon.types import Progress
from jsecon.vision.region_graph import relabel_sequential

SURFACE_WIDTH = 0.08
"""Distance from a plane at which pieces count as off it, as a share of the median depth: 12 cm in a small room."""
PART_AGREEMENT = 0.9
"""Probability of a common mask from which pieces are one part of an object."""
MOST_PIECES, PIECE_SIZE = 300, 16
"""Most pieces of one object, and mean number of Gaussians of each: those of fewer have no plane to tell a wall by."""
MIN_AREA = 0.001
"""Share of a frame below which it shows no object."""
NEW_NODE = 0.1
"""Share of its weight that a join must add to make a node of its own."""
LEAST_PART, MOST_PART = 0.01, 0.85
"""Shares of an object's weight between which a part is one that a text may name."""


class Objects(NamedTuple):
    """The objects that frames show."""

    labels: Int16[np.ndarray, "t h w"]
    """(T, H, W) object 0 .. R-1 of each pixel, -1 for none."""
    tree: Int32[np.ndarray, " m"] | None = None
    """(M,) parent of each node, as `LanguageField.tree` has it. None if it is not known what belongs together."""
    leaf: Int32[np.ndarray, " n"] | None = None
    """(N,) smallest node of each Gaussian, as `LanguageField.leaf` has it."""
    parts: Int16[np.ndarray, "l t h w"] | None = None
    """(L, T, H, W) part 0 .. P-1 of an object at each pixel, -1 for none; parts in each other are on other layers."""
    part_nodes: Int32[np.ndarray, " p"] | None = None
    """(P,) node of each of these parts."""


class _Groups(NamedTuple):
    """Gaussians by group."""

    owner: Int[np.ndarray, " n"]
    """(N,) group 0 .. R-1, -1 if it is never seen."""
    joins: list[tuple[int, int]]
    """Pairs of groups that join, in turn; the first of a pair stands for both after it."""
    weight: Float[np.ndarray, " r"]
    """(R,) rendering weight of each group."""
    parts: "_Groups | None" = None
    """The parts of these, and how they join."""


def _group_by_consensus(
    membership: Sparse,
    visible: Sparse,
    weights: Float[np.ndarray, " n"],
    means: Float[np.ndarray, "n 3"],
    *,
    surface_width: float = np.inf,
    agreement: float = 0.4,
    pieces: int = 3000,
    seed: int = 0,
) -> _Groups:
    """Groups Gaussians into objects by the consensus of the views, and joins the groups further to a tree.

    The Gaussians are first gathered into small pieces (`_scene_pieces`). Then `_average_linkage` joins pieces while the
    views that see two groups put both into one mask with a probability of at least `agreement`, or of 1 if they lie off
    each other's plane (`_coplanarity`). What joins at PART_AGREEMENT within a group is a part (`_parts_within`), and
    what joins down to 0.05 a union. Groups that have less than 0.02 of their visibility in common stay separate.

    Args:
      membership: (N, M) share of each Gaussian in each of the M masks of all frames, times its visibility there.
      visible: (N, T) visibility of each Gaussian in each frame, in [0, 1].
      weights: (N,) total rendering weight of each Gaussian.
      means: (N, 3) centres, world units.
      surface_width: Distance from a plane at which pieces count as off it, world units; inf ignores surfaces.
      agreement: Probability of a common mask above which groups are joined.
      pieces: Maximum number of pieces.
      seed: Seed of the random projection.
    """
    shapes = [rows.shape for rows in (membership, visible, weights, means)]
    equal = len({shape[0] for shape in shapes}) == 1
    require(equal, "membership, visible, weights, means", shapes, "N rows each", "Pass one row per Gaussian.")
    sketch = _mask_sketch(membership, seed)
    piece = _scene_pieces(sketch, weights, means, pieces)
    live = np.flatnonzero(piece >= 0)
    owner = np.full(len(piece), -1, np.int64)
    if not len(live):
        return _Groups(owner, [], np.zeros(0))
    together, both = _linked(piece, membership, visible, weights, means, surface_width, agreement)
    group, _ = _average_linkage(together, both, least_ratio=agreement, least_shared=0.02)
    owner[live] = group[piece[live]]
    _, joins = _average_linkage(*_merged(group, together, both), least_ratio=0.05, least_shared=0.02)
    parts = _parts_within(owner, sketch, membership, visible, weights, means, surface_width, agreement)
    return _Groups(owner, joins, np.bincount(owner[live], weights[live]), parts)


def _linked(
    piece: Int[np.ndarray, " n"],
    membership: Sparse,
    visible: Sparse,
    weights: Float[np.ndarray, " n"],
    means: Float[np.ndarray, "n 3"],
    surface_width: float,
    agreement: float,
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k k"]]:
    """Links pieces: how much views put two into one mask, less off each other's plane, and how much they see both."""
    live = np.flatnonzero(piece >= 0)
    gather = sparse.csr_matrix((weights[live], (piece[live], live)), shape=(int(piece.max()) + 1, len(piece)))
    in_masks, in_view = gather @ membership, gather @ visible
    off_plane = min(agreement, 1.0)  # then a probability of 1 equals `agreement` in the plane
    coplanarity = _coplanarity(*_piece_planes(gather[:, live], means[live]), surface_width)
    # They have no plane: pieces of four Gaussians each, of sparse scenes, tore balls to shreds.
    sparse_pieces = np.bincount(piece[live]) < 8
    coplanarity[sparse_pieces[:, None] | sparse_pieces] = 1.0
    together = (in_masks @ in_masks.T).toarray() * (off_plane + (1.0 - off_plane) * coplanarity)
    return together, (in_view @ in_view.T).toarray()


def _merged(group: Int[np.ndarray, " k"], *matrices: Float[np.ndarray, "k k"]) -> list[Float[np.ndarray, "g g"]]:
    """Sums rows and columns of the members of each group."""
    member = one_hot(group, int(group.max()) + 1)
    return [member.T @ (member.T @ matrix).T for matrix in matrices]


def _parts_within(
    owner: Int[np.ndarray, " n"],
    sketch: Float[np.ndarray, "n d"],
    membership: Sparse,
    visible: Sparse,
    weights: Float[np.ndarray, " n"],
    means: Float[np.ndarray, "n 3"],
    surface_width: float,
    agreement: float,
) -> _Groups:
    """Divides each object into parts, and joins these to it, as the scene into objects but by pieces of its own.

    In pieces of the scene a knob or an ear would be one with what it stands on. Arguments as for
    `_group_by_consensus`, with the object of each Gaussian in `owner`, -1 for none, and its `_mask_sketch`.
    """
    part, joins, first = np.full(len(owner), -1), [], 0
    order = np.argsort(owner, kind="stable")
    for rows in np.split(order, np.searchsorted(owner[order], np.arange(int(owner.max()) + 1)))[1:]:
        piece = _scene_pieces(sketch[rows], weights[rows], means[rows], min(len(rows) // PIECE_SIZE, MOST_PIECES))
        if not piece.any():
            part[rows], first = first, first + 1
            continue
        columns = membership[rows], visible[rows], weights[rows], means[rows]
        links = _linked(piece, *columns, surface_width, agreement)
        group, _ = _average_linkage(*links, least_ratio=PART_AGREEMENT, least_shared=0.02)
        _, pairs = _average_linkage(*_merged(group, *links), least_ratio=0.0)
        part[rows] = first + group[piece]
        joins += [(first + a, first + b) for a, b in pairs]
        first += int(group.max()) + 1
    known = part >= 0
    return _Groups(part, joins, np.bincount(part[known], weights[known], first))


def _piece_planes(
    gather: Sparse, means: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Computes centres and unit normals of pieces: the direction of least spread of their means, of either sign.

    `gather` (K, N) has the weight of each Gaussian in its piece.
    """
    means = np.asarray(means, np.float64)
    shares = sparse.diags(1.0 / np.asarray(gather.sum(1)).ravel()) @ gather
    local = means - means.mean(0)
    centres = shares @ local
    moments = shares @ np.einsum("ni,nj->nij", local, local).reshape(-1, 9)
    spread = moments.reshape(-1, 3, 3) - np.einsum("ki,kj->kij", centres, centres)
    return centres, np.linalg.eigh(spread)[1][:, :, 0]


def _coplanarity(
    centres: Float[np.ndarray, "k 3"], normals: Float[np.ndarray, "k 3"], width: float
) -> Float[np.ndarray, "k k"]:
    """Computes how well pairs of pieces lie in one plane: exp(-(d / width)^2), 1 if they do.

    With c the centres and n the normals, d is the smaller of |(c_j - c_i) . n_i| and |(c_j - c_i) . n_j|.
    """
    along = centres @ normals.T
    off = np.abs(along - np.diagonal(along)).astype(np.float32)
    return np.exp(-np.square(np.minimum(off, off.T) / width))


def _mask_sketch(membership: Sparse, seed: int) -> Float[np.ndarray, "n 24"]:
    """Projects the masks of each Gaussian at random, to vectors of unit length."""
    basis = np.random.default_rng(seed).standard_normal((membership.shape[1], 24)).astype(np.float32)
    sketch = membership @ basis
    return sketch / np.maximum(np.linalg.norm(sketch, axis=1, keepdims=True), 1e-12)


def _scene_pieces(
    sketch: Float[np.ndarray, "n d"], weights: Float[np.ndarray, " n"], means: Float[np.ndarray, "n 3"], pieces: int
) -> Int[np.ndarray, " n"]:
    """Gathers Gaussians into pieces that are compact and lie in the same masks: (N,) piece, -1 if its weight is 0.

    It runs k-means over the centres (compressed outside of the middle half of the scene, so that distant objects get
    few pieces) and their `_mask_sketch`, initialised by `_split_cells`. Two rounds end within 6 % of the sum
    of squares of k-means++ and mini-batches (bonsai, replica_apartment_0), in a tenth to a third of the time. Arguments
    otherwise as for `_group_by_consensus`.
    """
    piece = np.full(len(means), -1, np.int64)
    live = np.flatnonzero(weights > 0)
    if not len(live):
        return piece
    centred = means[live] - np.median(means[live], axis=0)
    centred = centred / max(1.5 * float(np.median(np.abs(centred))), 1e-12)
    reach = np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1.0)
    centred = centred * (2.0 - 1.0 / reach) / reach
    points = np.concatenate([4.0 * centred, sketch[live]], axis=1).astype(np.float32)
    exact = points.astype(np.float64)
    centres = _cell_means(exact, _split_cells(exact, max(min(pieces, len(live) // 4), 1)))
    for _ in range(2):
        # |p - c|^2 / 2 but for |p|^2 / 2, which is the same for all centres
        lines = np.concatenate([-centres, 0.5 * np.square(centres).sum(1, keepdims=True)], axis=1).astype(np.float32)
        parts = np.array_split(np.pad(points, [(0, 0), (0, 1)], constant_values=1.0), len(points) // 4096 + 1)
        nearest = relabel_sequential(np.concatenate([(part @ lines.T).argmin(1) for part in parts]))
        centres = _cell_means(exact, nearest)
    piece[live] = nearest
    return piece


def _split_cells(points: Float[np.ndarray, "n d"], count: int) -> Int[np.ndarray, " n"]:
    """Divides points (N, D) into at most `count` cells: each round splits those with the largest spread at their mean.

    Up to half of all cells are split per round, along the axis of their spread. Equal points share a cell.
    """
    cell = np.zeros(len(points), np.int64)
    while (have := int(cell.max()) + 1) < count:
        away = points - _cell_means(points, cell)[cell]
        spread = _cell_sums(np.square(away), cell)
        axis, most = spread.argmax(1), spread.max(1)
        widest = np.argsort(-most, kind="stable")[: min(count - have, (have + 1) // 2)]
        widest = widest[most[widest] > 1e-9]
        if not len(widest):
            break
        fresh = np.arange(have)
        fresh[widest] = have + np.arange(len(widest))
        cell = np.where(away[np.arange(len(points)), axis[cell]] > 0, fresh[cell], cell)
    return cell


def _cell_means(points: Float[np.ndarray, "n d"], cell: Int[np.ndarray, " n"]) -> Float[np.ndarray, "k d"]:
    return _cell_sums(points, cell) / np.bincount(cell)[:, None]


def _cell_sums(points: Float[np.ndarray, "n d"], cell: Int[np.ndarray, " n"]) -> Float[np.ndarray, "k d"]:
    """Sums the points of each cell, in their order."""
    shape = (int(cell.max()) + 1, len(cell))
    return sparse.csc_matrix((np.ones(len(cell)), cell, np.arange(len(cell) + 1)), shape=shape) @ points


def _average_linkage(
    together: Float[np.ndarray, "k k"], both: Float[np.ndarray, "k k"], *, least_ratio: float, least_shared: float = 0.0
) -> tuple[Int[np.ndarray, " k"], list[tuple[int, int]]]:
    """Clusters K items by weighted average linkage: (K,) group 0 .. R-1, and the pairs that were joined, in turn.

    The similarity of two groups a and b is

        s_ab = W_ab / V_ab,  W_ab = sum of w_ij over i in a, j in b,  V_ab likewise

    if V_ab > 0 and V_ab >= least_shared sqrt(V_aa V_bb), and 0 otherwise: the mean of w / v over all pairs of members,
    weighted by v. Chains of nearest neighbours need O(K^2) time: s of a union lies between those of its parts, so they
    end in the same groups as repeatedly joining the best pair. `together` is w and `both` is v; groups of a similarity
    below `least_ratio` stay separate. The first item of a pair stands for both after it.
    """
    together, both = ((matrix + matrix.T) / 2.0 for matrix in (together.astype(np.float64), both.astype(np.float64)))
    count = len(together)
    parent = np.arange(count)
    joins: list[tuple[int, int]] = []
    waiting, live = np.ones((2, count), bool)  # a chain may start here; not joined yet

    def ratios(a: int) -> Float[np.ndarray, " k"]:
        scale = np.sqrt(np.maximum(both[a, a] * np.diagonal(both), 0.0))
        eligible = live & (both[a] > 0) & (both[a] >= least_shared * scale)
        row = np.where(eligible, together[a] / np.maximum(both[a], 1e-300), -1.0)
        row[a] = -1.0
        return row

    chain: list[int] = []
    while True:
        if not chain:
            starts = np.flatnonzero(waiting & live)
            if not len(starts):
                break
            chain = [int(starts[0])]
        a = chain[-1]
        row = ratios(a)
        b = int(row.argmax())
        if row[b] < least_ratio:
            waiting[a] = False
            chain = []
        elif len(chain) > 1 and row[chain[-2]] >= row[b]:
            b = chain[-2]
            chain = chain[:-2]
            a, b = min(a, b), max(a, b)
            joins.append((a, b))
            for matrix in (together, both):  # kept exactly symmetric: with rounding errors a chain could cycle
                union = matrix[a, a] + 2.0 * matrix[a, b] + matrix[b, b]
                matrix[a] += matrix[b]
                matrix[:, a] = matrix[a]
                matrix[a, a] = union
            parent[b], live[b], waiting[a] = a, False, True
        else:
            chain.append(b)
    while not np.array_equal(parent, parent[parent]):
        parent = parent[parent]
    return relabel_sequential(parent), joins


def track_masks(
    frames: UInt8[np.ndarray, "t h w 3"],
    scene: SceneSuperpixels,
    *,
    agreement: float = 0.4,
    seed: int = 0,
    progress: Progress | None = None,
) -> Objects:
    """Follows objects through the frames by consensus, independent of the order of the frames.

    The Gaussians are grouped by `_group_by_consensus`, and the groups are assigned the superpixels of each frame. Those
    that few frames show are removed (`clean_tracks`).

    Args:
      frames: (T, H, W, 3) uint8.
      scene: Scene, cameras and proposals of these frames.
      agreement: Probability of a common mask above which Gaussians are grouped.
      seed: Seed of the random projection.
      progress: Called with the number of frames done and of all.
    """
    require(seed >= 0, "seed", seed, "at least 0", "Give another seed.")
    views, means = scene.all(frames, progress), np.asarray(scene.gaussians.means, np.float32)
    width = SURFACE_WIDTH * scene.median_depth
    signatures = _mask_signatures(views, scene.count)
    groups = _group_by_consensus(*signatures, means, surface_width=width, agreement=agreement, seed=seed)
    owner, count = groups.owner, len(groups.weight)
    labels = np.full(frames.shape[:3], -1, np.int16)
    for image, view in zip(labels, views):
        if count:
            mass = (view.votes.T @ one_hot(owner[view.seen], count)).toarray()
            image[:] = assign_superpixels(view, mass, mass.sum(1, keepdims=True))[view.labels]
    cleaned, number = clean_tracks(labels, count)
    tree, leaf = _with_parts(_object_tree(groups, number), groups, number)
    return Objects(cleaned, tree, leaf, *_visible_parts(views, cleaned, tree, leaf, signatures[2]))


def _object_tree(groups: _Groups, number: Int[np.ndarray, " g"]) -> Int32[np.ndarray, " m"]:
    """Builds the tree of objects: (M,) parent of each node, as `Objects.tree` has it.

    `number` is the object of each group, -1 for one that was removed. A join that adds less than NEW_NODE to a union
    makes no node: what joins becomes a child of the union.
    """
    count = int(number.max(initial=-1)) + 1
    node, parent, weight = number.tolist(), [-1] * count, [0.0] * count
    for group in np.flatnonzero(number >= 0):
        weight[node[group]] = float(groups.weight[group])
    for first, second in groups.joins:
        small, large = sorted((node[first], node[second]), key=lambda n: (n >= 0, weight[n] if n >= 0 else 0.0))
        adds_much = large < count or weight[small] >= NEW_NODE * (weight[small] + weight[large])
        if small >= 0 and (adds_much or small > large):  # parents come after their children
            parent[large] = len(parent)
            parent.append(-1)
            weight.append(weight[large])
            large = parent[large]
        if small >= 0:
            parent[small] = large
            weight[large] += weight[small]
        node[first] = large
    return np.array(parent, np.int32)


def _with_parts(
    tree: Int32[np.ndarray, " m"], groups: _Groups, number: Int[np.ndarray, " g"]
) -> tuple[Int32[np.ndarray, " p"], Int32[np.ndarray, " n"]]:
    """Adds the parts of objects to their tree, and finds the smallest node of each Gaussian (N,), -1 for none.

    Arguments as for `_object_tree`, whose result is `tree`. An object of a single part has no further node.
    """
    parts = groups.parts
    if parts is None:
        return tree, np.full(len(groups.owner), -1, np.int32)
    known = groups.owner >= 0
    of_part = np.full(len(parts.weight), -1)
    of_part[parts.owner[known]] = number[groups.owner[known]]
    kept = of_part >= 0
    below = _object_tree(parts, np.where(kept, np.cumsum(kept) - 1, -1))
    whole = np.pad(of_part[kept], (0, len(below) - kept.sum()), constant_values=-1)
    for child, parent in enumerate(below):
        if parent >= 0:
            whole[parent] = whole[child]
    is_top = below < 0  # the object itself
    node = np.where(is_top, whole, len(tree) + np.cumsum(~is_top) - 1)
    leaf = np.full(len(groups.owner), -1, np.int32)
    of_leaf = np.full(len(kept), -1)
    of_leaf[kept] = node[: kept.sum()]
    leaf[known] = of_leaf[parts.owner[known]]
    return np.concatenate([tree, node[below[~is_top]]]).astype(np.int32), leaf


def _visible_parts(
    views: list[FrameSuperpixels],
    labels: Int16[np.ndarray, "t h w"],
    tree: Int32[np.ndarray, " m"],
    leaf: Int32[np.ndarray, " n"],
    weights: Float[np.ndarray, " n"],
) -> tuple[Int16[np.ndarray, "l t h w"], Int32[np.ndarray, " p"]]:
    """Finds the parts of objects that masks of two views show alone, with an IoU of at least 0.5.

    A part has LEAST_PART to MOST_PART of its object's weight. Of one and a part of it with more than half of its
    weight, the one that more views show stays. Parts that lie in each other have labels on different layers.

    Args:
      views: Superpixels of the frames.
      labels: Object 0 .. R-1 of each pixel, -1 for none.
      tree: Parent of each node, whose first R are the objects.
      leaf: Smallest node of each Gaussian.
      weights: Weight of each Gaussian.

    Returns:
      Part 0 .. P-1 of each pixel on each layer, -1 for none; and the node of each part.
    """
    count = int(labels.max(initial=-1)) + 1
    under = _nodes_under(tree)
    total = under @ np.bincount(leaf[leaf >= 0], weights[leaf >= 0], len(tree))
    objects = np.where(np.arange(len(tree)) < count, np.arange(len(tree)), -1)
    for node in range(len(tree) - 1, count - 1, -1):  # parents come after their children
        objects[node] = -1 if tree[node] < 0 else objects[tree[node]]
    share = total / np.maximum(total[objects], 1e-12)
    is_part = (np.arange(len(tree)) >= count) & (objects >= 0)
    nodes = np.flatnonzero(is_part & (share >= LEAST_PART) & (share <= MOST_PART))
    nodes = nodes[np.argsort(-total[nodes], kind="stable")]
    if not len(nodes):
        return np.full((1, *labels.shape), -1, np.int16), nodes.astype(np.int32)
    object_of = np.append(objects, -1)[leaf]
    inside = one_hot(leaf, len(tree)) @ under[nodes].T  # (N, P)
    shown, masks = np.zeros(len(nodes), int), []
    for view, view_labels in zip(views, labels):
        item = np.full(view.proposals.shape[1], -1)
        item[view.labels] = view_labels
        seen = view.votes.T.tocsr()
        of_objects = (seen @ one_hot(object_of[view.seen], count)).toarray()
        mask = (seen @ inside[view.seen]).toarray() >= 0.5 * of_objects[:, objects[nodes]]
        mask &= (item[:, None] == objects[nodes]) & (of_objects[:, objects[nodes]] > 0)
        area, visible_nodes = np.bincount(view.labels.reshape(-1)).astype(np.float32), np.flatnonzero(mask.any(0))
        both = (view.proposals * area) @ mask[:, visible_nodes]
        fit = both / np.maximum((view.proposals @ area)[:, None] + area @ mask[:, visible_nodes] - both, 1.0)
        if fit.size:  # a mask shows the part that it fits best
            shown[visible_nodes[np.unique(fit.argmax(1)[fit.max(1) >= 0.5])]] += 1
        masks.append(mask)
    above = under[nodes][:, nodes].toarray() > 0  # (P, P) whether one lies in another, or is the same
    alike = above & (total[nodes] > 0.5 * total[nodes][:, None])
    alike |= alike.T
    kept = shown >= 2
    for n in np.argsort(-shown, kind="stable"):
        if kept[n]:
            kept[np.flatnonzero(alike[n])] = False
            kept[n] = True
    layer = above[np.ix_(kept, kept)].sum(0) - 1
    result = np.full((int(layer.max(initial=0)) + 1, *labels.shape), -1, np.int16)
    for t, (view, mask) in enumerate(zip(views, masks)):
        part = np.full((len(result), view.proposals.shape[1]), -1, np.int16)
        for n, inside_it in enumerate(mask[:, kept].T):
            part[layer[n], inside_it] = n
        result[:, t] = part[:, view.labels]
    return result, nodes[kept].astype(np.int32)


def _nodes_under(tree: Int32[np.ndarray, " m"]) -> Sparse:
    """Finds the nodes under each node of a tree, itself among them: a sparse matrix (M, M) of ones."""
    rows = [np.arange(len(tree))]
    while (up := np.where(rows[-1] >= 0, np.append(tree, -1)[rows[-1]], -1)).max(initial=-1) >= 0:
        rows.append(up)
    above = np.concatenate(rows)
    columns = np.tile(np.arange(len(tree)), len(rows))[above >= 0]
    shape = (len(tree), len(tree))
    return sparse.csr_matrix((np.ones(len(columns), np.float32), (above[above >= 0], columns)), shape=shape)


def clean_tracks(
    labels: Integer[np.ndarray, "t h w"], count: int
) -> tuple[Int16[np.ndarray, "t h w"], Int[np.ndarray, " r"]]:
    """Removes objects that fewer than two frames show, and renumbers the others in order of first appearance.

    In a frame of which it fills less than MIN_AREA an object is removed too. `labels` are below `count`, -1 for no
    object. Also returns the new number of each object, -1 if it is removed.
    """
    if count == 0:
        return np.full(labels.shape, -1, np.int16), np.zeros(0, int)
    areas = np.stack([np.bincount(image[image >= 0].reshape(-1), minlength=count) for image in labels])  # (T, R)
    shown = areas >= max(MIN_AREA * labels[0].size, 1)
    kept = shown.sum(0) >= 2
    first = np.where(kept, shown.argmax(0), len(labels))
    order = np.lexsort((np.arange(count), first))[: kept.sum()]
    number = np.full(count + 1, -1, np.int16)  # the last entry is for label -1
    number[order] = np.arange(len(order))
    table = np.where(np.concatenate([shown, np.zeros((len(labels), 1), bool)], 1), number, -1).astype(np.int16)
    return np.stack([row[image] for row, image in zip(table, labels)]), number[:-1]


def _mask_signatures(views: list[FrameSuperpixels], count: int) -> tuple[Sparse, Sparse, Float[np.ndarray, " n"]]:
    """Computes the input of `_group_by_consensus`: membership (N, M), visible (N, T) and weights (N,).

    The visibility of a Gaussian in a frame is its clarity, relative to the frame that sees it best: on an outline it
    overlaps its neighbours. A frame abstains on a Gaussian by the share that lies in no mask of it. The shares in the
    masks are squared and normalised, which favours the majority. Overlapping masks divide it, so that a frame with many
    levels of masks counts no more than one with a single partition.
    """
    shares, visibilities, weights, start = [], [], np.zeros(count, np.float64), 0
    for t, view in enumerate(views):
        totals = view.totals
        weights[view.seen] += totals
        # Two Gaussians are together with the mean, over the layers of masks, of the product of their shares.
        layers = np.maximum(view.proposals.sum(0).max(initial=1.0), 1.0)
        cast = (view.votes @ sparse.csr_matrix(view.proposals.T)).tocoo()  # weight of each Gaussian on each proposal
        outside = np.maximum(1.0 - np.asarray(cast.sum(1)).ravel() / np.maximum(totals * layers, 1e-12), 0.0)
        share = cast.data / np.maximum(totals[cast.row] * layers, 1e-12)
        norm = np.bincount(cast.row, share**2, len(totals)) + outside**2 / layers
        share = share**2 / np.maximum(norm[cast.row], 1e-12)
        visibility = view.clarity * np.bincount(cast.row, share, len(totals))
        keep = share >= 0.05 / layers  # less is an edge's blur
        share = (share * np.sqrt(layers) * view.clarity[cast.row])[keep].astype(np.float32)
        shares.append((share, view.seen[cast.row[keep]], start + cast.col[keep]))
        visibilities.append((visibility.astype(np.float32), view.seen, np.full(len(view.seen), t)))
        start += len(view.proposals)
    matrices = []
    for entries, width in ((shares, start), (visibilities, len(views))):
        values, rows, columns = (np.concatenate(parts) for parts in zip(*entries))
        matrices.append(sparse.csr_matrix((values, (rows, columns)), shape=(count, width)))
    membership, visible = matrices
    return membership, visible, (weights / max(len(views), 1)).astype(np.float32)
