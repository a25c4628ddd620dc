"""What `agents/train.py` is made of, whatever the algorithm: threads, signals, evaluation."""
