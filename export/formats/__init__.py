"""File formats: ONNX and NIR."""
