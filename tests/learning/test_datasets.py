"""Datasets are what Minari loads, what the environment does, and the same each time."""

import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from datasets_on_record import COUNTS, records
from paths import ROOT
from registries import register_like, registries_put_back
from trainings import quiet

from tpm_gym.errors import ConfigurationError
from tpm_gym.learning.configuration import EnvOptions
from tpm_gym.learning.datasets import KINDS, CollectConfig, Dataset, _complete, collect, digest
from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.policies import load_policy
from tpm_gym.learning.rollout import TEST_SEED, run_episodes
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM
from tpm_gym.simulation import Randomisation, Servo
from tpm_gym.tasks import Reach

REACH, PICK = "TPMReachDense-v0", "TPMPickAndPlace-v0"
FIRST, STEPS = 7, 40_960  # of replay: ten updates


def config(root: Path, *kinds: Any, env: str = REACH, **options: Any) -> CollectConfig:
    given = {"episodes": 12, "seed": FIRST, "steps": STEPS, "out": root, **options}
    return CollectConfig(env=(env,), kind=kinds, **given)


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """Datasets of each kind of Reach, and of pick-and-place's expert."""
    folder = tmp_path_factory.mktemp("datasets")
    collect(config(folder, *KINDS), quiet())
    collect(config(folder, "expert", "noisy", env=PICK), quiet())
    return folder


@pytest.fixture(autouse=True)
def _here(root, monkeypatch):
    """Minari looks for datasets there."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))


def episodes(name: str) -> Iterator[tuple[int, Any]]:
    """Yield the seeds and episodes of a dataset."""
    dataset = minari.load_dataset(name)
    known = dataset.storage.get_episode_metadata(dataset.episode_indices)
    return zip([each["seed"] for each in known], dataset, strict=True)


NAMES = (*(f"{REACH}/{kind}-v0" for kind in KINDS), f"{PICK}/expert-v0", f"{PICK}/noisy-v0")


def test_minari_lists_and_loads_every_dataset(root):
    assert set(minari.list_local_datasets(compatible_minari_version=True)) == set(NAMES)
    for name in NAMES:
        dataset = minari.load_dataset(name)
        assert (dataset.total_episodes, dataset.total_steps) == (12, 600)
        for episode in dataset:
            for row in range(51):
                seen = {key: values[row] for key, values in episode.observations.items()}
                assert dataset.observation_space.contains(seen)
            assert all(map(dataset.action_space.contains, episode.actions))


@pytest.mark.parametrize("name", NAMES)
def test_the_environment_repeats_every_episode_to_the_bit(name):
    with closing(minari.load_dataset(name).recover_environment()) as env:
        for index, (seed, episode) in enumerate(episodes(name)):
            assert seed == FIRST + index
            observation, info = env.reset(seed=seed)
            for step in range(len(episode.actions) + 1):
                for key, values in episode.observations.items():
                    assert np.array_equal(observation[key], values[step])
                assert {key: info[key] for key in episode.infos} == {
                    key: values[step] for key, values in episode.infos.items()
                }
                if step == len(episode.actions):
                    break
                observation, reward, *ends, info = env.step(episode.actions[step])
                assert reward == episode.rewards[step]
                assert ends == [episode.terminations[step], episode.truncations[step]]
            assert ends == [False, True]


def arrays(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every array of a dataset, and the seeds, by name."""
    found = {}

    def add(name: str, part: Any) -> None:
        values = part[()] if isinstance(part, h5py.Dataset) else part.attrs.get("seed", -1)
        found[name] = np.asarray(values).tobytes()

    with h5py.File(folder / "data" / "main_data.hdf5") as file:
        file.visititems(add)
    return found


