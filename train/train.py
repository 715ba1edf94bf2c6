"""Train a policy with Stable-Baselines3 and leave everything about the run in one folder.

    python train/train.py --env TPMReach-v0 --algo sac --seed 0

The run folder holds ``config.json`` (the full configuration, versions and seeds), ``progress.csv``
and TensorBoard events, ``evaluations.jsonl`` and ``learning_curve.png``, ``checkpoints/``,
``best.zip`` (the policy with the best periodic evaluation) and ``last.zip``.
"""

from __future__ import annotations

import shutil
import signal
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import tyro
from rich.console import Console

import provenance
from errors import ConfigError, NotARunError, RunExistsError, TrainError, UnknownEnvError
from policies import CONFIG_FILE, LAST_FILE
from recipes import RECIPES, Recipe, read_recipe
from rollout import SELECTION_SEED, TEST_SEED, GoalEnv


@dataclass(frozen=True)
class Config:
    """Train a policy on a tpm_gym environment."""

    algo: Literal["sac", "tqc", "ppo"] = "sac"
    """Algorithm. SAC and TQC use hindsight replay on sparse rewards; PPO wants a Dense id."""

    env: str = "TPMReach-v0"
    """Environment id."""

    seed: int = 0
    """Seed of the networks, the exploration and the first training environment."""

    steps: int | None = None
    """Environment steps, over all environments. Default: as the recipe says."""

    envs: int | None = None
    """Parallel environments, in processes of their own if several. Default: as the recipe says."""

    recipe: Path | None = None
    """YAML file of hyperparameters by environment id. Default: train/recipes/<algo>.yml."""

    run: Path | None = None
    """Folder of the run. Default: runs/<env>-<algo>-s<seed>."""

    eval_every: int | None = None
    """Steps between evaluations on held-out seeds. Default: a tenth of the steps."""

    eval_episodes: int = 20
    """Episodes per evaluation."""

    checkpoint_every: int | None = None
    """Steps between checkpoints. Default: a fifth of the steps."""

    threads: int = 1
    """Threads of PyTorch. With one thread and one environment a seed repeats exactly."""

    device: str = "cpu"
    """Device of PyTorch. The networks are small; a GPU pays only with large batches."""

    overwrite: bool = False
    """Replace an earlier run in the same folder."""


@dataclass(frozen=True)
class Plan:
    """A configuration with every default filled in and checked.

    Attributes:
        algo: Algorithm.
        env: Environment id.
        seed: Seed; environment i of the training starts from ``seed + i``.
        steps: Environment steps.
        envs: Parallel environments.
        recipe_file: Where the recipe was read.
        recipe: The hyperparameters.
        run: The run folder.
        eval_every: Steps between evaluations.
        eval_episodes: Episodes per evaluation.
        checkpoint_every: Steps between checkpoints.
        threads: Threads of PyTorch.
        device: Device of PyTorch.
    """

    algo: str
    env: str
    seed: int
    steps: int
    envs: int
    recipe_file: Path
    recipe: Recipe
    run: Path
    eval_every: int
    eval_episodes: int
    checkpoint_every: int
    threads: int
    device: str

    @property
    def title(self) -> str:
        """One line that names the run."""
        method = self.algo.upper() + (" + HER" if self.recipe.hindsight else "")
        return f"{self.env}   {method}, seed {self.seed}"


