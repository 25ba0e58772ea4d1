"""What jsecon's own embedder makes of a folder against PyTorch on the same texts and regions: cleaning, tokens, crops
and normalisation included."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch

from experiments.export.graph import Agreement
from jsecon.networks.clip import ClipEmbedder, _masked_crop

TEXTS = [
    "a photo of a red mug",
    "Sofa, grey & soft!",
    "th\u00e9 \u00e0 la menthe",
    "dark_green bottle's cap",
    "the small green plant on the window sill " * 12,
    "tea &amp; milk",
]
FRAMES = ("orange ball", "blue box on a brown table", "where nothing is, nothing is found")


def compared(
    rows: list[Agreement],
    folder: Path,
    encode: Callable[[torch.Tensor], torch.Tensor],
    texts: torch.Tensor,
    ids: torch.Tensor,
    numbers: Mapping[str, list],
) -> dict:
    """Compares the embedder over a folder.

    Args:
      rows: Agreements of its graphs.
      folder: The folder.
      encode: Unit embeddings of crops of a patterned frame, normalised by `numbers` (mean, std, size).
      texts: Unit embeddings of TEXTS.
      ids: Their tokens.
      numbers: The preprocessing.

    Returns:
      {"graphs": all agreements, "tokens": how many texts have the same ids, and how far apart the embeddings of
      different texts and regions are: as a random model sees them, which says what a difference is worth}.
    """
    embedder = ClipEmbedder(folder)
    with torch.inference_mode():
        frame, masks = regions()
        crops = np.stack([_masked_crop(frame, mask, numbers["size"][0]) for mask in masks])
        pixels = torch.from_numpy(crops).permute(0, 3, 1, 2).float() / 255
        mean, std = (torch.tensor(numbers[key]).reshape(1, 3, 1, 1) for key in ("mean", "std"))
        seen = encode((pixels - mean) / std).numpy()
    said, wanted = embedder.embed_text(TEXTS), texts.detach().numpy()
    looked = embedder.embed_regions(frame, masks)
    same = embedder._tokenizer(TEXTS, ids.shape[1])[0] == ids.numpy()
    embedder.close()
    rows = [*rows, _row(f"{len(masks)} regions by ClipEmbedder", looked, seen)]
    rows.append(_row("6 texts by ClipEmbedder", said, wanted))
    told = {"texts": len(TEXTS), "same_ids": int(same.all(1).sum()), "ids_in_texts": int(np.unique(ids.numpy()).size)}
    told |= {"texts_apart": _apart(wanted), "regions_apart": _apart(seen)}
    return {"graphs": [dataclasses.asdict(row) for row in rows], "tokens": told}


def regions() -> tuple[np.ndarray, np.ndarray]:
    """A frame (120, 160, 3) of colours and stripes, and four masks of it."""
    rows, columns = np.mgrid[:120, :160]
    frame = np.stack([rows * 2, columns, 255 * ((rows // 6 + columns // 9) % 2)], -1).astype(np.uint8)
    masks = np.stack([(rows - y) ** 2 + (columns - x) ** 2 < r * r for y, x, r in _DISCS])
    return frame, masks


_DISCS = ((40, 40, 30), (60, 120, 25), (95, 60, 20), (30, 100, 12))


def _apart(units: np.ndarray) -> float:
    """The least, over pairs of different rows, of the largest difference of a number."""
    gaps = np.abs(units[:, None] - units[None]).max(-1)
    return float(gaps[~np.eye(len(units), dtype=bool)].min())


def _row(name: str, found: np.ndarray, wanted: np.ndarray) -> Agreement:
    same = {"embedding": float(((found > 0) == (wanted > 0)).mean())}
    off = {"embedding": float(np.abs(found - wanted).max())}
    return Agreement(name, off, {"embedding": float(np.abs(wanted).max())}, same, 0.0)
