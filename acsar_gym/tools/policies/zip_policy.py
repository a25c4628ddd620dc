"""Policies in zips of stable-baselines3. Loading one can run code, so users must trust the file."""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path

from acsar_gym import reading
from acsar_gym.errors import PolicyError, require_extra
from acsar_gym.tools.policies.onnx import OnnxPolicy
from acsar_gym.tools.policies.policy import resolve

MAX_ZIP_BYTES = 500_000_000


class ZipPolicy(OnnxPolicy):
    """A policy from a zip of PPO, A2C, SAC, TD3, DDPG, TQC or RecurrentPPO.

    The model is exported in memory, and the result drives. Loading a zip can run any code in it.
    The statistics of a VecNormalize aren't part of a zip, so its file must be next to the zip, or
    be named.

    Args:
        path: The zip.
        trust: Whether the user trusts the zip. Without it, only the names in it are read.
        env_id: Id of the env that it is for. Default: the env that `acsar-gym train` stored.
        robot: Preset, file or config of the robot that it was trained on, if the zip doesn't say.
        vecnormalize: File of the VecNormalize that it was trained with, or "none" if that changed
            only rewards. Default: the file beside the zip, if the zip needs one.

    Raises:
        PolicyError: `trust` is False, or the file is missing, broken or of another kind, or it
            needs the file of a VecNormalize.
        ConfigError: There is no such env.
        MissingExtraError: stable-baselines3, onnx or onnxruntime isn't installed.

    Example:
        from stable_baselines3 import PPO
        from acsar_gym.tools.policies import ZipPolicy, sb3

        PPO("MlpPolicy", sb3.make_batch("point_goal", 2)).save("model.zip")
        policy = ZipPolicy("model.zip", trust=True, env_id="acsar_gym/PointGoal-v0")
    """

    def __init__(
        self,
        path: str | Path,
        *,
        trust: bool = False,
        env_id: str = "",
        robot: str | Path | None = None,
        vecnormalize: str | Path | None = None,
    ) -> None:
        self.path = resolve(path)
        content = reading.read_file(self.path, MAX_ZIP_BYTES, PolicyError)
        if not _is_model(content):
            raise PolicyError(f"{self.path}: isn't a zip of a stable-baselines3 model")
        check_trust(self.path, trust=trust)
        with require_extra("loading a stable-baselines3 zip", "train"):
            from acsar_gym.tools.policies import sb3_export  # noqa: PLC0415
        try:
            network = sb3_export.convert_zip(content, self.path, env_id, robot, vecnormalize)
        except PolicyError as error:
            raise PolicyError(f"{self.path}: {error}") from error

        self._load(network)
        self.sha256 = hashlib.sha256(content).hexdigest()
        self.env_named = bool(env_id)
        self.env_id = env_id or self.document.env


def check_trust(path: Path, *, trust: bool) -> None:
    """Raise PolicyError for a zip that the user doesn't trust."""
    if not trust:
        raise PolicyError(
            f"{path}: a stable-baselines3 zip can run any code when it's loaded: pass --trust if "
            "you made it or trust its author"
        )


def _is_model(content: bytes) -> bool:
    """Whether the names in a zip are those of a model of stable-baselines3."""
    # Reading names runs no code.
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return {"data", "policy.pth"} <= set(archive.namelist())
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return False
