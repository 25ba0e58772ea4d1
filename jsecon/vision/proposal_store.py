"""A segmenter whose masks are kept on disk by content: a frame is cut once by the same model with the same settings.

    FOLDER/<digest of model, settings and frame>.npz      bits (M, ceil(H W / 8)) uint8, shape (3,)

SAM takes minutes a frame on a CPU; a run that is stopped in the middle of its frames goes on where it stopped.
"""

import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from jsecon.files import written_whole
from jsecon.vision.embedding_store import frame_digest
from jsecon.vision.protocols import NamedSegmenter

_UNREADABLE = (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile)


class StoredSegmenter:
    """Segmenter (jsecon.vision.protocols) that asks `segmenter` for what `folder` does not hold.

    The segmenter's `name` must tell it from others, and from itself with other settings. A file that cannot be read is
    computed again. Raises InputError where the folder cannot be written.
    """

    def __init__(self, segmenter: NamedSegmenter, folder: str | Path):
        self.name = segmenter.name
        self._segmenter, self._folder = segmenter, Path(folder)

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> Bool[np.ndarray, "m h w"]:
        """frame (H, W, 3) uint8 -> masks (M, H, W) bool, as the segmenter gave them."""
        path = self._folder / f"{frame_digest(self.name, frame)}.npz"
        try:
            with np.load(path, allow_pickle=False) as file:
                count, height, width = file["shape"].tolist()
                pixels = np.unpackbits(file["bits"], axis=1, count=height * width)
            return pixels.reshape(count, height, width).astype(bool)
        except _UNREADABLE:
            masks = np.asarray(self._segmenter(frame, index), bool)
        bits = np.packbits(masks.reshape(len(masks), frame.shape[0] * frame.shape[1]), axis=1)
        with written_whole(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, allow_pickle=False, bits=bits, shape=np.asarray(masks.shape))
        return masks

    def check(self) -> None:
        """Raises InputError where the segmenter cannot work."""
        self._segmenter.check()

    def close(self) -> None:
        """Drops what the segmenter holds in memory."""
        self._segmenter.close()
