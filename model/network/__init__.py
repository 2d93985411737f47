"""The encoder-decoder network and its ONNX predictor."""
