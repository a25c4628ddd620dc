"""What a policy file says about itself: one JSON document in the metadata of its ONNX network.

`Bundle` is the document; `BUNDLE_KEY` names it in the metadata. It says what the policy observes
and how its actions are meant, on which robot and in which task it was trained, and how. `describe`
makes it from an env, and compares it with another one. Nothing in it is run.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from acsar_gym import reading
from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, PolicyError, escape_unprintable, show_value

BUNDLE_KEY = "acsar_gym.bundle"
"""Key of the metadata of an ONNX file that holds the bundle."""
BUNDLE_VERSION = 1
"""Version of the format that this package writes, and the only one that it reads."""
MAX_BUNDLE_BYTES = 500_000
"""Largest bundle that is read."""
MAX_BUNDLE_DEPTH = 20
"""Deepest nesting of lists and mappings."""

Text = Annotated[str, StringConstraints(max_length=2_000)]
Label = Annotated[str, StringConstraints(min_length=1, max_length=200)]
Sha256 = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Bound = Number | None
"""One end of a range; None: no limit."""
Positive = Annotated[float, Field(gt=0.0, le=1e9)]
Count = Annotated[int, Field(ge=0, le=10**15)]
Size = Annotated[int, Field(gt=0, le=100_000)]
Value = Annotated[Number | tuple[Number, ...] | None, Field(union_mode="left_to_right")]
Span = tuple[Number, Number]
Ranges = dict[Label, Annotated[tuple[Number, ...], Field(min_length=1, max_length=1_000)]]


class EnvSummary(Section):
    """The environment that the policy was trained in."""

    section = "env"
    id: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern="^[^:]*$")]
    """Id without a module, as in "module:id": Gymnasium would import one that the file chooses."""
    options: dict[Label, Any] = Field(default_factory=dict, max_length=100)
    """Options of the task, as JSON has them."""
    worlds: Text = ""
    """The worlds of the training, such as "clutter 1000 to 1399 (train split)"; empty: none."""
    max_episode_steps: Count | None = None


class SensorLayout(Section):
    """The numbers that one sensor adds to an observation."""

    section = "observation.sensors"
    name: Label
    size: Size
    low: Bound
    high: Bound
    layout: Label
    """What the sensor says about its numbers, see `Sensor.layout`."""


class NormalizerSummary(Section):
    """The normalization of observations that the network begins with; it is part of the graph."""

    section = "observation.normalizer"
    kind: Label
    """"running" for mean and standard deviation, otherwise the name of the module's class."""
    clip: Positive | None = None
    mean: tuple[Number, Number] | None = None
    """Least and largest mean that is subtracted."""
    std: tuple[Number, Number] | None = None
    """Least and largest standard deviation that is divided by."""


class ObservationLayout(Section):
    """The numbers of an observation: the task's own, then those of the sensors."""

    section = "observation"
    names: Annotated[tuple[Label, ...], Field(max_length=100_000)]
    low: tuple[Bound, ...]
    high: tuple[Bound, ...]
    sensors: Annotated[tuple[SensorLayout, ...], Field(max_length=1_000)] = ()
    scale: Positive | None = None
    """Length that distances are divided by [m]; None: the task has none."""
    normalizer: NormalizerSummary | None = None
    """None: the network takes observations as they are."""

    @model_validator(mode="after")
    def _one_range_each(self) -> Self:
        """Check that every number of the task has a range."""
        if not len(self.names) == len(self.low) == len(self.high):
            raise ConfigError("observation: names, low and high must be of one length")
        return self

    @property
    def width(self) -> int:
        """How many numbers an observation has."""
        return len(self.names) + sum(sensor.size for sensor in self.sensors)


class ActionLayout(Section):
    """The numbers of an action: parts of the robot's own limits."""

    section = "action"
    names: tuple[Label, ...] = ("linear", "angular")
    units: tuple[Label, ...] = ("max_linear", "max_angular")
    """What 1.0 of each number is: these fields of the robot [m/s, rad/s]."""
    low: tuple[Number, ...] = (-1.0, -1.0)
    high: tuple[Number, ...] = (1.0, 1.0)


class StateLayout(Section):
    """One state of a recurrent policy: an output that is the next decision's input."""

    section = "state"
    input: Label
    output: Label
    shape: Annotated[tuple[Size, ...], Field(min_length=1, max_length=4)]
    """Shape of both, float32, with a batch of one; all zeros at the start of an episode."""


