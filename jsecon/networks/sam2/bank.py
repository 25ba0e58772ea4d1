"""What SAM 2 remembers of one object, and which of it a frame attends to (facebookresearch/sam2, sam2_base.py).

A bank holds the memories of the prompted (conditioning) frames for good, and those of tracked frames while some frame
to come can still reach them. `step` is the direction of tracking: 1 forward, -1 backward. Plain dictionaries by frame
number, so that what is attended can be read, tested and bounded without a network.
"""

import dataclasses

import numpy as np

POINTERS = 16
"""object pointers that a frame attends to: those of conditioning frames, and of at most one fewer tracked frames"""


@dataclasses.dataclass(frozen=True)
class Memory:
    """What one frame left behind."""

    spatial: np.ndarray | None
    """(T, M) uint16: bfloat16 of the memory encoder's features, row by row; None once out of reach."""
    pointer: np.ndarray
    """(C,) float32: the object pointer."""


@dataclasses.dataclass(frozen=True)
class Bank:
    """The memories of one object."""

    conditioning: dict[int, Memory]
    """by prompted frame."""
    tracked: dict[int, Memory] = dataclasses.field(default_factory=dict)
    """by tracked frame."""

    def with_tracked(self, t: int, memory: Memory) -> "Bank":
        """The bank after frame `t` was tracked."""
        return Bank(self.conditioning, self.tracked | {t: memory})


def spatial_memories(bank: Bank, t: int, step: int, *, slots: int) -> list[tuple[int, np.ndarray]]:
    """(row of maskmem_tpos_enc, spatial memory) of all that frame `t` attends to.

    `slots` (7) counts the memories of a full bank. Every conditioning frame has the last row, however far it is; the
    `slots` - 1 frames before `t` in the direction of tracking have rows 0 (the nearest), 1, ...; frames that were not
    tracked, or are prompted themselves, are left out.
    """
    found = [(slots - 1, memory.spatial) for memory in bank.conditioning.values()]
    for distance in range(slots - 1, 0, -1):
        memory = bank.tracked.get(t - step * distance)
        if memory is not None:
            found.append((distance - 1, memory.spatial))
    lost = [row for row, spatial in found if spatial is None]
    if lost:
        raise ValueError(f"frame {t} reaches memories that were forgotten (rows {lost})")
    return [(row, spatial) for row, spatial in found if spatial is not None]


def pointers(bank: Bank, t: int, step: int, *, count: int) -> list[tuple[int, np.ndarray]]:
    """(distance in frames, pointer (C,)) of all that frame `t` attends to, in a sequence of `count` frames.

    Conditioning frames that lie behind `t` in the direction of tracking, then the tracked frames at distance 1, 2, ...,
    of which there are `reach(count)` at most.
    """
    behind = {f: memory for f, memory in bank.conditioning.items() if (t - f) * step >= 0}
    found = [((t - f) * step, memory.pointer) for f, memory in behind.items()]
    for distance in range(1, reach(count) + 1):
        memory = bank.tracked.get(t - step * distance)
        if memory is not None:
            found.append((distance, memory.pointer))
    return found


def reach(count: int) -> int:
    """Frames back to which pointers are attended, in a sequence of `count` frames."""
    return min(count, POINTERS) - 1


def forget(bank: Bank, t: int, step: int, *, slots: int, turn: int | None) -> Bank:
    """The bank without what no frame after `t` reaches.

    `turn` is the frame before which a backward pass is still to begin (it reads what the forward pass left there and
    beyond), or None. At most 2 (`slots` - 1) spatial memories of tracked frames are left, however long the sequence.
    """
    kept = {}
    for frame, memory in bank.tracked.items():
        nearest = (t + step - frame) * step  # its distance from the next frame
        if turn is not None and frame >= turn:
            nearest = min(nearest, frame - (turn - 1))
        if nearest < POINTERS:
            kept[frame] = memory if nearest < slots else dataclasses.replace(memory, spatial=None)
    return Bank(bank.conditioning, kept)


def to_bfloat16(array: np.ndarray) -> np.ndarray:
    """float32 -> uint16 that holds bfloat16, rounded to nearest, ties to even. Values must be finite."""
    bits = np.ascontiguousarray(array, np.float32).view(np.uint32)
    return ((bits + 0x7FFF + ((bits >> 16) & 1)) >> 16).astype(np.uint16)


def from_bfloat16(array: np.ndarray) -> np.ndarray:
    """uint16 that holds bfloat16 -> float32."""
    return (array.astype(np.uint32) << 16).view(np.float32)
