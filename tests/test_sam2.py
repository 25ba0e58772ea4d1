"""SAM 2 as a tracker: against a slow twin that keeps everything, on small graphs of the true signatures."""

import dataclasses
import shutil
import tracemalloc

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from sam2_files import CHANNELS, GRID, LOW, MEMORY, SIZE, SLOTS, write_sam2

from jsecon.errors import InputError
from jsecon.networks.onnx_graph import Graph
from jsecon.networks.sam2.graphs import open_sam2
from jsecon.networks.sam2.heads import Prompt, fill_holes
from jsecon.networks.sam2.tracker import Sam2Tracker, at_size, follow
from jsecon.vision.protocols import Tracker

HEIGHT, WIDTH = 20, 28
TOLERANCE = 0.01
"""of logits: a memory that lies between two numbers of bfloat16 may be rounded to either"""


@pytest.fixture(scope="module", params=["2.0", "2.1"])
def folder(request, tmp_path_factory):
    return write_sam2(tmp_path_factory.mktemp(f"sam{request.param}"), version=request.param)


def a_clip(count, seed=0):
    rng = np.random.default_rng(seed)
    frames = np.stack([rng.integers(0, 256, (5, 7, 3), dtype=np.uint8) for _ in range(count)])
    return np.stack([cv2.resize(frame, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST) for frame in frames])


def a_mask(left, top, right, bottom):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top:bottom, left:right] = True
    return mask


