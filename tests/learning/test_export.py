"""An exported policy acts as the model does, and what cannot be exported is refused."""

import json
import pickle
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from processes import TPM_GYM, error_of
from sb3_contrib import TQC
from stable_baselines3 import A2C, DDPG, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import tpm_gym
from tpm_gym import learning
from tpm_gym.learning import GoalGapExtractor, export, save_policy
from tpm_gym.learning.command_line import main
from tpm_gym.learning.configuration import EnvOptions
from tpm_gym.learning.errors import ConfigError, PolicyError
from tpm_gym.policy.files import read_description

RECIPE = {"n_timesteps": 5000, "arguments": {"gamma": 0.95, "policy_kwargs": {"net_arch": [8]}}}
GOAL_GAP = {
    "features_extractor_class": GoalGapExtractor,
    "features_extractor_kwargs": {"unit": 0.07},
}


class Blank(gym.Env[dict[str, Any], Any]):
    """Has the spaces of a task and nothing behind them, so that no engine is needed here."""

    def __init__(self, action_space: spaces.Box | None = None, **boxes: spaces.Space[Any]) -> None:
        goal = spaces.Box(-2.0, 2.0, (3,), np.float32)
        found = {
            "observation": spaces.Box(-10.0, 10.0, (9,), np.float32),
            "achieved_goal": goal,
            "desired_goal": goal,
        }
        self.observation_space = spaces.Dict({**found, **boxes})
        self.action_space = action_space or spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._steps = 0

    def reset(self, **kwargs: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        self._steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self._steps += 1
        return self.observation_space.sample(), 0.0, False, self._steps == 5, {}


def make(kind: type[BaseAlgorithm], env: gym.Env[Any, Any], **policy_kwargs: Any) -> Any:
    """Make a model whose weights, biases included, are far from zero."""
    options: dict[str, Any] = {} if kind is PPO else {"buffer_size": 10}
    made = kind(
        "MultiInputPolicy", env, seed=0, device="cpu", policy_kwargs=policy_kwargs, **options
    )
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in made.policy.parameters():
            parameter += 0.2 * torch.randn(parameter.shape, generator=generator)
    return made


def save(made: BaseAlgorithm, path: Path) -> Path:
    return export.save(made, path, env_id="TPMPickAndPlace-v0", seed=5, recipe=RECIPE)


def observations(env: gym.Env[Any, Any], n: int) -> dict[str, Any]:
    """Return goals that lie near each other, and observations over their whole range."""
    rng = np.random.default_rng(3)
    boxes = env.observation_space
    found = {
        key: rng.uniform(0.3 * box.low, 0.3 * box.high, (n, *box.shape)).astype(np.float32)
        for key, box in boxes.items()
    }
    found["desired_goal"] = found["achieved_goal"] + rng.normal(0, 0.05, (n, 3)).astype(np.float32)
    return found


EVEN = spaces.Box(-1.0, 1.0, (4,), np.float32)
UNEVEN = spaces.Box(np.array([-0.2, 0.0], "f"), np.array([0.1, 5.0], "f"))


@pytest.mark.parametrize("kind", [SAC, TQC, PPO])
@pytest.mark.parametrize(
    ("policy_kwargs", "boxes", "action_space"),
    [
        ({"net_arch": [64, 64], **GOAL_GAP}, {}, EVEN),
        ({"net_arch": [32, 16]}, {}, EVEN),
        ({"net_arch": [16], "activation_fn": torch.nn.Tanh}, {}, UNEVEN),
        ({"net_arch": [], **GOAL_GAP}, {}, UNEVEN),
        (
            {"net_arch": [8, 8, 8, 8], "activation_fn": torch.nn.ReLU},
            {"an_image": spaces.Box(0.0, 1.0, (2, 3), np.float32)},
            EVEN,
        ),
        ({"net_arch": {"pi": [7], "qf": [5], "vf": [6]}}, {}, EVEN),
    ],
    ids=["gap", "joined", "tanh", "linear", "table", "uneven"],
)
def test_actions_are_those_of_the_model(tmp_path, kind, policy_kwargs, boxes, action_space):
    env = Blank(action_space, **boxes)
    made = make(kind, env, **policy_kwargs)
    loaded = tpm_gym.load_policy(save(made, tmp_path / "p"))
    loaded.check(env)
    batch = observations(env, 1000)
    expected, _ = made.predict(batch, deterministic=True)
    actions, _ = loaded.predict(batch, deterministic=True)
    assert (actions.shape, actions.dtype) == (expected.shape, expected.dtype)
    np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-5)
    assert expected.std(axis=0).min() > 0.01  # the comparison is not one of constants
    for i in range(50):
        one = {key: values[i] for key, values in batch.items()}
        wanted, _ = made.predict(one, deterministic=True)
        action = loaded.act(one)
        assert action.shape == wanted.shape
        np.testing.assert_allclose(action, wanted, rtol=0, atol=1e-5)


