"""The demo room: a procedural capture with ground truth."""

from jsecon.data.synthetic.capture import room_cameras, room_capture, write_room
from jsecon.data.synthetic.raycast import render_views
from jsecon.data.synthetic.room import make_room

__all__ = ["make_room", "render_views", "room_cameras", "room_capture", "write_room"]
