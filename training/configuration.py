"""Settings of the networks, the learning algorithm and the training run.

The numbers are those of concurrent teacher-student learning as published with its Mixture-of-Experts encoder;
``docs/reference/training-settings.md`` lists every deliberate difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Annotated, Any

from pydantic import Field
from pydantic_core import to_jsonable_python

from ..files.parsing import Count, NotNegative, Positive, Seed, Share

METHODS: Mapping[str, str] = {
    "cts": "cts:CTS",
    "ac_moe": "ac_moe:AcMoe",
    "mcp": "mcp:Mcp",
    "him": "him:Him",
    "dreamwaq": "dreamwaq:Dreamwaq",
}
"""Methods by name: file in ``training/algorithms`` and class, which ``algorithms.methods.find_method`` imports."""

Range = tuple[float, float]
_Rate = Annotated[float, Field(gt=0.0, le=1e3)]
Width = Annotated[int, Field(ge=1, le=65_536)]


class ConfigurationError(ValueError):
    """A setting has a value that is not allowed; the message names the setting, the value and the allowed ones."""


def _choose(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ConfigurationError(f"{name} is {value!r}; allowed are {', '.join(allowed)}.")


def _positive(owner: object, *names: str) -> None:
    for name in names:
        value = getattr(owner, name)
        if not value > 0:
            raise ConfigurationError(f"{name} is {value}; it must be greater than zero.")


def check_rising(configuration: object, *names: str, strictly: bool = False) -> None:
    """Refuse ranges that end below their beginning, or, ``strictly``, at it.

    Raises:
        ValueError: one sentence.
    """
    for name in names:
        low, high = getattr(configuration, name)
        if low > high or (strictly and low == high):
            raise ValueError(f"{name} is {low:g} to {high:g}; it must rise")


@dataclass(frozen=True, kw_only=True)
class Ramp:
    """A number that moves linearly from ``start`` to ``end`` between two fractions of the run and stays there."""

    start: float
    """Value until ``begin``."""
    end: float
    """Value from ``until`` on."""
    begin: Share = 0.0
    """Fraction of the run at which the change begins."""
    until: Share = 1.0
    """Fraction of the run at which the change is complete."""


@dataclass(frozen=True, kw_only=True)
class NetworkConfiguration:
    """Sizes of the networks. ELU everywhere, PyTorch's own initial weights."""

    latent_width: Width = 32
    """Width of the latent that the encoders produce."""
    teacher_hidden: tuple[Width, ...] = (512, 256)
    """Hidden layers of the teacher encoder; of the next state's encoder (``him``), of the decoder (``dreamwaq``)."""
    student_encoder: str = "moe"
    """``mlp`` (CTS), ``moe`` (MoE-CTS, the paper's) or ``moe_ng`` (experts that do not see the command); other methods than ``cts`` take
    ``mlp``."""
    student_hidden: tuple[Width, ...] = (512, 256)
    """Hidden layers of the student encoder, or of its experts' shared trunk."""
    expert_count: Width = 8
    """Number of experts, of the student encoder or of the actor (``ac_moe``, ``mcp``)."""
    expert_width: Width = 256
    """Private features of each expert."""
    gate_hidden: tuple[Width, ...] = (512, 256)
    """Hidden layers of the gating network."""
    actor_hidden: tuple[Width, ...] = (512, 256, 128)
    """Hidden layers of the actor, which a teacher shares, or of its experts' shared trunk."""
    critic_hidden: tuple[Width, ...] = (512, 256, 128)
    """Hidden layers of the critic, or of its experts' shared trunk (``ac_moe``)."""
    initial_std: float = 1.0
    """Initial standard deviation of the exploration noise, in network output units."""
    minimum_std: float = 1e-6
    """Smallest standard deviation of the exploration noise."""

    def __post_init__(self) -> None:
        _choose("student_encoder", self.student_encoder, ("mlp", "moe", "moe_ng"))
        _positive(self, "latent_width", "expert_count", "expert_width", "initial_std", "minimum_std")


@dataclass(frozen=True, kw_only=True)
class HimConfiguration:
    """The contrast of ``him``: swapped prediction of prototypes. Where the method's paper gives no number, that of SwAV, from which it
    takes the idea.
    """

    prototypes: Annotated[int, Field(ge=2, le=65_536)] = 32
    """Number of prototypes."""
    temperature: Positive = 0.1
    """Temperature of the predictions."""
    code_sharpness: Positive = 0.05
    """Entropy of the codes in Sinkhorn-Knopp: the smaller, the nearer to one prototype each."""
    sinkhorn_iterations: Count = 3
    """Iterations of Sinkhorn-Knopp."""


