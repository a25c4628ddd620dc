"""Runs policies for whole episodes, computes metrics, and writes reports."""
