"""`TrainConfig`: all settings of a training run, with hyperparameters; saved in the run's folder."""

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any

from registry import UsageError
from registry.errors import did_you_mean

ALGORITHMS = ("ppo", "sac")
OBS_MODES = ("state", "rgb")
LARGEST_SEED = 10**9  # larger seeds are reserved for evaluation
_DEFAULT_STEPS = {"ppo": 50_000, "sac": 30_000}


def _setting(default: Any, doc: str, least: float = 0.0, most: float = float("inf")) -> Any:
    return field(default=default, metadata={"doc": doc, "least": least, "most": most})


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Hyperparameters of both algorithms."""

    learning_rate: float = _setting(1e-3, "step size of Adam", 1e-9, 1.0)
    gamma: float = _setting(
        0.9, "discount factor per step (1/20 s); 0.9 looks half a second ahead", 0, 0.9999
    )
    batch_size: int = _setting(100, "transitions per gradient step", 2, 10**6)
    net_arch: tuple[int, ...] = _setting((64, 64), "widths of the hidden layers, with commas", 1, 10**5)
    horizon: int = _setting(0, "steps per episode; 0: the default of the task", 0, 10**6)
    success_bonus: bool = _setting(
        True, "add the discounted reward of staying successful for ever, since success ends an episode"
    )
    normalize_observations: bool = _setting(True, "scale observations to mean 0 and standard deviation 1")
    normalize_rewards: bool = _setting(True, "divide rewards by the deviation of the discounted return")
    image_px: int = _setting(64, "width and height of the images of --obs-mode rgb", 36, 1024)


@dataclass(frozen=True, kw_only=True)
class PpoSettings(Settings):
    """Hyperparameters of PPO."""

    rollout_steps: int = _setting(1000, "steps per update, summed over environments", 2, 10**7)
    n_epochs: int = _setting(10, "epochs per update", 1, 1000)
    gae_lambda: float = _setting(0.9, "lambda of generalized advantage estimation", 0, 1)
    clip_range: float = _setting(0.2, "clipping range of the probability ratio", 1e-6, 10)
    ent_coef: float = _setting(0.0, "weight of the entropy bonus", 0, 10)
    vf_coef: float = _setting(0.5, "weight of the value loss", 0, 100)
    max_grad_norm: float = _setting(0.5, "gradient norm above which it is clipped", 1e-6, 10**6)
    target_kl: float = _setting(0.05, "KL divergence at which an update stops; 0: never", 0, 100)
    log_std_init: float = _setting(-1.0, "logarithm of the initial standard deviation of actions", -20, 5)


@dataclass(frozen=True, kw_only=True)
class SacSettings(Settings):
    """Hyperparameters of SAC."""

    learning_rate: float = _setting(7e-4, "step size of Adam", 1e-9, 1.0)
    batch_size: int = _setting(256, "transitions per gradient step", 2, 10**6)
    net_arch: tuple[int, ...] = _setting((128, 128), "widths of the hidden layers, with commas", 1, 10**5)
    normalize_rewards: bool = _setting(False, "divide rewards by the deviation of the discounted return")
    buffer_size: int = _setting(100_000, "transitions in the replay buffer", 100, 10**8)
    learning_starts: int = _setting(1000, "random steps before the first update", 1, 10**8)
    gradient_steps: int = _setting(1, "gradient steps per step of all environments", 1, 1000)
    tau: float = _setting(0.01, "update rate of the target networks", 1e-6, 1)


SETTINGS: dict[str, type[Settings]] = {"ppo": PpoSettings, "sac": SacSettings}


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Scene, task, robot, algorithm and settings of a run.

    Raises:
        UsageError: a value is out of range; says which, and the range.
    """

    scene: str
    task: str = "reach"
    algo: str = "ppo"
    robot: str = "panda"
    obs_mode: str = "state"
    control_mode: str = "auto"  # hand displacements where the robot has that mode, else joint displacements
    steps: int = 0  # 0: the algorithm's default
    envs: int = 1
    seed: int = 0
    eval_episodes: int = 100
    randomize: str | dict[str, float] | None = "start"
    registry: str | None = None
    device: str = "cpu"
    settings: Settings = None  # pyright: ignore[reportAssignmentType] - the algorithm's defaults

    def __post_init__(self) -> None:
        """Fill in defaults and check ranges."""
        _one_of("--algo", self.algo, ALGORITHMS)
        _one_of("--obs-mode", self.obs_mode, OBS_MODES)
        if self.settings is None:
            object.__setattr__(self, "settings", SETTINGS[self.algo]())
        if type(self.settings) is not SETTINGS[self.algo]:
            raise UsageError(f"settings: expected {SETTINGS[self.algo].__name__} for {self.algo}")
        if self.steps == 0:
            object.__setattr__(self, "steps", _DEFAULT_STEPS[self.algo])
        for name, value, least, most in (
            ("steps", self.steps, 1, 10**12),
            ("envs", self.envs, 1, 512),
            ("seed", self.seed, 0, LARGEST_SEED),
            ("eval-episodes", self.eval_episodes, 0, 10**6),
        ):
            if not least <= value <= most:
                raise UsageError(f"--{name} {value}: expected a whole number between {least} and {most}")
        if self.steps < self.block:
            raise UsageError(
                f"--steps {self.steps}: less than the {self.block} steps between two updates; increase it"
                + (", or --set rollout_steps=..." if self.algo == "ppo" else "")
            )

    @property
    def block(self) -> int:
        """Return the steps between two updates, summed over environments; runs end at whole blocks."""
        if isinstance(self.settings, PpoSettings):
            return max(self.settings.rollout_steps // self.envs, 2) * self.envs
        return self.envs

    @property
    def total_steps(self) -> int:
        """Return the steps of the run: the whole blocks within `steps`."""
        return self.steps // self.block * self.block

    def to_json(self) -> dict[str, Any]:
        """Return a dict of JSON types."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, entry: dict[str, Any]) -> "TrainConfig":
        """Return the configuration that `to_json` wrote.

        Raises:
            UsageError: the entry is not one.
        """
        try:
            entry = dict(entry)
            settings = dict(entry.pop("settings"))
            settings["net_arch"] = tuple(settings["net_arch"])
            return cls(**entry, settings=SETTINGS[entry["algo"]](**settings))
        except (TypeError, KeyError, AttributeError) as error:
            raise UsageError(f"not the configuration of a training run ({error!r})") from error


def parse_settings(algo: str, texts: list[str]) -> Settings:
    """Return an algorithm's hyperparameters from texts `name=value`, and defaults for the others.

    Raises:
        UsageError: unknown algorithm or name (with the closest match), or a value out of range.
    """
    _one_of("--algo", algo, ALGORITHMS)
    kind = SETTINGS[algo]
    known = {item.name: item for item in dataclasses.fields(kind)}
    given = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"--set {text}: expected name=value, for example learning_rate=3e-4")
        if name not in known:
            meant = did_you_mean(name, known)
            raise UsageError(f"--set {text}: {algo} has no {name!r}.{meant} There are: {', '.join(known)}")
        given[name] = _parse(text, value, known[name])
    return kind(**given)


def describe_settings(algo: str) -> str:
    """Return the hyperparameters of an algorithm with defaults and meanings, one per line."""
    rows = [(f"{f.name}={_shown(f.default)}", f.metadata["doc"]) for f in dataclasses.fields(SETTINGS[algo])]
    width = max(len(left) for left, _ in rows)
    return "\n".join(f"  {left:<{width}}  {doc}" for left, doc in rows)


def parse_randomize(text: str) -> str | dict[str, float] | None:
    """Parse --randomize: none, start, all, or a JSON object of `Randomization`'s fields.

    Raises:
        UsageError: the text is none of these.
    """
    from simrecon_envs.randomization import Randomization

    value: Any = text
    if text.lstrip().startswith("{"):
        try:
            value = json.loads(text)
        except json.JSONDecodeError as error:
            raise UsageError(f"--randomize {text}: not JSON ({error})") from error
    Randomization.parse(value)
    return None if value == "none" else value


def _parse(text: str, value: str, item: dataclasses.Field) -> Any:
    kind = type(item.default)
    if kind is bool:
        if value.lower() not in ("true", "false"):
            raise UsageError(f"--set {text}: expected true or false")
        return value.lower() == "true"
    expected = {int: "a whole number", float: "a number", tuple: "whole numbers with commas"}[kind]
    least, most = item.metadata["least"], item.metadata["most"]
    try:
        parts = [int(part) for part in value.split(",")] if kind is tuple else [kind(value)]
    except ValueError:
        parts = []
    if not parts or not all(least <= part <= most for part in parts):
        raise UsageError(f"--set {text}: expected {expected} between {least:g} and {most:g}")
    return tuple(parts) if kind is tuple else parts[0]


def _one_of(option: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise UsageError(f"{option} {value}: expected one of {', '.join(known)}")


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(str(part) for part in value)
    return str(value).lower() if isinstance(value, bool) else f"{value:g}"
