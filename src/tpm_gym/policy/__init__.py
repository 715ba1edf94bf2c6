"""Trained policies without pickle: :func:`load_policy` and :class:`Policy`.

Both need the extra ``policy``, whose packages are imported when one of the two is first used.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tpm_gym.policy.policy import Policy, load_policy

__all__ = ["Policy", "load_policy"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from tpm_gym.policy import policy

    return getattr(policy, name)
