"""Benchmarks of environments, batches and worlds."""
