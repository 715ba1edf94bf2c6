"""Minimisation by gradients within limits, by an interior-point method."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_STEPS = 300  # at most, for each weight
_FLAT = 1e-7  # where the aim falls by no more in a step, it is done

Function = Callable[[Tensor], Tensor]


def minimise(aim: Function, limits: Function, start: Tensor, weights: tuple[float, ...]) -> Tensor:
    """Find the point (n,) near ``start`` at which ``aim`` is least while ``limits`` are positive.

    An interior-point method: aim - weight * sum(log(limits)), whose gradients are torch's, by BFGS,
    for one of the weights after the other. All points on its way keep the limits, so that functions
    which exist inside them only, as kinematics do, are never asked for more.

    Raises:
        ValueError: If a limit is not positive at ``start``.
    """
    if not (limits(start) > 0).all():
        raise ValueError(f"the start breaks a limit, {limits(start).min().item():.3g}")
    point = start
    for weight in weights:

        def barrier(at: Tensor, weight: float = weight) -> Tensor:
            room = limits(at)
            if not (room > 0).all():
                return at.sum() * 0 + torch.inf
            return aim(at) - weight * torch.log(room).sum()

        point = _bfgs(barrier, point)
    return point


def _bfgs(function: Function, point: Tensor) -> Tensor:
    """Find a minimum, with Armijo's rule; a step to an infinite value is halved."""
    value, slope = _with_gradient(function, point)
    eye = torch.eye(len(point), dtype=point.dtype)
    inverse = 1e-3 * eye / slope.norm()  # of the Hessian: a first step that is small
    for count in range(_STEPS):
        step = -inverse @ slope
        fall = float(step @ slope)
        while -fall > _FLAT:
            with torch.no_grad():
                if function(point + step) <= value + 1e-4 * fall:
                    break
            step, fall = step / 2, fall / 2
        else:
            break
        value, new = _with_gradient(function, point + step)
        point, change, slope = point + step, new - slope, new
        along = step @ change
        if along > 0:
            if not count:
                inverse = eye * along / (change @ change)
            left = eye - torch.outer(step, change) / along
            inverse = left @ inverse @ left.T + torch.outer(step, step) / along
    return point


def _with_gradient(function: Function, point: Tensor) -> tuple[Tensor, Tensor]:
    at = point.detach().requires_grad_()
    value = function(at)
    return value.detach(), torch.autograd.grad(value, at)[0]
