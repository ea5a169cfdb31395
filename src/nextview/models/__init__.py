"""Inference with ONNX Runtime: the bundled models, their cards and inputs."""
