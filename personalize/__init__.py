"""The staged pipeline, and everything that joins tracker and model."""