def make_plan(config: Config) -> Plan:
    """Fill in the defaults of a configuration and check it.

    Raises:
        UnknownEnvError: tpm_gym does not register the environment.
        ConfigError: An option, or a combination of options, is not valid.
        RecipeError: The recipe is not valid.
    """
    import tpm_gym

    if config.env not in tpm_gym.ENV_IDS:
        raise UnknownEnvError(config.env, tpm_gym.ENV_IDS)
    recipe_file = config.recipe or RECIPES / f"{config.algo}.yml"
    recipe = read_recipe(recipe_file, config.algo, config.env)
    steps = recipe.n_timesteps if config.steps is None else config.steps
    plan = Plan(
        algo=config.algo,
        env=config.env,
        seed=config.seed,
        steps=steps,
        envs=recipe.n_envs if config.envs is None else config.envs,
        recipe_file=recipe_file,
        recipe=recipe,
        run=config.run or Path("runs", f"{config.env}-{config.algo}-s{config.seed}"),
        eval_every=max(1, steps // 10) if config.eval_every is None else config.eval_every,
        eval_episodes=config.eval_episodes,
        checkpoint_every=(
            max(1, steps // 5) if config.checkpoint_every is None else config.checkpoint_every
        ),
        threads=config.threads,
        device=config.device,
    )
    _check(plan)
    return plan


def _check(plan: Plan) -> None:
    """Refuse numbers that cannot work."""
    names = ("steps", "envs", "eval_every", "eval_episodes", "checkpoint_every", "threads")
    for name in names:
        if getattr(plan, name) < 1:
            option = "--" + name.replace("_", "-")
            raise ConfigError(option, getattr(plan, name), "must be at least 1")
    highest = SELECTION_SEED - plan.envs
    if not 0 <= plan.seed <= highest:
        raise ConfigError(
            "--seed",
            plan.seed,
            f"must lie in 0 ... {highest}: seeds from {SELECTION_SEED} up are held out",
        )
    most = TEST_SEED - SELECTION_SEED
    if plan.eval_episodes > most:
        raise ConfigError("--eval-episodes", plan.eval_episodes, f"must be at most {most}")
    _check_hindsight(plan)
    _check_device(plan.device)


def _check_device(device: str) -> None:
    """Refuse a device that PyTorch does not have here, before anything is deleted for the run."""
    import torch

    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise ConfigError("--device", device, "is no device of PyTorch; try cpu") from error
    if kind == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device", device, "PyTorch finds no GPU here; use cpu")


def _check_hindsight(plan: Plan) -> None:
    """Refuse to learn before the first episode has ended: hindsight would have nothing to draw."""
    horizon = gym.spec(plan.env).max_episode_steps or 0
    needed = horizon * plan.envs
    starts = int(plan.recipe.arguments.get("learning_starts", 100))
    if plan.recipe.hindsight and starts < needed:
        raise ConfigError(
            "--recipe",
            plan.recipe_file,
            f"learning_starts: {starts} is before the first episode ends (step {needed} with "
            f"{plan.envs} environments); raise it, or use fewer --envs",
        )


def train(config: Config, console: Console | None = None) -> bool:
    """Train as configured and leave the run folder.

    Args:
        config: The configuration.
        console: Where progress is shown; by default the standard output.

    Returns:
        Whether training went to its end; False after Ctrl-C or SIGTERM, with everything saved.

    Raises:
        TrainError: The configuration is not valid, or the run folder is taken.
    """
    console = console or Console()
    plan = make_plan(config)
    _prepare_folder(plan.run, config.overwrite)
    provenance.write_json(plan.run / CONFIG_FILE, _description(plan))
    console.print(f"{plan.title}, {plan.steps:,} steps, in {plan.run}", markup=False)
    starts = int(plan.recipe.arguments.get("learning_starts", 0))
    if plan.steps <= starts:
        console.print(f"note: learning starts at step {starts:,}, so nothing will be learned")
    finished = _learn(plan, console)
    outcome = "finished" if finished else "stopped early, saved"
    console.print(f"{outcome}: {plan.run}", markup=False)
    return finished


def _prepare_folder(run: Path, overwrite: bool) -> None:
    """Make the run folder, empty."""
    if run.exists() and (not run.is_dir() or any(run.iterdir())):
        if not overwrite:
            raise RunExistsError(run)
        # Deleting is for folders that this script has written, whatever --run was set to.
        if not (run / CONFIG_FILE).is_file():
            raise NotARunError(run, CONFIG_FILE)
        shutil.rmtree(run)
    run.mkdir(parents=True, exist_ok=True)


def _description(plan: Plan) -> dict[str, Any]:
    """Return what config.json records."""
    return {
        # Folders outside the run say nothing about it; names do.
        **asdict(replace(plan, run=Path(plan.run.name), recipe_file=Path(plan.recipe_file.name))),
        "run": plan.run.name,
        "recipe_file": plan.recipe_file.name,
        "training_seeds": [plan.seed, plan.seed + plan.envs - 1],
        "evaluation_seeds": [SELECTION_SEED, SELECTION_SEED + plan.eval_episodes - 1],
        "versions": provenance.versions(),
        "git_commit": provenance.git_commit(),
        "machine": provenance.machine(),
        "command": provenance.command_line(),
    }


def _learn(plan: Plan, console: Console) -> bool:
    """Build everything, learn, and save; return whether training went to its end."""
    import torch
    from stable_baselines3.common.callbacks import CheckpointCallback
    from stable_baselines3.common.logger import configure

    from callbacks import PeriodicEvaluation, ProgressBar, StopOnSignal, save_model

    torch.set_num_threads(plan.threads)
    training_envs = _make_training_envs(plan)
    evaluation_env = make_env(plan.env)
    bar, stop = ProgressBar(console), StopOnSignal()
    try:
        model = _make_model(plan, training_envs)
        model.set_logger(configure(str(plan.run), ["csv", "tensorboard"]))
        evaluation = PeriodicEvaluation(
            evaluation_env, plan.eval_every, plan.eval_episodes, plan.run, plan.title, console
        )
        # Counted in calls, each of which steps all environments once.
        calls = max(1, plan.checkpoint_every // plan.envs)
        checkpoints = CheckpointCallback(calls, str(plan.run / "checkpoints"), plan.algo)
        with stop.listening():
            model.learn(plan.steps, callback=[bar, evaluation, checkpoints, stop])
            save_model(model, plan.run / LAST_FILE)
        model.logger.close()
    finally:
        bar.close()
        evaluation_env.close()
        training_envs.close()
    return not stop.stopped


def _make_model(plan: Plan, envs: Any) -> Any:
    """Build the algorithm of a plan."""
    from policies import algorithm_class

    arguments = dict(plan.recipe.arguments)
    policy_kwargs = dict(arguments.get("policy_kwargs", {}))
    if "features_extractor_class" in policy_kwargs:
        from features import GoalGapExtractor

        arguments["policy_kwargs"] = policy_kwargs | {"features_extractor_class": GoalGapExtractor}
    if plan.recipe.hindsight:
        from her import PenaltyHerReplayBuffer

        arguments["replay_buffer_class"] = PenaltyHerReplayBuffer
    algorithm: Any = algorithm_class(plan.algo)
    return algorithm(plan.recipe.policy, envs, seed=plan.seed, device=plan.device, **arguments)


def _make_training_envs(plan: Plan) -> Any:
    """Build the training environments, in processes of their own where there are several."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    several = plan.envs > 1
    return make_vec_env(
        make_env,
        n_envs=plan.envs,
        seed=plan.seed,
        env_kwargs={"env_id": plan.env, "in_worker": several},
        vec_env_cls=SubprocVecEnv if several else DummyVecEnv,
    )


def make_env(env_id: str, in_worker: bool = False) -> GoalEnv:
    """Make an environment of tpm_gym.

    Args:
        env_id: The registered id.
        in_worker: Whether this runs in a process of its own, which has to outlive the Ctrl-C that
            a terminal sends to all processes, until the main process has saved.
    """
    import tpm_gym  # noqa: F401  # registers the ids

    if in_worker:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return gym.make(env_id)


def main() -> None:
    """Run the command line."""
    from tpm_gym import TPMError

    config = tyro.cli(Config, description=__doc__)
    try:
        finished = train(config)
    except (TrainError, TPMError) as error:
        sys.exit(f"error: {error}")
    if not finished:
        sys.exit(128 + signal.SIGINT)


if __name__ == "__main__":
    main()