def test_two_builds_are_equal_and_a_short_dataset_begins_a_long_one(root, tmp_path):
    for folder in collect(config(tmp_path, *KINDS), quiet()):
        again = root / folder.relative_to(tmp_path)
        assert arrays(folder) == arrays(again)
        assert digest(folder / "data") == digest(again / "data")
    kinds = ("expert", "noisy", "random")
    for folder in collect(config(tmp_path / "short", *kinds, episodes=5), quiet()):
        long = root / folder.relative_to(tmp_path / "short")
        assert arrays(folder).items() <= arrays(long).items()
        assert digest(folder / "data") == digest(long / "data", 5) != digest(long / "data", 6)


def test_kinds_are_what_they_say(root, tmp_path):
    silent = config(tmp_path, "noisy", env=PICK, noise=0.0)
    assert arrays(collect(silent, quiet())[0]) == arrays(root / PICK / "expert-v0")
    uniform = np.array([episode.actions for _, episode in episodes(f"{REACH}/random-v0")])
    assert np.std(uniform) == pytest.approx(3**-0.5, rel=0.05)
    returns = [episode.rewards.sum() for _, episode in episodes(f"{REACH}/replay-v0")]
    assert np.mean(returns[-4:]) > np.mean(returns[:4]) + 5


def test_scores_are_normalised_by_random_actions_and_the_expert():
    dataset = minari.load_dataset(f"{REACH}/expert-v0")
    with closing(make_envs(REACH, 100, engine="analytic")) as envs:
        for name, score in (("random", 0.0), ("expert", 1.0)):
            records = run_episodes(envs, load_policy(name, envs), 100, TEST_SEED)
            mean = np.mean([record.total_reward for record in records])
            assert minari.get_normalized_score(dataset, mean) == pytest.approx(score, abs=1e-12)


def test_options_of_the_environment_are_kept_and_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = EnvOptions(engine="analytic", machine="wide", shield=True)
    (folder,) = collect(config(Path("sets"), "random", episodes=1, env_options=options), quiet())
    assert folder == Path("sets", REACH, "random-wide-shield-v0")
    for shield, name in ((False, "random-v0"), (0.1, "random-shield0_1-v0")):
        given = replace(options, machine=None, shield=shield)
        chosen = config(Path("sets"), "random", env_options=given)
        assert Dataset(chosen, REACH, "random", Path()).name == f"{REACH}/{name}"
    with closing(minari.MinariDataset(folder / "data").recover_environment()) as env:
        assert (env.unwrapped.machine.name, env.spec.kwargs["shield"]) == ("wide", True)


@pytest.mark.parametrize("engine", ["pybullet", None])  # None: the engine of the id
def test_datasets_of_two_engines_have_two_names(engine):
    """The command's engine is analytic, and has no word."""
    given = replace(config(Path(), "random"), env_options=EnvOptions(engine=engine, machine="wide"))
    assert Dataset(given, REACH, "random", Path()).name == f"{REACH}/random-pybullet-wide-v0"


@pytest.mark.parametrize(
    ("message", "changes"),
    [
        ("unknown environment 'TPMRaech-v0'; there are .*TPMReach-v0", {"env": ("TPMRaech-v0",)}),
        ("--kind best: there are expert, noisy, random, replay", {"kind": ("best",)}),
        ("--episodes 0: must be at least 1", {"episodes": 0}),
        ("--noise -1: must be at least 0", {"noise": -1}),
        ("--noise nan: must be at least 0", {"noise": float("nan")}),
        ("--noise inf: must be finite", {"noise": float("inf")}),
        ("--env: give at least one", {"env": ()}),
        ("--kind: give at least one", {"kind": ()}),
        ("--seed 999999: must lie in 0 ... 999988", {"seed": 999_999}),
        (
            "--steps 4000: must be more than the 11,200 of the .*; give more --steps, or .* train$",
            {"env": ("TPMPickAndPlace-v0",), "kind": ("replay",), "steps": 4000},
        ),
        ("--seed 999900: must lie in 0", {"seed": 999_900, "kind": ("random", "replay")}),
    ],
)
def test_what_cannot_be_collected_is_refused(tmp_path, message, changes):
    with pytest.raises(ConfigError, match=message):
        collect(replace(config(tmp_path, "random"), **changes), quiet())
    assert list(tmp_path.iterdir()) == []