@pytest.fixture
def model():
    return make(SAC, Blank(), net_arch=[8], **GOAL_GAP)


def test_the_description_is_that_of_the_model(tmp_path, model):
    model.num_timesteps = 1234
    path = save(model, tmp_path / "new" / "v1.5")
    assert path == tmp_path / "new" / "v1.5.json"
    assert sorted(file.name for file in path.parent.iterdir()) == ["v1.5.json", "v1.5.safetensors"]
    about = read_description(path)
    assert (about.env_id, about.algorithm) == ("TPMPickAndPlace-v0", "sac")
    assert (about.seed, about.steps, about.recipe) == (5, 1234, RECIPE)
    # PyPI's package leaves out the local part, such as +cu130, that the module tells.
    assert str(about.versions["torch"]).split("+")[0] == torch.__version__.split("+")[0]
    assert about.observation_space == model.observation_space
    assert about.action_space == model.action_space
    features = about.network.features
    assert (features.kind, features.unit) == ("goal_gap", 0.07)
    # Nothing but the actor is in it.
    assert about.shapes == {
        "layers.0.weight": (8, 12),
        "layers.0.bias": (8,),
        "layers.1.weight": (4, 8),
        "layers.1.bias": (4,),
    }
    text = path.read_text()
    assert str(tmp_path) not in text
    assert str(Path.home()) not in text


def test_exporting_leaves_the_model_as_it_was(tmp_path, model):
    model.policy.set_training_mode(True)
    weights = {name: value.clone() for name, value in model.policy.state_dict().items()}
    random = torch.get_rng_state()
    save(model, tmp_path / "p")
    assert model.policy.training
    assert torch.equal(torch.get_rng_state(), random)
    for name, value in model.policy.state_dict().items():
        assert torch.equal(value, weights[name])


class Halved(CombinedExtractor):
    """Looks like the extractor it derives from, and is another."""

    def forward(self, observations: Any) -> torch.Tensor:
        return 0.5 * super().forward(observations)


def endless() -> Blank:
    return Blank(observation=spaces.Box(-np.inf, np.inf, (9,), np.float32))


def counted() -> Blank:
    return Blank(observation=spaces.Box(0, 9, (9,), np.int64))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: make(SAC, Blank(), features_extractor_class=Halved), "features of Halved"),
        (lambda: make(SAC, Blank(), activation_fn=torch.nn.ELU), "ReLU or Tanh"),
        (lambda: make(PPO, Blank(), activation_fn=torch.nn.Sigmoid), "ReLU or Tanh"),
        (lambda: SAC("MultiInputPolicy", Blank(), use_sde=True, buffer_size=10), "use_sde"),
        (lambda: PPO("MultiInputPolicy", Blank(), use_sde=True), "use_sde"),
        (lambda: make(DDPG, Blank()), "DDPG is none of sac, tqc, ppo"),
        (lambda: make(SAC, endless()), "inf.* bounded"),
        (lambda: make(SAC, counted()), "bounded Box of floats"),
        (lambda: PPO("MultiInputPolicy", VecNormalize(DummyVecEnv([Blank]))), "VecNormalize"),
    ],
)
def test_what_the_files_cannot_hold_is_refused(tmp_path, build, message):
    with pytest.raises(PolicyError, match=message):
        save(build(), tmp_path / "p")
    assert list(tmp_path.iterdir()) == []


