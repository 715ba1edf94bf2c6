"""Kinematics without an engine: all solutions, the Jacobian and the conditioning over a grid.

One learns which functions take arrays of points (they are the paper's closed forms, for NumPy and
PyTorch). It takes half a second of a processor core, and finds 83.4% of the region safe.
"""

import numpy as np

import tpm_gym
from tpm_gym import kinematics
from tpm_gym.kinematics import jacobian

home = np.array(tpm_gym.PAPER_TPM.home)  # point P, m; the paper's frame, z away from the base

# One point: every way in which the arms can be bent, and back.
postures = kinematics.inverse_all(home)  # 16 working modes
for mode, theta in zip(kinematics.WORKING_MODES, postures.theta, strict=True):
    print(mode.signs, np.degrees(theta).round(1), "deg")
theta = kinematics.inverse(home, kinematics.ELBOWS_OUT)  # the mode of the environments
print("forward kinematics return", kinematics.forward(theta), "m")

# The same joint positions: every place in which the platform can be assembled.
assemblies = kinematics.forward_all(theta)
print(assemblies.valid.sum(), "assembly modes:", assemblies.position.round(4).tolist())

# The Jacobian: v = J theta_dot. It is checked here against a difference.
step = 1e-6
ends = [kinematics.forward(theta + sign * step * np.eye(3)) for sign in (1, -1)]
difference = (ends[0] - ends[1]).T / (2 * step)
error = np.abs(jacobian.velocity(theta) - difference).max()
print(f"Jacobian against differences: {error:.1e} m/rad")

# A grid: the conditioning 1/cond(J) depends on y most; it is 0 at the singularity y = 0.
region = tpm_gym.PAPER_TPM.region
axes = [np.linspace(low, high, 40) for low, high in zip(region.low, region.high, strict=True)]
grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)  # (40, 40, 40, 3)
conditioning = jacobian.conditioning_at(grid)  # (40, 40, 40)
for y, layer in zip(axes[1][::13], conditioning.swapaxes(0, 1)[::13], strict=True):
    print(f"y = {1000 * y:4.1f} mm: conditioning {layer.min():.3f} to {layer.max():.3f}")
safe = conditioning >= tpm_gym.PAPER_TPM.safe_conditioning
print(f"{safe.mean():.1%} of the region is safe")