@dataclass(frozen=True, kw_only=True)
class DreamwaqConfiguration:
    """The variational estimator of ``dreamwaq``."""

    beta: NotNegative = 0.35
    """Weight of the latent's divergence, a mean over its entries as the other errors are; the method's paper gives no number."""


@dataclass(frozen=True, kw_only=True)
class AlgorithmConfiguration:
    """PPO and the encoder's supervision. Defaults without a remark are the published ones."""

    method: str = "cts"
    """``cts`` (concurrent teacher and student), ``ac_moe`` (the same with experts in actor and critic), ``mcp`` (with an actor that
    multiplies primitives), ``him`` (hybrid internal model) or ``dreamwaq`` (variational estimator); or ``module:name`` of a class of your
    own that is derived from one of theirs."""
    student_period: int = 4
    """Environment i belongs to the student if i is a multiple of this, else to the teacher, where the method has one."""
    epochs: int = 5
    """Passes over the rollout."""
    minibatches: int = 4
    """Minibatches per pass; each holds teacher and student samples in the ratio of their environments."""
    discount: Share = 0.99
    """Discount factor gamma."""
    gae_lambda: Share = 0.95
    """Lambda of generalized advantage estimation."""
    clip: Positive = 0.2
    """Clip range of the probability ratio and of the value update."""
    value_coefficient: float = 1.0
    """Weight of the value loss."""
    entropy_coefficient: Ramp | float = 0.01
    """Weight of the entropy bonus; a ramp moves with the environment's schedules."""
    learning_rate: _Rate = 1e-3
    """Initial learning rate of teacher encoder, actor and critic."""
    learning_rate_range: tuple[_Rate, _Rate] = (1e-5, 1e-2)
    """Bounds of the adaptive learning rate."""
    desired_kl: Ramp | Positive | None = 0.01
    """KL divergence that the learning rate is adapted to after every minibatch; a ramp moves with the environment's schedules, None keeps
    the rate fixed."""
    max_gradient_norm: float = 1.0
    """Gradient norm limit, of each optimizer; actor side and critic share one norm."""
    student_learning_rate: _Rate = 1e-3
    """Learning rate of the student encoder's own Adam."""
    him: HimConfiguration = HimConfiguration()
    dreamwaq: DreamwaqConfiguration = DreamwaqConfiguration()
    load_balance_coefficient: float = 0.01
    """Weight of the load balancing loss of the Mixture of Experts, a sum over the experts (the paper's equation). The published code
    takes the mean: a collapse of all samples onto one of 8 experts would then cost 0.0011 beside a latent error of the order of 0.01."""
    symmetry: str = "none"
    """Left-right symmetry: ``none``, ``augment`` (every minibatch is joined by its mirror image) or ``alternate`` (half of a minibatch is
    replaced by its mirror image, the other half in the next pass: half of the work of ``augment``)."""
    precision: str = "tf32"
    """Matrix products on a GPU: ``float32``, ``tf32`` or ``bfloat16`` (autocast; losses stay in float32)."""
    cuda_graphs: bool | None = None
    """Replay a minibatch step as CUDA graphs. None: on a GPU."""
    compile_mode: str = "auto"
    """Mode of ``torch.compile`` for the loss functions: ``none``, ``default``, or ``auto``: ``default`` on a GPU, ``none`` elsewhere.
    Compiling takes about half a minute at the start."""

    def __post_init__(self) -> None:
        if ":" not in self.method:
            _choose("method", self.method, (*METHODS, "module:name of a class of your own"))
        _choose("symmetry", self.symmetry, ("none", "augment", "alternate"))
        _choose("precision", self.precision, ("float32", "tf32", "bfloat16"))
        _choose("compile_mode", self.compile_mode, ("auto", "none", "default"))
        _positive(self, "epochs", "minibatches", "learning_rate", "student_learning_rate", "max_gradient_norm", "clip")
        if isinstance(self.desired_kl, Ramp) and not min(self.desired_kl.start, self.desired_kl.end) > 0:
            raise ConfigurationError(
                f"desired_kl goes from {self.desired_kl.start:g} to {self.desired_kl.end:g}; both must be greater than zero."
            )
        if self.student_period < 2:
            raise ConfigurationError(
                f"student_period is {self.student_period}; it must be at least 2, or no environment is left to the "
                "teacher."
            )