def test_a_diverged_policy_is_refused(tmp_path, model):
    with torch.no_grad():
        model.policy.actor.mu.bias[0] = float("nan")
    with pytest.raises(PolicyError, match="training diverged"):
        save(model, tmp_path / "p")


def test_rounding_in_a_network_with_large_weights_is_no_error(tmp_path):
    made = make(SAC, Blank(), net_arch=[64, 64], **GOAL_GAP)
    with torch.no_grad():  # sums of large terms that cancel are rounded by 1.8e-5
        made.policy.actor.latent_pi[-2].bias += 30
        made.policy.actor.mu.bias -= 30 * made.policy.actor.mu.weight.sum(dim=1)
    save(made, tmp_path / "p")


def test_actions_that_differ_are_noticed_and_earlier_files_kept(tmp_path, model, monkeypatch):
    path = save(model, tmp_path / "p")
    before = path.read_bytes()
    network = export._network

    def slightly_wrong(*arguments):
        description, weights = network(*arguments)
        weights["layers.1.bias"][2] += 1e-3
        return description, weights

    monkeypatch.setattr(export, "_network", slightly_wrong)
    with pytest.raises(PolicyError, match="actions would be off by"):
        save(model, path)
    assert path.read_bytes() == before
    tpm_gym.load_policy(path)
    assert len(list(tmp_path.iterdir())) == 2


# -- files of a training -------------------------------------------------------------------------


@pytest.fixture
def run(tmp_path, model):
    """A folder as a training leaves it, as far as matters here."""
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("best.zip", "last.zip"):
        model.save(folder / name)
    config = {
        "algo": "sac",
        "env": "TPMPickAndPlace-v0",
        "seed": 5,
        "recipe": RECIPE,
        "env_options": {"machine": "wide"},
        "training_seeds": [5, 5],
        "versions": {"torch": "2.0.0", "tpm_gym": None},
    }
    (folder / "config.json").write_text(json.dumps(config))
    return folder


def test_what_is_converted_says_what_the_run_says(run, model, capsys):
    main(["export", str(run / "last.zip"), str(run / "last.json"), "--trust-pickle"])
    started, written = capsys.readouterr().out.splitlines()
    assert started == f"exporting {run / 'last.zip'} and comparing its actions ..."
    assert written == str(run / "last.json")
    batch = observations(Blank(), 10)
    loaded = tpm_gym.load_policy(run / "last")
    expected, _ = model.predict(batch, deterministic=True)
    np.testing.assert_allclose(loaded.act(batch), expected, atol=1e-5)
    about = loaded.description
    assert (about.seed, about.recipe, about.env_options) == (5, RECIPE, {"machine": "wide"})
    assert about.versions == {"torch": "2.0.0", "tpm_gym": None}


def test_the_command_says_what_it_does_before_pytorch_is_loaded(run, capsys, monkeypatch):
    monkeypatch.delattr(learning, "export")
    monkeypatch.setitem(sys.modules, "tpm_gym.learning.export", None)
    with pytest.raises(ImportError):
        main(["export", str(run), str(run / "out")])
    assert capsys.readouterr().out.startswith(f"exporting {run} ")


def test_the_command_line_does_not_touch_what_is_not_trusted(run):
    """In a process of its own, with a file that would leave a trace if it were unpickled."""
    trace = run / "trace"
    (run / "best.zip").write_bytes(pickle.dumps(Trace(str(trace))))
    error = error_of(*TPM_GYM, "export", run / "best.zip", run / "out")
    assert error.startswith("error: ")
    assert "--trust-pickle" in error
    assert not trace.exists()
    assert not (run / "out.json").exists()


