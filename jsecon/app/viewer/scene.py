"""A field in the viewer's window: its Gaussians in groups, each sent alone, its frames, and where one looks from."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from jsecon.app.viewer.static_page import main_regions
from jsecon.numerics import sigmoid
from jsecon.splat.project import is_usable
from jsecon.splat.sh import C0
from jsecon.types import LanguageField

GROUPS = 16
"""of Gaussians: only those whose colours change are sent again, and viser knows no less than all of a group"""
LARGEST = 200.0
"""standard deviation in the window's units, of which the middle one is 1: viser holds covariances in 16 bits, which end
at 0.008 and 256"""
FRUSTUMS = 150
"""frames drawn in the scene; the list has all"""
SECONDS, STEPS = 0.4, 12
"""of a flight to a frame"""


class Layers:
    """The field in the window: Gaussians, and the frames that it was made from."""

    def __init__(self, server: Any, field: LanguageField):
        gaussians = field.gaussians
        sound = np.asarray(is_usable(gaussians))
        finite = lambda a: np.where(sound[:, None], a, np.float32(1))
        sizes = np.exp(np.asarray(finite(gaussians.log_scales), np.float64))
        there = sizes[sound]
        there = there[there > 0]  # a flat Gaussian has a size of 0 along its normal
        self.scale = 1 / float(np.median(there)) if len(there) else 1.0
        """of the window's unit, per unit of the field"""
        self.photo = (255 * np.clip(0.5 + C0 * np.asarray(gaussians.sh)[:, 0], 0, 1)).astype(np.uint8)
        """(N, 3) colours as photographed, of degree 0."""
        self._server, self._cameras = server, field.cameras
        opacity = np.where(sound, np.nan_to_num(np.asarray(sigmoid(np.asarray(gaussians.opacity_logits)))), 0)
        self._opacity = np.rint(255 * opacity).astype(np.uint8)
        turns = Rotation.from_quat(finite(gaussians.quaternions), scalar_first=True).as_matrix()
        halves = (turns * np.minimum(sizes * self.scale, LARGEST)[:, None]).astype(np.float32)
        spread, centres = halves @ halves.transpose(0, 2, 1), finite(gaussians.means) * np.float32(self.scale)
        self._groups = []
        order = np.argsort(main_regions(field), kind="stable")
        for k, rows in enumerate(np.array_split(order, max(min(GROUPS, len(order)), 1))):
            own = {"centers": centres[rows], "covariances": spread[rows], "rgbs": self.photo[rows]}
            handle = server.scene.add_gaussian_splats(f"/field/{k}", opacities=self._opacity[rows, None], **own)
            self._groups.append((rows, handle))
        poses = np.asarray(field.cameras.world_to_camera, np.float64)
        self._turns = Rotation.from_matrix(poses[:, :3, :3].transpose(0, 2, 1))
        self._centres = -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3]) * self.scale
        self.frustums, self._at, self._shown = self._frustums(server), 0, False
        begin, up = server.initial_camera, -poses[:, 1, :3].mean(0)
        server.scene.set_up_direction(up / np.linalg.norm(up))
        ahead = self._turns[0].apply([0, 0, 1])
        depth = (centres - self._centres[0]) @ ahead
        away = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
        begin.position, begin.look_at, begin.fov = self._centres[0], self._centres[0] + away * ahead, self.fov(0)
        begin.near, begin.far = 0.01 * self.scale, 1e4 * self.scale

    def fov(self, frame: int) -> float:
        """Vertical, in radians."""
        return 2 * float(np.arctan(self._cameras.height / 2 / np.asarray(self._cameras.fy)[frame]))

    def _frustums(self, server: Any) -> dict[int, Any]:
        chosen = range(0, len(self._centres), -(-len(self._centres) // FRUSTUMS))
        size = 0.06 * float(np.linalg.norm(np.std(self._centres, axis=0))) or 0.1 * self.scale
        shape = {"aspect": self._cameras.width / self._cameras.height, "scale": size, "color": (150, 170, 200)}
        shape |= {"thickness": 1.2, "thickness_units": "screen", "variant": "filled", "visible": False}
        wxyz = self._turns.as_quat(scalar_first=True)
        add = server.scene.add_camera_frustum
        return {t: add(f"/frames/{t}", self.fov(t), wxyz=wxyz[t], position=self._centres[t], **shape) for t in chosen}

    def paint(self, colours: np.ndarray, seen: np.ndarray) -> None:
        """Colours (N, 3) uint8 of the Gaussians that are `seen` (N,), the others gone. Sends the groups that change."""
        opacity = np.where(seen, self._opacity, np.uint8(0))
        packed = np.concatenate([colours, opacity[:, None]], axis=1).view(np.uint32)[:, 0]
        with self._server.atomic():
            for rows, handle in self._groups:
                if (handle.buffer[:, 7] != packed[rows]).any():
                    buffer = handle.buffer.copy()
                    buffer[:, 7] = packed[rows]
                    handle.buffer = buffer
        self._server.flush()

    def show_frames(self, shown: bool) -> None:
        """Shows the frames' cameras, or hides them; never the one that one stands in, which would cover the view."""
        self._shown = shown
        for frame, frustum in self.frustums.items():
            frustum.visible = shown and frame != self._at

    def look(self, camera: Sequence[float]) -> None:
        """Everybody looks from a state's camera."""
        position, target, up = np.asarray(camera, np.float64).reshape(3, 3)
        begin = self._server.initial_camera
        begin.position, begin.look_at = position * self.scale, target * self.scale
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.up_direction = up
                client.camera.position, client.camera.look_at = position * self.scale, target * self.scale

    def fly(self, client: Any, frame: int) -> None:
        """Takes a client to where a frame was taken."""
        start = np.asarray(client.camera.position)
        both = Rotation.concatenate([Rotation.from_quat(client.camera.wxyz, scalar_first=True), self._turns[frame]])
        turn = Slerp([0, 1], both)
        for step in np.linspace(0, 1, STEPS + 1)[1:]:
            with client.atomic():
                client.camera.position = start + step * (self._centres[frame] - start)
                client.camera.wxyz = turn(step).as_quat(scalar_first=True)
            client.flush()
            time.sleep(SECONDS / STEPS)
        client.camera.fov, self._at = self.fov(frame), frame
        self.show_frames(self._shown)