class PolicyRates(Section):
    """How often the policy decides, and the driver sends a command."""

    section = "rates"
    policy: Positive
    """[Hz]"""
    control: Positive
    """[Hz]"""


class RobotSummary(Section):
    """The robot of the training."""

    section = "robot"
    name: Text = ""
    sha256: Sha256
    """Of its whole config."""
    calibration_sha256: Sha256 | None = None
    """Of its measured intervals; None: nothing was measured."""
    values: dict[Label, Value] = Field(default_factory=dict, max_length=200)
    """Its limits, physics and LiDAR by dotted name, in SI units; see `describe.ROBOT_FIELDS`."""


class TrainingSummary(Section):
    """How the policy was trained; whatever isn't known is missing."""

    section = "training"
    algorithm: Text = ""
    hyperparameters: dict[Label, Any] = Field(default_factory=dict, max_length=1_000)
    steps: Count | None = None
    """Env steps, of all robots together."""
    seed: Count | None = None
    command: Text = ""
    versions: dict[Label, Label] = Field(default_factory=dict, max_length=100)
    """Of the libraries, by name."""
    revision: Text = ""
    """Revision of the source, as git names it."""
    seconds: Annotated[float, Field(ge=0.0, le=1e9)] | None = None
    """How long it took [s]."""
    finished: Text = ""
    """When it ended, in UTC as ISO 8601 writes it."""


class Bundle(Section):
    """All that a policy file says about itself; see the module."""

    section = "bundle"
    version: Literal[1] = 1
    env: EnvSummary
    observation: ObservationLayout
    action: ActionLayout = ActionLayout()
    state: Annotated[tuple[StateLayout, ...], Field(max_length=16)] = ()
    """The states of a recurrent policy, in the order of the graph's inputs and outputs."""
    rates: PolicyRates
    robot: RobotSummary
    robots: dict[Label, Span] = Field(default_factory=dict, max_length=200)
    """Least and largest number of the robots that it was trained on, by name, see
    `describe.robot_number`; empty: it was trained on `robot` alone."""
    randomization: Ranges | None = None
    """Ranges of the training by name, see `Randomization`; None: not known."""
    training: TrainingSummary | None = None
    metrics: dict[Label, dict[Label, Number | None]] = Field(default_factory=dict, max_length=100)
    """Figures by occasion, such as {"held_out": {"success_rate": 0.97, "episodes": 64}}."""

    @model_validator(mode="after")
    def _spans_of_robots_are_in_order(self) -> Self:
        """Check that no range of robots is upside down."""
        for name, (low, high) in self.robots.items():
            if low > high:
                raise ConfigError(f"robots {show_value(name)}: {low:g} to {high:g} is no range")
        return self

    def as_json(self) -> str:
        """Return the document; PolicyError where it is larger than what is read."""
        text = json.dumps(self.model_dump(mode="json"), allow_nan=False)
        if len(text) > MAX_BUNDLE_BYTES:
            raise PolicyError(
                f"its bundle has {len(text):,} bytes: must be {MAX_BUNDLE_BYTES:,} at most"
            )
        return text


def parse_bundle(text: str) -> Bundle:
    """Parse a bundle from a file."""
    if len(text) > MAX_BUNDLE_BYTES:
        raise PolicyError(
            f"its bundle is larger than {MAX_BUNDLE_BYTES:,} bytes, the most that is read"
        )
    found = reading.parse_json(text, _BundleError)
    if not isinstance(found, dict) or _deeper(found, MAX_BUNDLE_DEPTH):
        raise _BundleError("must be a mapping, and not nested deeply")
    version = found.get("version")
    if version != BUNDLE_VERSION or isinstance(version, bool | float):
        raise PolicyError(
            f"its bundle has version {show_value(version)}, this acsar_gym reads "
            f"{BUNDLE_VERSION}: update acsar_gym, or export the policy again with this one"
        )
    try:
        return Bundle.model_validate(found)
    except ConfigError as error:
        raise _BundleError(str(error)) from error


def _deeper(value: Any, most: int) -> bool:
    """Return whether a value of JSON is nested more than `most` levels deep."""
    if not isinstance(value, list | dict):
        return False
    inner = value.values() if isinstance(value, dict) else value
    return most == 0 or any(_deeper(one, most - 1) for one in inner)


class _BundleError(PolicyError):
    """A damaged bundle, with what to do."""

    def __init__(self, problem: str) -> None:
        super().__init__(
            f"its bundle is damaged: {escape_unprintable(problem)}: export the policy again"
        )