class Trace:
    """Writes a file when it is unpickled."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return open, (self.path, "w")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.zip", "out"], "no such file"),
        (["empty", "out"], "empty: holds no best.json or last.json; give the .zip of a model"),
        (["best.zip", "out", "--env", "TPMReach-v0"], "--env TPMReach-v0: .* leave it out"),
        (["best.zip", "out", "--machine", "wide"], "--machine wide: .* leave it out"),
        (["best.zip", "out.zip"], "not for a .zip"),
        (["broken.zip", "out"], "cannot be loaded as sac"),
        (["elsewhere/best.zip", "out"], "no config.json of a training.* give .* --env ID"),
        (["elsewhere/best.zip", "out", "--env", "TPMReech-v0"], "unknown environment"),
        (
            ["elsewhere/broken.zip", "out", "--env", "TPMReach-v0"],
            "is no archive of Stable-B.* zip",
        ),
        (["best.zip", "/proc/out"], "OUT /proc/out: cannot be written"),
    ],
)
def test_mistakes_on_the_command_line_are_one_line(run, words, message):
    (run / "broken.zip").write_bytes(b"PK")
    (run / "empty").mkdir()
    away = run.parent / "a" / "b" / "elsewhere"
    away.mkdir(parents=True)
    for name in ("best.zip", "broken.zip"):
        (away / name).write_bytes((run / name).read_bytes())
    model = away / Path(words[0]).name if "elsewhere" in words[0] else run / words[0]
    with pytest.raises(SystemExit, match=message) as caught:
        main(["export", str(model), str(run / words[1]), "--trust-pickle", *words[2:]])
    assert "\n" not in str(caught.value)


def test_options_that_the_id_of_a_run_set_are_written_where_it_is_not_registered(run):
    config = json.loads((run / "config.json").read_text())
    config |= {"env": "Unknown-v0", "id_options": {"machine": "delta", "drive": "servo"}}
    (run / "config.json").write_text(json.dumps(config))
    main(["export", str(run / "best.zip"), str(run / "out"), "--trust-pickle"])
    about = tpm_gym.load_policy(run / "out").description
    assert about.env_options == {"machine": "wide", "drive": "servo"}


@pytest.mark.parametrize(
    ("entry", "value"), [("env_options", "wide"), ("id_options", "wide"), ("algo", ["sac"])]
)
def test_a_damaged_configuration_beside_an_archive_is_named(run, entry, value):
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**config, entry: value}))
    with pytest.raises(SystemExit, match=f"config.json of its run is damaged: {entry}: "):
        main(["export", str(run / "best.zip"), str(run / "out"), "--trust-pickle"])
    assert not (run / "out.json").exists()


def test_files_that_are_no_policy_are_neither_replaced_nor_removed(run):
    (run / "weights.safetensors").write_bytes(b"of another program")
    (run / "list.json").write_text("[]")
    before = {file: file.read_bytes() for file in run.iterdir()}
    for out in ("config", "weights", "list.safetensors"):
        with pytest.raises(SystemExit, match=r"is no policy of tpm_gym.* choose another name"):
            main(["export", str(run / "best.zip"), str(run / out), "--trust-pickle"])
        export.remove(run / out)
    assert {file: file.read_bytes() for file in run.iterdir()} == before


def test_the_folder_of_a_run_is_exported_as_it_is_evaluated(run, model):
    save(model, run / "last")
    main(["export", str(run), str(run / "copy")])
    assert (run / "copy.json").read_bytes() == (run / "last.json").read_bytes()
    model.num_timesteps = 7
    save(model, run / "best")
    main(["export", str(run), str(run / "copy")])
    assert tpm_gym.load_policy(run / "copy").description.steps == 7


# -- models that tpm_gym has not trained ----------------------------------------------------------

REACH = ("--env", "TPMReach-v0", "--engine", "analytic")


@pytest.fixture(scope="module")
def reach():
    with gym.make("TPMReach-v0", engine="analytic") as env:
        yield env


def in_reach(reach: gym.Env[Any, Any]) -> Blank:
    return Blank(reach.action_space, **reach.observation_space.spaces)


@pytest.mark.parametrize("kind", [SAC, TQC, PPO])
def test_a_model_without_a_run_is_exported_for_the_environment_that_one_names(
    tmp_path, reach, kind, capsys
):
    made = make(kind, in_reach(reach), net_arch=[8], **GOAL_GAP)
    made.save(tmp_path / "v.zip")
    out = tmp_path / "v"
    main(["export", str(tmp_path / "v.zip"), str(out), "--trust-pickle", *REACH])
    loaded = tpm_gym.load_policy(out)
    about = loaded.description
    assert (about.env_id, about.algorithm, about.seed) == ("TPMReach-v0", kind.__name__.lower(), 0)
    assert about.env_options == {"engine": "analytic"}
    batch = observations(reach, 10)
    expected, _ = made.predict(batch, deterministic=True)
    np.testing.assert_allclose(loaded.act(batch), expected, atol=1e-5)
    main(["evaluate", "--policy", str(out), "--engine", "analytic", "--episodes", "1"])
    assert "success at end" in capsys.readouterr().out


def test_a_model_in_memory_is_saved_with_what_it_was_trained_in(tmp_path, reach):
    made = make(SAC, in_reach(reach), net_arch=[8])
    options = EnvOptions(engine="analytic", machine="wide")
    path = save_policy(made, str(tmp_path / "p"), env_id="TPMReach-v0", env_options=options)
    about = tpm_gym.load_policy(path).description
    assert about.env_options == {"engine": "analytic", "machine": "wide"}


def test_a_model_of_another_environment_is_refused(tmp_path, model):
    options = EnvOptions(engine="analytic")
    for env_id, space in (("TPMReach-v0", "action"), ("TPMPickAndPlace-v0", "observation")):
        with pytest.raises(PolicyError, match=f"model has the {space} space .* {env_id} has "):
            save_policy(model, tmp_path / "p", env_id=env_id, env_options=options)
    model.save(tmp_path / "v.zip")
    with pytest.raises(SystemExit, match="give the environment id of its training"):
        main(["export", str(tmp_path / "v.zip"), str(tmp_path / "p"), "--trust-pickle", *REACH])
    with pytest.raises(ConfigError, match="unknown environment 'TPMReech-v0'"):
        save_policy(model, tmp_path / "p", env_id="TPMReech-v0")
    assert [file.name for file in tmp_path.iterdir()] == ["v.zip"]


@pytest.mark.parametrize("kind", [A2C, DDPG])
def test_a_model_of_an_algorithm_that_cannot_be_exported_is_refused(tmp_path, reach, kind):
    options: dict[str, Any] = {} if kind is A2C else {"buffer_size": 10}
    kind("MultiInputPolicy", in_reach(reach), **options).save(tmp_path / "v.zip")
    with pytest.raises(SystemExit, match="algorithm that is none of sac, tqc, ppo"):
        main(["export", str(tmp_path / "v.zip"), str(tmp_path / "p"), "--trust-pickle", *REACH])


@pytest.mark.parametrize("folder", [".", "TPMReach-v0"])  # the zoo's is the second
def test_a_model_that_acts_on_normalised_observations_is_refused(tmp_path, reach, folder):
    make(PPO, in_reach(reach)).save(tmp_path / "v.zip")
    (tmp_path / folder).mkdir(exist_ok=True)
    (tmp_path / folder / "vecnormalize.pkl").touch()
    with pytest.raises(SystemExit, match="normalised observations"):
        main(["export", str(tmp_path / "v.zip"), str(tmp_path / "p"), "--trust-pickle", *REACH])