def test_options_that_one_of_the_ids_refuses_are_refused_before_a_dataset_is_written(tmp_path):
    given = config(tmp_path, "random", episodes=1)
    options = EnvOptions(engine="analytic", machine="delta")
    given = replace(given, env=(REACH, "TPMCrossing-v0"), env_options=options)
    with pytest.raises(ConfigurationError, match=r"'delta' is not .*\(in TPMCrossing-v0\)"):
        collect(given, quiet())
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_there_is_replaced_only_if_it_is_ours_and_asked_for(tmp_path):
    given = config(tmp_path, "random", episodes=1)
    (folder,) = collect(given, quiet())
    with pytest.raises(ConfigError, match="is there already; give --overwrite"):
        collect(given, quiet())
    (again,) = collect(replace(given, overwrite=True, seed=1), quiet())
    assert again == folder
    (metadata,) = folder.glob("data/metadata.json")
    metadata.write_text("{}")
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="holds no dataset of tpm-gym collect"):
        collect(replace(given, overwrite=True), quiet())
    assert (folder / "notes.txt").read_text() == "mine"


RECORDED = json.loads((ROOT / "tests" / "data" / "datasets.json").read_text(encoding="utf-8"))


def test_every_id_that_is_collected_without_being_named_is_on_record():
    assert set(RECORDED) == set(_complete(CollectConfig()))


@pytest.mark.parametrize(
    "env_id", [pytest.param(i, marks=[] if i == PICK else [pytest.mark.slow]) for i in RECORDED]
)
def test_datasets_are_those_on_record(env_id):
    """To the bit, or near where a processor rounds otherwise."""
    for kind, found in records(env_id, min(COUNTS)).items():
        first = str(min(COUNTS))
        recorded = RECORDED[env_id][kind][first]
        if found[first]["sha256"] != recorded["sha256"]:
            assert found[first]["return"] == pytest.approx(recorded["return"], abs=1e-4)


def test_an_id_that_names_no_task_is_collected_with_the_default_one(tmp_path):
    with registries_put_back():
        register_like(REACH, "Plain-v0", steps=5, kwargs={})
        (folder,) = collect(config(tmp_path, "expert", env="Plain-v0", episodes=2), quiet())
    assert minari.MinariDataset(folder / "data").total_steps == 10


OWN = replace(PAPER_TPM, name="own", table=(0.4, 0.3))


class Unregistered(Reach):
    """A task that no name stands for."""


@pytest.mark.parametrize(
    ("options", "refused"),
    [
        ({"machine": OWN}, "cannot store its machine, 'own', .*tpm_gym.register_machine"),
        ({"task": Unregistered}, "cannot store its task, .*Unregistered.*tpm_gym.register_task"),
        ({"machine": WIDE_TPM, "task": Reach}, None),  # registered under names
        ({"drive": Servo(stiffness=5000.0), "randomisation": Randomisation(latency=1)}, None),
    ],
)
def test_the_environment_of_an_own_id_is_recovered_or_refused_early(tmp_path, options, refused):
    with registries_put_back():
        register_like(REACH, "Own-v0", steps=5, kwargs={**gym.spec(REACH).kwargs, **options})
        given = config(tmp_path, "random", env="Own-v0", episodes=1)
        if refused:
            with pytest.raises(ConfigError, match=refused):
                collect(given, quiet())
            assert list(tmp_path.iterdir()) == []
            return
        (folder,) = collect(given, quiet())
        with (
            closing(minari.MinariDataset(folder / "data").recover_environment()) as env,
            closing(gym.make("Own-v0", engine="analytic")) as own,
        ):
            env.reset(seed=0)
            own.reset(seed=0)
            own.unwrapped.restore_state(env.unwrapped.save_state())  # of an equal environment
