"""A made-up room with ray-traced ground truth, and `jsecon demo`, which builds and measures a field of it."""

from jsecon.demo.capture import room_cameras, room_capture, write_room
from jsecon.demo.raycast import render_views
from jsecon.demo.room import crowded_room

__all__ = ["crowded_room", "render_views", "room_cameras", "room_capture", "write_room"]
