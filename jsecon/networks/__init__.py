"""ONNX graphs: SAM, SAM 2 and CLIP from model folders."""
