"""Parts of `agents/train.py` that don't depend on the algorithm: threads, signals, evaluation."""
