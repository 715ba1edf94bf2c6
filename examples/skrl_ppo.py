"""PPO by skrl (``pip install skrl``) on the vector environment, for the dense Reach.

One learns how a library that wraps ``gymnasium.vector`` takes the environments: skrl flattens the
observation to achieved goal, desired goal and observation. It takes 24 s of a
processor core, and reached 100.0% success.
"""

import sys

import gymnasium as gym
import torch
from skrl.agents.torch.ppo import PPO
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import nn

STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 160_000
ENV_ID, COUNT = "tpm_gym:TPMReachDense-v0", 256


class Network(GaussianMixin, DeterministicMixin, Model):
    def __init__(self, **spaces):
        for base in (Model, GaussianMixin, DeterministicMixin):
            base.__init__(self, **(spaces if base is Model else {}))
        self.log_std, size = nn.Parameter(torch.full((3,), -0.5)), self.num_observations + 3
        for name, out in (("policy", 3), ("value", 1)):
            self.add_module(name, nn.Sequential(nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, out)))

    def act(self, inputs, *, role):
        base = GaussianMixin if role == "policy" else DeterministicMixin
        return base.act(self, inputs, role=role)

    def compute(self, inputs, role):
        seen = inputs["observations"]
        gap = (seen[:, 3:6] - seen[:, :3]) / 0.05  # the way to the goal, in units of 5 cm
        return getattr(self, role)(torch.cat([seen, gap], dim=1)), {"log_std": self.log_std}


set_seed(0)
torch.set_num_threads(1)
# skrl values a cut-off episode by the observation of the same step, so the reset is in the next.
env = wrap_env(gym.make_vec(ENV_ID, COUNT, engine="analytic", stagger=True), wrapper="gymnasium")
spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
network, memory = Network(**spaces, device="cpu"), RandomMemory(memory_size=16, num_envs=COUNT)
settings = {"rollouts": 16, "mini_batches": 4, "grad_norm_clip": 2.0, "learning_rate": 1e-3}
settings |= {"discount_factor": 0.9, "gae_lambda": 0.9, "time_limit_bootstrap": True}
settings |= {"value_clip": 0, "experiment": {"write_interval": 0, "checkpoint_interval": 0}}
agent = PPO(models={"policy": network, "value": network}, memory=memory, cfg=settings, **spaces)
trainer = {"timesteps": max(16, STEPS // COUNT), "headless": True}
SequentialTrainer(env=env, agents=agent, cfg=trainer).train()
seen, _ = (tests := gym.make_vec(ENV_ID, 200, engine="analytic")).reset(seed=2_000_000)
for _ in range(50):
    rows = torch.cat([torch.as_tensor(seen[name]).float() for name in sorted(seen)], dim=1)
    action, _ = network.compute({"observations": rows}, "policy")
    seen, _, _, _, infos = tests.step(action.detach().clamp(-1, 1).numpy())
print(f"success at the end: {infos['is_success'].mean():.1%} of 200 episodes")
