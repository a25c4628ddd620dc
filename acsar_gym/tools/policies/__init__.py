"""Trained policies: ONNX files, stable-baselines3 zips, and functions in Python files.

Importing this package imports neither torch nor onnxruntime.
"""

from acsar_gym.tools.policies.onnx import OnnxPolicy, actor, save
from acsar_gym.tools.policies.policy import CallablePolicy, FilePolicy, Policy, is_callable, resolve
from acsar_gym.tools.policies.sb3_zip import ZipPolicy, statistics_beside

__all__ = [
    "CallablePolicy",
    "FilePolicy",
    "OnnxPolicy",
    "Policy",
    "ZipPolicy",
    "actor",
    "is_callable",
    "resolve",
    "save",
    "statistics_beside",
]