class Twin:
    """The official predictor's procedure, one object at a time; nothing is ever dropped."""

    def __init__(self, folder, frames):
        self.graphs = {path.name.removesuffix("_small.onnx"): Graph(path) for path in folder.glob("*.onnx")}
        self.constants = dict(np.load(folder / "constants.npz"))
        self.frames, self.outputs = frames, {}

    def encode(self, t):
        image = np.asarray(Image.fromarray(self.frames[t]).resize((SIZE, SIZE), Image.Resampling.BICUBIC)) / 255.0
        image = (image - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
        return self.graphs["image_encoder"].run({"input_image": np.moveaxis(image, 2, 0)[None].astype(np.float32)})

    def decode(self, found, image, points=((0.0, 0.0),), labels=(-1,), hint=None, multimask=True):
        prompt = self.graphs["prompt_encoder"].run(
            {
                "coords": np.array([points], np.float32),
                "labels": np.array([labels], np.int32),
                "masks": np.zeros((1, LOW, LOW), np.float32) if hint is None else hint,
                "masks_enable": np.array([0 if hint is None else 1], np.int32),
            }
        )
        out = self.graphs["mask_decoder"].run(
            {
                "image_embeddings": image.astype(np.float32),
                "image_pe": prompt["dense_pe"],
                "sparse_prompt_embeddings": prompt["sparse_embeddings"],
                "dense_prompt_embeddings": prompt["dense_embeddings"],
                "high_res_features1": found["backbone_fpn_0"],
                "high_res_features2": found["backbone_fpn_1"],
            }
        )
        best = 1 + np.argmax(out["iou_pred"][0, 1:])
        mask, token = out["masks"][0, 0], out["sam_tokens_out"][0, 0]
        if multimask:
            mask, token = out["masks"][0, best], out["sam_tokens_out"][0, best]
        elif (mask > 0.05).sum() < 0.98 * (mask > -0.05).sum():
            mask = out["masks"][0, best]
        score = out["object_score_logits"][0, 0]
        if score > 0:
            return mask, self.graphs["mlp"].run({"x": token[None]})["x_out"][0], score
        return np.full_like(mask, -1024), self.constants["no_obj_ptr"][0], score

    def prompt(self, t, prompt):
        found = self.encode(t)
        image = found["backbone_fpn_2"]
        if prompt.mask is None:
            points = prompt.points / [WIDTH, HEIGHT] * SIZE
            image = image + self.constants["no_mem_embed"].reshape(1, -1, 1, 1)
            mask, pointer, score = self.decode(found, image, points, prompt.labels, multimask=len(points) == 1)
        else:
            whole = Image.fromarray(prompt.mask.astype(np.float32)).resize((SIZE, SIZE), Image.Resampling.BILINEAR)
            whole = np.asarray(whole) >= 0.5
            square = Image.fromarray(np.where(whole, 10, -10).astype(np.float32))
            mask = np.asarray(square.resize((LOW, LOW), Image.Resampling.BILINEAR))
            hint = np.zeros((1, LOW, LOW), np.float32)
            for i in range(LOW):
                for j in range(LOW):
                    patch = whole[4 * i : 4 * i + 4, 4 * j : 4 * j + 4] * self.constants["mask_downsample_weight"][0, 0]
                    hint[0, i, j] = patch.sum() + self.constants["mask_downsample_bias"][0]
            pointer, score = self.decode(found, image, hint=hint, multimask=False)[1], 10.0
        binary = 20.0 * (self.upsample(mask) > 0) - 10.0
        return {"mask": mask, "pointer": pointer, "score": score, **self.memory(found, binary, score)}

    def track(self, t, reverse, prompted, others):
        found, past = self.encode(t), (1 if reverse else -1)
        attended = [(SLOTS - 1, out) for out in prompted.values()]
        for back in range(1, SLOTS):
            if t + past * back in others:
                attended.append((back - 1, others[t + past * back]))
        code = self.constants["maskmem_tpos_enc"][:, 0, 0]
        spatial = np.concatenate([out["memory"] for _, out in attended])
        places = np.concatenate([out["place"] + code[row] for row, out in attended])
        most = min(len(self.frames), 16)
        known = [(abs(t - f), out) for f, out in prompted.items() if (f >= t if reverse else f <= t)]
        known += [(back, others[t + past * back]) for back in range(1, most) if t + past * back in others]
        tokens = np.array([out["pointer"] for _, out in known], np.float32).reshape(-1, MEMORY)
        ages = np.zeros((len(known), MEMORY), np.float32)
        if "obj_ptr_tpos_proj" in self.graphs and known:
            sines = np.zeros((len(known), CHANNELS))
            for n, (back, _) in enumerate(known):
                for k in range(CHANNELS // 2):
                    angle = back / (most - 1) / 10000 ** (2 * (k // 2) / (CHANNELS // 2))
                    sines[n, k], sines[n, CHANNELS // 2 + k] = np.sin(angle), np.cos(angle)
            ages = self.graphs["obj_ptr_tpos_proj"].run({"x": sines.astype(np.float32)})["x_out"]
        flat = lambda image: image.reshape(CHANNELS, -1).T[:, None]
        image = self.graphs["memory_attention"].run(
            {
                "curr": flat(found["backbone_fpn_2"]),
                "curr_pos": flat(found["vision_pos_enc_2"]),
                "memory_1": spatial[:, None],
                "memory_pos_1": places[:, None],
                "memory_2": tokens[:, None],
                "memory_pos_2": np.repeat(ages, CHANNELS // MEMORY, 0)[:, None],
            }
        )["pix_feat"]
        mask, pointer, score = self.decode(found, image[:, 0].T.reshape(1, CHANNELS, GRID, GRID))
        soft = 20 / (1 + np.exp(-np.clip(self.upsample(mask), -500, 500))) - 10
        return {"mask": mask, "pointer": pointer, "score": score, **self.memory(found, soft, score)}

    def memory(self, found, mask, score):
        out = self.graphs["memory_encoder"].run(
            {"pix_feat": found["backbone_fpn_2"], "masks": mask[None, None].astype(np.float32)}
        )
        features = out["vision_features"]
        if score <= 0 and "no_obj_embed_spatial" in self.constants:
            features = features + self.constants["no_obj_embed_spatial"][..., None, None]
        features = np.asarray(jnp.asarray(features).astype(jnp.bfloat16).astype(jnp.float32))
        flat = lambda image: image.reshape(MEMORY, -1).T
        return {"memory": flat(features), "place": flat(out["vision_pos_enc"])}

    def upsample(self, mask):
        at = np.clip((np.arange(SIZE) + 0.5) * LOW / SIZE - 0.5, 0, LOW - 1)
        rows = np.stack([np.interp(at, np.arange(LOW), column) for column in mask.T], 1)
        return np.stack([np.interp(at, np.arange(LOW), row) for row in rows])

    def __call__(self, own, start):
        prompted = {p.frame: self.prompt(p.frame, p) for p in own}
        others = {}
        for reverse, order in ((False, range(start, len(self.frames))), (True, range(start - 1, -1, -1))):
            for t in order:
                if t not in prompted:
                    others[t] = self.track(t, reverse, prompted, others)
        self.outputs = prompted | others
        return np.stack([self.outputs[t]["mask"] for t in range(len(self.frames))])


def test_frames_forward_and_backward_equal_the_twin(folder):
    frames, start = a_clip(24), 9
    prompts = [
        [Prompt(start, a_mask(3, 4, 15, 13)), Prompt(17, a_mask(8, 2, 20, 11))],
        [Prompt(start, points=np.array([[12, 6], [25, 18]], np.float32), labels=np.array([2, 3], np.int32))],
        [Prompt(start, points=np.array([[6.0, 9.0]], np.float32), labels=np.array([1], np.int32))],
        [Prompt(12, a_mask(2, 2, 9, 9))],
    ]
    found = dict(follow(open_sam2(folder), frames, prompts, start=start, hole_area=0))
    assert list(found) == [*range(start, 24), *range(start - 1, -1, -1)]
    signs, changed = set(), 0.0
    for number, own in enumerate(prompts):
        twin = Twin(folder, frames)
        wanted = twin(own, start)
        ours = np.stack([found[t][number] for t in range(24)])
        np.testing.assert_allclose(ours, wanted, atol=TOLERANCE)
        signs |= {out["score"] > 0 for out in twin.outputs.values()}
        twin.constants["maskmem_tpos_enc"] = twin.constants["maskmem_tpos_enc"][::-1]
        changed = max(changed, np.abs(twin(own, start) - wanted).max())
    assert changed > 20 * TOLERANCE  # a wrong code would show
    assert signs == {True, False}  # objects present, and absent


def test_absent_objects_leave_no_pixel_and_their_own_memory(folder):
    frames = a_clip(24)
    twin = Twin(folder, frames)
    wanted = twin([Prompt(0, a_mask(3, 4, 15, 13))], 0)
    absent = [t for t, out in twin.outputs.items() if out["score"] <= 0]
    assert absent
    labels = Sam2Tracker(folder)(frames, 0, a_mask(3, 4, 15, 13)[None])
    assert (labels[absent] == -1).all()
    assert all((wanted[t] == -1024).all() for t in absent)


def test_tracker_gives_each_pixel_to_the_highest_logit(folder):
    frames = a_clip(6)
    prompts = np.stack([a_mask(3, 4, 15, 13), np.zeros((HEIGHT, WIDTH), bool), a_mask(10, 6, 25, 18)])
    tracker = Sam2Tracker(folder, hole_area=0)
    assert isinstance(tracker, Tracker)
    labels = tracker(frames, 2, prompts)
    assert labels.shape == frames.shape[:3]
    assert labels.dtype == np.int16
    assert set(np.unique(labels)) <= {-1, 0, 2}
    for t, logits in follow(tracker.sam2, frames, [[Prompt(2, prompts[0])], [Prompt(2, prompts[2])]], hole_area=0):
        whole = np.stack([at_size(low, (HEIGHT, WIDTH)) for low in logits])
        wanted = np.where(whole.max(0) > 0, np.array([0, 2])[whole.argmax(0)], -1)
        np.testing.assert_array_equal(labels[t], wanted)
    assert (tracker(frames, 2, prompts[1:2]) == -1).all()


def test_the_name_follows_the_content_and_the_graphs_can_be_dropped(tmp_path):
    one, same = write_sam2(tmp_path / "one"), write_sam2(tmp_path / "same")
    other = write_sam2(tmp_path / "other", seed=5)
    tracker = Sam2Tracker(one)
    assert tracker.name == Sam2Tracker(same).name
    assert len({tracker.name, Sam2Tracker(other).name, Sam2Tracker(one, hole_area=0).name}) == 3
    frames, prompts = a_clip(3), a_mask(3, 4, 15, 13)[None]
    before = tracker(frames, 1, prompts)
    tracker.close()
    np.testing.assert_array_equal(tracker(frames, 1, prompts), before)
    tracker.check()
    (one / "mlp_small.onnx").write_bytes((one / "mask_decoder_small.onnx").read_bytes())
    with pytest.raises(InputError, match="mlp_small"):
        tracker.check()


@pytest.mark.long
def test_four_hundred_frames_hold_no_more_than_a_hundred(folder, tmp_path):
    sam2, peaks = open_sam2(folder), []
    for count in (100, 400):
        path = tmp_path / f"{count}.npy"
        np.save(path, np.broadcast_to(a_clip(1), (count, HEIGHT, WIDTH, 3)))
        frames = np.load(path, mmap_mode="r")
        own = [[Prompt(count // 2, a_mask(3, 4, 15, 13))]]
        for t, _ in follow(sam2, frames[:3], [[dataclasses.replace(own[0][0], frame=1)]]):  # what is made once
            assert t < 3
        tracemalloc.start()
        assert sum(len(logits) for _, logits in follow(sam2, frames, own)) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0] + 100_000


def test_holes_are_filled_up_to_their_area():
    logits = np.ones((9, 9), np.float32)
    logits[1, 1] = logits[2, 2] = -3.0  # one hole of two, through the corner
    logits[5:8, 5:8] = -2.0
    filled = fill_holes(logits, 2)
    assert (filled[[1, 2], [1, 2]] == np.float32(0.1)).all()
    assert (filled[5:8, 5:8] == -2).all()
    np.testing.assert_array_equal(fill_holes(logits, 0), logits)
    np.testing.assert_array_equal(fill_holes(logits, 1), logits)
    assert (fill_holes(np.full((2, 2), -1.0, np.float32), 4) == np.float32(0.1)).all()


def test_prompts_outside_the_sequence_are_refused(folder):
    with pytest.raises(ValueError, match="frames below 3"):
        next(follow(open_sam2(folder), a_clip(3), [[Prompt(3, a_mask(0, 0, 4, 4))]]))
    with pytest.raises(ValueError, match="own size"):
        Sam2Tracker(folder)(a_clip(3), 0, np.zeros((1, 4, 4), bool))


def without(path, name, instead=None):
    """`instead`: the array that takes its place."""
    stored = {other: array for other, array in np.load(path).items() if other != name}
    np.savez(path, **stored, **({} if instead is None else {name: instead}))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: (f / "memory_encoder_small.onnx").unlink(), "memory_encoder"),
        (lambda f: shutil.copy(f / "mlp_small.onnx", f / "mlp_large.onnx"), "mlp_large.onnx, mlp_small.onnx"),
        (lambda f: (f / "constants.npz").unlink(), "constants.npz"),
        (lambda f: (f / "constants.npz").write_bytes(b"PK\x03\x04 cut"), "constants.npz"),
        (lambda f: without(f / "constants.npz", "no_obj_ptr"), "no_obj_ptr"),
        (
            lambda f: without(f / "constants.npz", "maskmem_tpos_enc", np.zeros((0, 1, 1, 4), np.float32)),
            "without numbers",
        ),
        (lambda f: (f / "obj_ptr_tpos_proj_small.onnx").unlink(), "without obj_ptr_tpos_proj"),
        (lambda f: shutil.copy(f / "mlp_small.onnx", f / "mask_decoder_small.onnx"), "image_embeddings"),
        (lambda f: shutil.copy(write_sam2(f / "o", memory=6) / "memory_encoder_small.onnx", f), "vision_features"),
        (
            lambda f: (f / "image_encoder_small.onnx").write_bytes((f / "image_encoder_small.onnx").read_bytes()[:999]),
            "image_encoder_small.onnx",
        ),
    ],
)
def test_a_wrong_folder_is_named(damage, said, tmp_path):
    model = write_sam2(tmp_path / "model")
    damage(model)
    with pytest.raises(InputError, match=said):
        open_sam2(model)


def test_the_version_is_read_from_the_files(tmp_path):
    assert open_sam2(write_sam2(tmp_path / "a", version="2.0")).version == "2.0"
    assert open_sam2(write_sam2(tmp_path / "b", version="2.1")).version == "2.1"
