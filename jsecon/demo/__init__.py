"""`jsecon demo`: a made-up room with ground truth, and what the demo writes of it."""

from jsecon.demo.capture import room_cameras, room_capture, write_room
from jsecon.demo.raycast import render_views
from jsecon.demo.room import make_room

__all__ = ["make_room", "render_views", "room_cameras", "room_capture", "write_room"]
