"""SAM 2 as a tracker: against a slow twin that keeps everything, on small graphs of the public export's signatures."""

import json
import tracemalloc

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from sam2_files import CHANNELS, MEAN, MEMORY, POINTERS, SIZE, SLOTS, STD, write_sam2

from jsecon.networks.sam2 import HOLE_AREA, Sam2Tracker, _fill_holes, _open_sam2, follow
from jsecon.networks.session import Graph

HEIGHT, WIDTH = 20, 28
TOLERANCE = 0.01
"""of logits: a memory that lies between two numbers of bfloat16 may be rounded to either"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_sam2(tmp_path_factory.mktemp("sam2"))


def a_clip(count, seed=0):
    rng = np.random.default_rng(seed)
    frames = np.stack([rng.integers(0, 256, (5, 7, 3), dtype=np.uint8) for _ in range(count)])
    return np.stack([cv2.resize(frame, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST) for frame in frames])


def a_mask(left, top, right, bottom):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top:bottom, left:right] = True
    return mask


class Twin:
    """The official predictor's procedure on the five graphs, one object at a time; nothing is ever dropped."""

    def __init__(self, folder, frames):
        self.graphs = {path.stem: Graph(path) for path in (folder / "onnx").glob("*.onnx")}
        constants = json.loads((folder / "constants.json").read_text())
        self.code = np.array(constants["memory_temporal_positional_encoding"])
        self.frames, self.outputs = frames, {}

    def encode(self, t):
        image = np.asarray(Image.fromarray(self.frames[t]).resize((SIZE, SIZE), Image.Resampling.BICUBIC)) / 255.0
        image = (image - MEAN) / STD
        return self.graphs["vision_encoder"].run({"pixel_values": np.moveaxis(image, 2, 0)[None].astype(np.float32)})

    def decode(self, seen, image, points=((0.0, 0.0),), labels=(-1,)):
        feeds = {name: seen[name] for name in ("feats0", "feats1")} | {"feats2_cond": image}
        feeds |= {"input_points": np.array([[points]], np.float32), "input_labels": np.array([[labels]], np.int32)}
        out = self.graphs["mask_decoder"].run(feeds)
        score = out["object_score_logits"].item()
        return out["low_res_mask"][0, 0], out["high_res_mask"], out["object_pointer"][0, 0], score

    def prompt(self, t, prompt):
        seen = self.encode(t)
        is_mask = isinstance(prompt, np.ndarray)
        if is_mask:
            rows, columns = np.nonzero(prompt)
            points, labels = [[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]], [2, 3]
        else:
            points, labels = prompt
        points = np.asarray(points) / [WIDTH, HEIGHT] * SIZE
        low, high, pointer, score = self.decode(seen, seen["feats2_no_mem"], points, labels)
        if is_mask:
            mask = Image.fromarray(prompt.astype(np.float32)).resize((SIZE, SIZE), Image.Resampling.BILINEAR)
            high = np.where(np.asarray(mask) >= 0.5, 10, -10).astype(np.float32)
            low = np.asarray(Image.fromarray(high).resize(low.shape, Image.Resampling.BILINEAR))
            high, score = high[None, None], 10.0
        return self.remember(seen, low, high, pointer, score, 1.0)

    def track(self, t, past, start, prompted, others):
        """`past`: -1 if the frames before t are attended to, else 1."""
        seen = self.encode(t)
        near = [back for back in range(1, POINTERS) if t + past * back in others]
        attended = [(SLOTS - 1, prompted), *((back - 1, others[t + past * back]) for back in near if back < SLOTS)]
        attended += [attended[min(1, len(attended) - 1)]] * (SLOTS - len(attended))
        most = min(len(self.frames), POINTERS)
        known = [(abs(t - start), prompted), *((back, others[t + past * back]) for back in near if back < most)]
        known += [known[min(1, len(known) - 1)]] * (POINTERS - len(known))
        ages = self.graphs["pointer_tpos"].run({"normalized_diffs": np.array([d for d, _ in known]) / (most - 1)})
        spatial = [out["memory"] for _, out in attended]
        pointers = np.array([out["pointer"] for _, out in known], np.float32).reshape(-1, MEMORY)
        places = [out["place"] + self.code[row] for row, out in attended]

        def flat(image):
            return image.reshape(CHANNELS, -1).T[:, None]

        image = self.graphs["memory_attention"].run(
            {
                "current_vision_features": flat(seen["feats2"]),
                "current_vision_position_embeddings": flat(seen["vision_pos_embed"]),
                "memory": np.concatenate([*spatial, pointers])[:, None],
                "memory_pos": np.concatenate([*places, np.repeat(ages["pointer_pos"], CHANNELS // MEMORY, 0)])[:, None],
            }
        )["conditioned_feats"]
        return self.remember(seen, *self.decode(seen, image), 0.0)

    def remember(self, seen, low, high, pointer, score, binarize):
        feeds = {"feats2": seen["feats2"], "high_res_mask": high, "object_score_logits": np.array([[score]])}
        out = self.graphs["memory_encoder"].run(feeds | {"binarize": np.float32(binarize)})
        memory = np.asarray(jnp.asarray(out["memory_tokens"][:, 0]).astype(jnp.bfloat16).astype(jnp.float32))
        return {"mask": low, "pointer": pointer, "score": score, "memory": memory, "place": out["memory_pos"][:, 0]}

    def __call__(self, prompt, start):
        prompted, others = self.prompt(start, prompt), {}
        for past, order in ((-1, range(start + 1, len(self.frames))), (1, range(start - 1, -1, -1))):
            for t in order:
                others[t] = self.track(t, past, start, prompted, others)
        self.outputs = {start: prompted} | others
        return np.stack([self.outputs[t]["mask"] for t in range(len(self.frames))])


def test_frames_forward_and_backward_equal_the_twin(folder):
    frames, start = a_clip(24), 5  # more after it than are remembered
    prompts = [
        a_mask(3, 4, 15, 13),
        (np.array([[12, 6], [25, 18]], np.float32), np.array([2, 3], np.int32)),
        (np.array([[6.0, 9.0]], np.float32), np.array([1], np.int32)),
    ]
    found = dict(follow(_open_sam2(folder), frames, start, prompts))
    assert list(found) == [*range(start, 24), *range(start - 1, -1, -1)]
    signs, changed = set(), 0.0
    for number, prompt in enumerate(prompts):
        twin = Twin(folder, frames)
        wanted = twin(prompt, start)
        ours = np.stack([found[t][number] for t in range(24)])
        np.testing.assert_allclose(ours, wanted, atol=TOLERANCE)
        signs |= {out["score"] > 0 for out in twin.outputs.values()}
        assert all((wanted[t] == -1024).all() for t, out in twin.outputs.items() if out["score"] <= 0)
        twin.code = twin.code[::-1]
        changed = max(changed, np.abs(twin(prompt, start) - wanted).max())
    assert changed > 20 * TOLERANCE  # a wrong code would show
    assert signs == {True, False}  # objects present, and absent


def test_tracker_gives_each_pixel_to_the_highest_logit(folder):
    frames = a_clip(6)
    prompts = np.stack([a_mask(3, 4, 15, 13), np.zeros((HEIGHT, WIDTH), bool), a_mask(10, 6, 25, 18)])
    tracker = Sam2Tracker(folder)
    labels = tracker(frames, 2, prompts)
    assert labels.shape == frames.shape[:3]
    assert labels.dtype == np.int16
    assert set(np.unique(labels)) <= {-1, 0, 2}
    for t, logits in follow(_open_sam2(folder), frames, 2, [prompts[0], prompts[2]]):
        whole = np.stack([cv2.resize(_fill_holes(low, HOLE_AREA), (WIDTH, HEIGHT)) for low in logits])
        wanted = np.where(whole.max(0) > 0, np.array([0, 2])[whole.argmax(0)], -1)
        np.testing.assert_array_equal(labels[t], wanted)
    assert (tracker(frames, 2, prompts[1:2]) == -1).all()


def test_the_name_follows_the_content_and_the_graphs_can_be_dropped(folder, tmp_path):
    tracker = Sam2Tracker(folder)
    assert tracker.name == Sam2Tracker(write_sam2(tmp_path / "same")).name
    assert tracker.name != Sam2Tracker(write_sam2(tmp_path / "other", seed=5)).name
    frames, prompts = a_clip(3), a_mask(3, 4, 15, 13)[None]
    before = tracker(frames, 1, prompts)
    tracker.close()
    np.testing.assert_array_equal(tracker(frames, 1, prompts), before)


@pytest.mark.long
def test_four_hundred_frames_hold_no_more_than_a_hundred(folder, tmp_path):
    sam2, peaks = _open_sam2(folder), []
    for count in (100, 400):
        path = tmp_path / f"{count}.npy"
        np.save(path, np.broadcast_to(a_clip(1), (count, HEIGHT, WIDTH, 3)))
        frames = np.load(path, mmap_mode="r")
        prompts = [a_mask(3, 4, 15, 13)]
        for t, _ in follow(sam2, frames[:3], 1, prompts):  # what is made once
            assert t < 3
        tracemalloc.start()
        assert sum(len(logits) for _, logits in follow(sam2, frames, count // 2, prompts)) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0] + 100_000


def test_holes_are_filled_up_to_their_area():
    logits = np.ones((9, 9), np.float32)
    logits[1, 1] = logits[2, 2] = -3.0  # one hole of two, through the corner
    logits[5:8, 5:8] = -2.0
    filled = _fill_holes(logits, 2)
    assert (filled[[1, 2], [1, 2]] == np.float32(0.1)).all()
    assert (filled[5:8, 5:8] == -2).all()
    np.testing.assert_array_equal(_fill_holes(logits, 1), logits)
