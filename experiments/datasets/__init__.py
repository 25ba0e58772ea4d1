"""Loaders of LERF, 3D-OVS and Replica, and writers of made-up scenes in their layouts."""
