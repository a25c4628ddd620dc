"""What a file is, by its first bytes and a zip's list of names; runs and unpickles nothing."""

from __future__ import annotations

import io
import zipfile

POLICY_FILES = (
    "an ONNX file, as 'acsar-gym train' and 'acsar-gym export' write it, or a zip of "
    "stable-baselines3"
)
MODEL_ENTRIES = frozenset({"data", "policy.pth"})
"""What every zip of a stable-baselines3 model has."""
ONNX_BEGIN = b"\x08"
"""First byte of an ONNX file: the key of its `ir_version`."""
ZIP_BEGIN = b"PK"
PICKLE_BEGIN = b"\x80"


def list_entries(data: bytes) -> frozenset[str]:
    """List the names in a zip; none if it isn't one, or is damaged."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return frozenset(archive.namelist())
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return frozenset()


def describe_other_file(data: bytes) -> str | None:
    """Say what a file is that is given as an ONNX policy, and how to get a policy from it.

    Returns:
        One line; None where it may be an ONNX file.
    """
    if data.startswith(ZIP_BEGIN):
        return describe_other_zip(data) or (
            "a zip of stable-baselines3, which can run code when it's loaded: convert it once with "
            "'acsar-gym export MODEL.zip policy.onnx --trust'"
        )
    if data.startswith(PICKLE_BEGIN):
        return (
            "isn't a policy but a pickle, as older versions of torch.save write it: load it in "
            "Python, and write the network with acsar_gym.tools.policies.save"
        )
    return None if data.startswith(ONNX_BEGIN) else f"isn't a policy: must be {POLICY_FILES}"


def describe_other_zip(data: bytes) -> str | None:
    """Say what a file is that is given as a zip of stable-baselines3; None if it is one."""
    names = list_entries(data)
    if names >= MODEL_ENTRIES:
        return None
    if any(name.endswith("/data.pkl") for name in names):
        return (
            "isn't a policy but what torch.save writes, which can run code when it's loaded: load "
            "it in Python, and write the network with acsar_gym.tools.policies.save"
        )
    if data.startswith(ZIP_BEGIN):
        what = "a zip without a model of stable-baselines3" if names else "a damaged zip"
        return f"isn't a policy but {what}: must be {POLICY_FILES}"
    return f"isn't a policy: must be {POLICY_FILES}"
