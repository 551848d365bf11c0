"""How good the checkpoint is: systems, metrics, the report."""
