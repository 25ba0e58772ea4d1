"""The Gaussians of a field in the viewer's window, and the places of its frames."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jsecon.app.catalogue import main_regions
from jsecon.numerics import sigmoid
from jsecon.splat.project import is_usable
from jsecon.splat.sh import C0
from jsecon.types import LanguageField
from jsecon.views.frame import field_up

GROUPS = 16
"""number of groups of Gaussians; only groups whose colours change are sent again, since viser sends all of a group"""
MAX_STD = 200.0
"""largest standard deviation in units of the window, whose median is 1; viser holds covariances in 16 bits, from 0.008
to 256"""


def first_view(field: LanguageField) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Finds where the first frame was taken, what it looks at, and the up axis, in the field's world."""
    pose = np.asarray(field.cameras.world_to_camera, np.float64)[0]
    eye = -pose[:3, :3].T @ pose[:3, 3]
    forward = pose[2, :3]
    means = np.asarray(field.gaussians.means, np.float64)
    offsets = means[np.isfinite(means).all(1)] - eye
    depth = offsets @ forward
    ahead = depth[np.linalg.norm(offsets - depth[:, None] * forward, axis=1) < 0.2 * depth]
    distance = float(np.median(ahead)) if len(ahead) else 1.0
    return eye, eye + distance * forward, np.array(field_up(field).axis)


class SplatLayer:
    """The Gaussians in the window, in groups that are sent one by one, and the places of the frames.

    Args:
      server: The viser server.
      field: The field.

    Attributes:
      scale: Units of the window per unit of the field.
      photo: (N, 3) uint8 colours of degree 0.
      fovs: (T,) vertical fields of view of the frames, radians.
    """

    def __init__(self, server: Any, field: LanguageField):
        gaussians = field.gaussians
        usable = np.asarray(is_usable(gaussians))

        def where_usable(column: Any) -> np.ndarray:
            return np.where(usable[:, None], column, np.float32(1))

        sizes = np.exp(np.asarray(where_usable(gaussians.log_scales), np.float64))
        positive = sizes[usable]
        positive = positive[positive > 0]  # a flat Gaussian has a size of 0 along its normal
        self.scale = 1 / float(np.median(positive)) if len(positive) else 1.0
        self.photo = (255 * np.clip(0.5 + C0 * np.asarray(gaussians.sh)[:, 0], 0, 1)).astype(np.uint8)
        self._server = server
        self.fovs = 2 * np.arctan(field.cameras.height / 2 / np.asarray(field.cameras.fy, np.float64))
        opacity = np.nan_to_num(np.asarray(sigmoid(np.asarray(gaussians.opacity_logits))))
        self._opacity = np.rint(255 * np.where(usable, opacity, 0)).astype(np.uint8)
        rotations = Rotation.from_quat(where_usable(gaussians.quaternions), scalar_first=True).as_matrix()
        roots = (rotations * np.minimum(sizes * self.scale, MAX_STD)[:, None]).astype(np.float32)
        covariances = roots @ roots.transpose(0, 2, 1)
        centers = where_usable(gaussians.means) * np.float32(self.scale)
        self._groups = []
        order = np.argsort(main_regions(field), kind="stable")
        for k, rows in enumerate(np.array_split(order, max(min(GROUPS, len(order)), 1))):
            handle = server.scene.add_gaussian_splats(
                f"/field/{k}",
                centers=centers[rows],
                covariances=covariances[rows],
                rgbs=self.photo[rows],
                opacities=self._opacity[rows, None],
            )
            self._groups.append((rows, handle))
        self._poses = np.asarray(field.cameras.world_to_camera, np.float64)
        eye, target, up = first_view(field)
        server.scene.set_up_direction(up)
        camera = server.initial_camera
        camera.position = eye * self.scale
        camera.look_at = target * self.scale
        camera.fov = float(self.fovs[0])
        camera.near = 0.01 * self.scale
        camera.far = 1e4 * self.scale

    def paint(self, colours: np.ndarray, visible: np.ndarray) -> None:
        """Colours the Gaussians, (N, 3) uint8 RGB. Only groups that change are sent."""
        opacity = np.where(visible, self._opacity, np.uint8(0))
        packed = np.concatenate([colours, opacity[:, None]], axis=1).view(np.uint32)[:, 0]
        with self._server.atomic():
            for rows, handle in self._groups:
                if (handle.buffer[:, 7] != packed[rows]).any():
                    buffer = handle.buffer.copy()
                    buffer[:, 7] = packed[rows]
                    handle.buffer = buffer
        self._server.flush()

    def go_to(self, client: Any, frame: int) -> None:
        """Moves a viser client to the camera of a frame."""
        pose = np.linalg.inv(self._poses[frame])
        with client.atomic():
            client.camera.position = pose[:3, 3] * self.scale
            client.camera.wxyz = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        client.camera.fov = float(self.fovs[frame])

    def draw_length(self, number: int, start: np.ndarray, end: np.ndarray, words: str) -> None:
        """Draws a length between two points (3,) of the field's world, with words in its middle."""
        ends = (self.scale * np.stack([start, end])).astype(np.float32)
        scene, name, yellow = self._server.scene, f"/lengths/{number}", (255, 220, 0)
        scene.add_point_cloud(f"{name}/ends", ends, yellow, point_size=1.5, point_shape="circle")
        if words:
            scene.add_line_segments(f"{name}/line", ends[None], yellow, thickness=3.0, thickness_units="screen")
            scene.add_label(f"{name}/label", words, position=ends.mean(0), anchor="bottom-center")
