"""Learned matchers through onnxruntime, and the cards that describe their models."""
