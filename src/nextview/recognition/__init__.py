"""Evidence, belief, calibration, novelty; ONNX models and their cards."""
