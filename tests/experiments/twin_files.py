"""Twins as small as they can be and still hold objects to find, one a dataset; a test changes a copy."""

import numpy as np

from experiments.baselines.evidence import Evidence
from experiments.datasets import twins

SMALL = {"views": 6, "width": 64, "height": 48, "num_objects": 6}


def lerf_twin(root):
    return twins.write_lerf_twin(root, "figurines", 0, annotated_every=3, label_pixels=8, **SMALL)


def ovs3d_twin(root):
    return twins.write_ovs3d_twin(root, "bed", 1, labelled_frames=3, **SMALL)


def replica_twin(root, scene="room0"):
    size = {"views": 6, "width": 75, "height": 43, "num_objects": 6, "fine_m": 0.02, "coarse_m": 0.15}
    return twins.write_replica_twin(root, scene, 2, **size)


def rooms_instances(seed, cameras):
    """(T, H, W) the objects that ray casting finds, asked for again from the room itself."""
    from experiments.datasets.plain_room import make_room
    from experiments.rooms.raycast import trace_rays

    room = make_room(seed, num_objects=SMALL["num_objects"])
    owners = np.array([part.owner for part in room.parts] + [-1])
    return np.stack([owners[trace_rays(room, cameras[t])[1]] for t in range(len(cameras.fx))])


def evidence_of_tracks(gaussians, cameras, tracks, embeddings):
    """Evidence whose masks are the tracks (T, H, W) of each frame; embeddings (T, R, E) of region r in frame t."""
    masks, rows, frame = np.full(tracks.shape, -1, np.int32), [], []
    for t, image in enumerate(tracks):
        for region in np.unique(image[image >= 0]):
            masks[t][image == region] = len(rows)
            rows.append(embeddings[t, region])
            frame.append(t)
    return Evidence(gaussians, cameras, masks, np.stack(rows), np.array(frame, np.int32), tracks.astype(np.int32))
