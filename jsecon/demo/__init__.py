"""`jsecon demo`: the capture of a made-up room, and what builds, asks and measures a field of it."""
