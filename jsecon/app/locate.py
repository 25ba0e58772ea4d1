"""Where an answer is, for a robot: centre, boxes and points, in metres of the capture's world."""

import dataclasses
import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from jsecon.app.ask import Answer
from jsecon.errors import InputError
from jsecon.field.membership import probability_inside
from jsecon.query.object_shapes import gaussian_spreads, object_shapes
from jsecon.splat.transform import transform_gaussians_float64
from jsecon.types import Gaussians, LanguageField


@dataclasses.dataclass(frozen=True)
class Place:
    """One thing in the capture's world, in its unit (metres if the capture has metres)."""

    name: str
    centroid: np.ndarray
    """(3,) mean of the centres of the selected Gaussians, as in an answer's .json."""
    center: np.ndarray
    """(3,) middle of the oriented box. It lies nearer to the middle of a thing that is seen from one side: views from
    above see more of its top, which pulls the centroid upwards."""
    axes: np.ndarray
    """(3, 3) unit columns, right-handed, the longest first: principal axes of the points."""
    extent: np.ndarray
    """(3,) length of the box along each axis."""
    low: np.ndarray
    """(3,) lower corner of the box along the world's axes."""
    high: np.ndarray
    """(3,) upper corner of that box."""
    points: np.ndarray
    """(M, 3) centres of the Gaussians."""
    score: float
    """similarity of the best region with the text."""
    probability: float
    """mean probability that a Gaussian belongs to the answer (`probability_inside`)."""
    frame: str = "the capture's world"

    def as_dict(self) -> dict[str, Any]:
        """Makes a record for JSON.

        Returns:
          Plain values by name: those of this class, with the number of the points in place of the points.
        """
        size = float(np.linalg.norm(self.high - self.low))
        lengths = {name: rounded(getattr(self, name), size) for name in ("centroid", "center", "extent", "low", "high")}
        return {
            "name": self.name,
            **lengths,
            "axes": np.round(self.axes, 6).tolist(),
            "points": len(self.points),
            "score": round(self.score, 6),
            "probability": round(self.probability, 4),
            "frame": self.frame,
        }


def locate_answer(field: LanguageField, answer: Answer) -> Place:
    """Locates what an answer selected.

    Args:
      field: The field.
      answer: Answer of that field, with a row for each of its Gaussians.

    Returns:
      Centre, boxes and points of the selection.

    Raises:
      InputError: No Gaussian is selected.
    """
    if not answer.mask.any():
        problem = f"no Gaussian is selected (score {float(answer.selection.score):.3f})"
        raise InputError(f"query {answer.query!r}", problem, remedy="Ask with other words, or by a pixel.")
    mask = np.asarray(answer.mask)
    plain = dataclasses.replace(field.gaussians, sh=field.gaussians.sh[:, :1])  # the place does not need colours
    selected = transform_gaussians_float64(gaussian_rows(plain, mask), field.source_from_scene)
    points = selected_centers(field, mask)
    shape = object_shapes(points, np.zeros(len(points), int), spreads=gaussian_spreads(selected))[0]
    return Place(
        name=answer.query,
        centroid=points.mean(0),
        center=shape.center,
        axes=shape.axes,
        extent=2 * shape.half_size,
        low=shape.low,
        high=shape.high,
        points=points,
        score=float(answer.selection.score),
        probability=float(probability_inside(answer.selection.similarity, field.votes, answer.mask).mean()),
    )


def gaussian_rows(gaussians: Gaussians, rows: np.ndarray) -> Gaussians:
    """Takes some of the Gaussians.

    Args:
      gaussians: N Gaussians.
      rows: Mask (N,) bool, or the indices of those to take.

    Returns:
      These Gaussians as NumPy arrays.
    """
    return jax.tree.map(lambda column: np.asarray(column)[np.asarray(rows)], gaussians)


def selected_centers(field: LanguageField, mask: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "m 3"]:
    """Places the Gaussians of a mask in the capture's world.

    Args:
      field: The field.
      mask: (N,) bool, M of them True.

    Returns:
      (M, 3) float64 centres.
    """
    source_from_scene = np.asarray(field.source_from_scene, np.float64)
    return (
        np.asarray(field.gaussians.means)[mask].astype(np.float64) @ source_from_scene[:3, :3].T
        + source_from_scene[:3, 3]
    )


def decimals(size: float, part: float) -> int:
    """Counts the decimals of a thing's coordinates.

    Args:
      size: Size of the thing.
      part: Smallest difference that the decimals show, as a share of the size.

    Returns:
      The number of decimals; 6 for a size of 0 or one that is not finite.
    """
    return max(0, math.ceil(-math.log10(size * part))) if size > 0 and math.isfinite(size) else 6


def rounded(values: np.ndarray, size: float) -> list[float]:
    """Rounds coordinates of a thing to a millionth of its size.

    Args:
      values: The coordinates, of any shape.
      size: Size of the thing, in their unit.

    Returns:
      The coordinates as a list, with six decimals or more.
    """
    return np.round(np.asarray(values, np.float64), max(6, decimals(size, 1e-6))).tolist()
