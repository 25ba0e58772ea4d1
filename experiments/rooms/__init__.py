"""Made-up rooms with ray-traced ground truth. `ship` made the capture that `jsecon demo` copies."""

from experiments.rooms.capture import room_cameras, room_capture, write_room
from experiments.rooms.raycast import render_views
from experiments.rooms.room import crowded_room

__all__ = ["crowded_room", "render_views", "room_cameras", "room_capture", "write_room"]
