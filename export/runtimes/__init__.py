"""What runs exported files: onnxruntime, the NIR interpreter, other projects' simulators."""
