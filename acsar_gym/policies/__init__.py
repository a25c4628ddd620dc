"""Trained policies: ONNX files, stable-baselines3 zips, and functions in Python files.

Importing this package imports neither torch nor onnxruntime.
"""

from acsar_gym.policies.base import FilePolicy, Policy, resolve
from acsar_gym.policies.callables import CallablePolicy, is_callable
from acsar_gym.policies.onnx import OnnxPolicy
from acsar_gym.policies.saving import actor, save
from acsar_gym.policies.sb3_zip import ZipPolicy, statistics_beside

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
