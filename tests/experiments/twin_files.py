"""Twins as small as they can be and still hold objects to find, one a dataset; a test changes a copy."""

from experiments.datasets import twins

SMALL = {"views": 6, "width": 64, "height": 48, "num_objects": 6}


def lerf_twin(root):
    return twins.write_lerf_twin(root, "figurines", 0, annotated_every=3, label_pixels=8, **SMALL)


def ovs3d_twin(root):
    return twins.write_ovs3d_twin(root, "bed", 1, labelled_frames=3, **SMALL)


def replica_twin(root, scene="room0", **more):
    size = {"views": 6, "width": 75, "height": 43, "num_objects": 6, "fine_m": 0.02, "coarse_m": 0.15}
    return twins.write_replica_twin(root, scene, 2, **size, **more)


def scannet_twin(root):
    return twins.write_scannet_twin(root, "scene0000_00", 3, fine_m=0.02, coarse_m=0.15, lost=(4,), **SMALL)


def rooms_instances(seed, cameras):
    """(T, H, W) the objects that ray casting finds, asked for again from the room itself."""
    from jsecon.demo import make_room, render_views

    return render_views(make_room(seed, num_objects=SMALL["num_objects"]), cameras)
