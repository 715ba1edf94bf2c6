"""Behaviour cloning: networks of an actor-critic policy are fitted to recorded episodes."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from torch.nn import functional

_RATE: Final = 1e-3
_BATCH: Final = 256
_BETA: Final = 0.1
"""Limit of an action's error: above it the loss is linear, below it quadratic.

In similar states, for example where the expert's path turns, the expert takes two different
actions. A squared loss would teach the mean of the two actions, which is neither of them.
"""
_VALUE_EPOCHS: Final = 3


def clone(
    model: OnPolicyAlgorithm,
    observations: Mapping[str, NDArray[Any]],
    actions: NDArray[Any],
    returns: NDArray[Any],
    epochs: int,
) -> None:
    """Fit a policy's mean action, and its value function, to n recorded steps.

    Args:
        model: Algorithm whose policy is an ``ActorCriticPolicy`` of Stable-Baselines3.
        observations: Arrays (n, ...) by name.
        actions: (n, action_size), the actions to imitate.
        returns: (n,), discounted sums of the rewards that followed.
        epochs: Number of passes over the actions.
    """
    policy: Any = model.policy
    policy.set_training_mode(True)
    seen = {name: _tensor(values, model) for name, values in observations.items()}
    wanted, worth = _tensor(actions, model), _tensor(returns, model)
    with torch.no_grad():
        policy.value_net.bias.fill_(worth.mean())

    def action_loss(rows: torch.Tensor) -> torch.Tensor:
        chosen = {name: values[rows] for name, values in seen.items()}
        mean = policy.get_distribution(chosen).distribution.mean
        return functional.smooth_l1_loss(mean, wanted[rows], beta=_BETA)

    def value_loss(rows: torch.Tensor) -> torch.Tensor:
        chosen = {name: values[rows] for name, values in seen.items()}
        return functional.mse_loss(policy.predict_values(chosen)[:, 0], worth[rows])

    _fit(policy, action_loss, len(wanted), epochs)
    _fit(policy, value_loss, len(worth), _VALUE_EPOCHS)
    policy.set_training_mode(False)


def _tensor(values: NDArray[Any], model: OnPolicyAlgorithm) -> torch.Tensor:
    return torch.as_tensor(np.asarray(values, np.float32), device=model.device)


def _fit(
    policy: torch.nn.Module, loss: Callable[[torch.Tensor], torch.Tensor], count: int, epochs: int
) -> None:
    """Minimise a loss over ``count`` recorded steps with Adam; the learning rate falls to zero.

    ``loss`` gets the indices of a batch of steps.
    """
    optimiser = torch.optim.Adam(policy.parameters(), lr=_RATE)
    for epoch in range(epochs):
        batches = torch.split(torch.randperm(count), _BATCH)
        for index, rows in enumerate(batches):
            optimiser.param_groups[0]["lr"] = _RATE * (1 - (epoch + index / len(batches)) / epochs)
            optimiser.zero_grad()
            loss(rows).backward()  # type: ignore[no-untyped-call]
            optimiser.step()
