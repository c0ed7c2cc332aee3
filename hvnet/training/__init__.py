"""Training: the batches, and a run."""
