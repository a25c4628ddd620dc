"""Trained policies: ONNX files, stable-baselines3 zips, and functions in Python files.

Importing this package imports neither torch nor onnxruntime.
"""

from acsar_gym.tools.policies.code import CallablePolicy, is_callable
from acsar_gym.tools.policies.onnx import OnnxPolicy
from acsar_gym.tools.policies.policy import FilePolicy, Policy, resolve
from acsar_gym.tools.policies.saving import actor, save
from acsar_gym.tools.policies.zip_policy import ZipPolicy

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
]
