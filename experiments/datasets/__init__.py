"""LERF, 3D-OVS, Replica and ScanNet: loaders, and twins of them in their own layouts."""
