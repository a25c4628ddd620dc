"""A policy as it is sent to other processes and machines: its name, and what its file contains."""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from acsar_gym.errors import PolicyError
from acsar_gym.evaluation import runs
from acsar_gym.policies import FilePolicy, ZipPolicy
from acsar_gym.reading import bounded

MAX_BYTES = 200_000_000


@dataclass(frozen=True)
class Sent:
    """A loaded policy, ready to be loaded again elsewhere."""

    name: str
    """Its path or name."""
    env: str
    """Id of the env that it was loaded for; empty for the one that its file names."""
    function: str | None = field(repr=False)
    trust: bool = field(repr=False)
    sha256: str | None = field(repr=False)
    content: bytes | None = field(repr=False)
    """Content of its file; None for a policy that isn't a file."""

    @classmethod
    def of(cls, policy: FilePolicy) -> Sent:
        """Read the file of a policy.

        Args:
            policy: the policy; a zip that is loaded already is trusted.

        Raises:
            PolicyError: its file has changed since it was loaded.
        """
        env = policy.env_id if policy.env_named else ""
        content = None
        if policy.path.is_file():
            content = bounded.read(policy.path, MAX_BYTES, PolicyError)
            if policy.sha256 not in (None, _hash(content)):
                raise PolicyError(f"{policy.path}: changed since it was loaded: start again")
        trust = isinstance(policy, ZipPolicy)
        return cls(str(policy.path), env, policy.function, trust, policy.sha256, content)

    def load(self) -> FilePolicy:
        """Load the policy: from its file if that is the same here, else from the content.

        Raises:
            PolicyError: it can't be loaded here.
        """
        return _loaded(self)


@lru_cache(maxsize=4)
def _loaded(sent: Sent) -> FilePolicy:
    """Load a policy; a process needs few of them, but each for many jobs."""
    if sent.content is None or _same(sent):
        return _load(sent, sent.name)
    with tempfile.TemporaryDirectory(prefix="acsar_gym-") as folder:
        copy = Path(folder) / Path(sent.name).name
        copy.write_bytes(sent.content)
        return _load(sent, str(copy))


def _load(sent: Sent, path: str) -> FilePolicy:
    """Load a policy from a path or by its name."""
    name = f"{path}:{sent.function}" if sent.function else path
    return runs.load(name, trust=sent.trust, env=sent.env)


def _same(sent: Sent) -> bool:
    """Whether the file here has the content that was sent."""
    with contextlib.suppress(OSError):
        return _hash(Path(sent.name).read_bytes()) == _hash(sent.content or b"")
    return False


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