@dataclass(frozen=True, kw_only=True)
class RunConfiguration:
    """Length of a run, and the files and figures that it leaves behind."""

    experiment: str = "go2_moe_cts"
    """Name of the folder under ``logs/rsl_rl``."""
    run_name: str = ""
    """Appended to the date in the run directory's name."""
    seed: Seed = 0
    """Seed of every random generator; rank r of a multi-GPU run uses seed + r."""
    steps_per_iteration: Annotated[int, Field(le=1_000_000)] = 24
    """Environment steps of every environment between two updates."""
    iterations: Annotated[int, Field(le=1_000_000_000)] = 10_000
    """Updates of the whole run."""
    torch_threads: Annotated[int, Field(ge=1, le=1024)] | None = None
    """CPU threads of torch; None for its own choice. On small tensors threads cost more than they give, and ten times the whole run's
    time where other programs want the cores: each operation waits for all of them."""
    save_interval: int = 500
    """Updates between two checkpoints."""
    logger: str = "tensorboard"
    """``tensorboard``, or a service beside it: ``wandb`` or ``neptune``."""
    logger_project: str = "gaitgauge"
    """Name of the service's project."""
    video_interval: int = 0
    """Updates between two videos of the student; 0 for none. Each writes a checkpoint."""
    gauge_interval: int = 500
    """Updates between two gaugings of the student; 0 for none. Each writes a checkpoint."""
    gauge_score: str = "score"
    """Key of the gauge's result by which ``best.pt`` is chosen."""
    gauge_wait: NotNegative = 900.0
    """Longest wait for pending scores, and for pending videos, at the end of a run [s]."""
    random_episode_start: bool = True
    """Start the first episodes at random ages, so that resets spread over time."""
    keep_episodes: bool = True
    """Keep the running episodes in checkpoints, so that resuming equals never having stopped. They are half of a checkpoint with 8,192
    environments; without them a resumed run begins new episodes on the levels reached."""
    bootstrap_iterations: int = 60
    """Iterations at the start of a run from a bare policy (``--init-from``) in which only a teacher and a critic for it are learned."""
    average_age: float = 0.1
    """Mean age of the averaged weights, which are played and gauged, as a fraction of the iterations done (see ``averaging``); 0 for the
    weights of the last iteration alone, at most 0.5."""
    nonfinite_limit: Share = 0.01
    """Largest share of non-finite environment samples, and of skipped minibatches, in one iteration before the run stops."""

    def __post_init__(self) -> None:
        _positive(self, "steps_per_iteration", "iterations", "save_interval", "nonfinite_limit")
        if self.bootstrap_iterations < 1:
            raise ConfigurationError(f"bootstrap_iterations is {self.bootstrap_iterations}; it must be at least 1.")
        if not 0.0 <= self.average_age <= 0.5:
            raise ConfigurationError(f"average_age is {self.average_age:g}; it must be between 0 (no average) and 0.5.")
        _choose("logger", self.logger, ("tensorboard", "wandb", "neptune"))
        for name in ("gauge_interval", "video_interval"):
            if getattr(self, name) < 0:
                raise ConfigurationError(f"{name} is {getattr(self, name)}; it must be 0 (never) or positive.")
        if PurePath(self.experiment).name != self.experiment or self.experiment in ("", ".."):
            raise ConfigurationError(f"experiment is {self.experiment!r}; it must be a plain folder name.")
        if self.run_name and PurePath(self.run_name).name != self.run_name:
            raise ConfigurationError(f"run_name is {self.run_name!r}; it must be a part of a folder's name.")
        for name in ("experiment", "run_name"):
            if not getattr(self, name).isprintable():
                raise ConfigurationError(
                    f"{name} is {getattr(self, name)!r}; it must be printable, without line ends and control characters."
                )


@dataclass(frozen=True, kw_only=True)
class TrainingConfiguration:
    """Everything about learning that is not the environment."""

    network: NetworkConfiguration = NetworkConfiguration()
    algorithm: AlgorithmConfiguration = AlgorithmConfiguration()
    run: RunConfiguration = RunConfiguration()


def to_plain(value: Any) -> Any:
    """Return a configuration as plain data that YAML and JSON can hold and read back safely: dataclasses and mappings become
    dictionaries, tuples lists, paths texts.

    Raises:
        ValueError: a value has no plain form.
    """
    return to_jsonable_python(value)
