"""How often each clip is drawn: kinds and sources balanced, repeats of short clips limited."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, slots=True)
class BalanceConfig:
    """Weights of groups of clips; a group is one kind of one source."""

    power: float = 0.5
    """A group of n seconds weighs n^power: 1 draws every second alike, 0 every group alike."""
    source_share: Mapping[str, float] = field(default_factory=dict)
    """Share of all draws that a source shall have (where caps allow it); the others divide the rest."""
    repeat_cap: float = 4.0
    """A clip is drawn at most this many times as often as it would be if every second were drawn alike."""


def clip_probabilities(
    kinds: Sequence[str],
    sources: Sequence[str],
    seconds: Float[np.ndarray, "clips"],
    config: BalanceConfig | None = None,
) -> Float[np.ndarray, "clips"]:
    """Probability of each clip; inside a group proportional to its length. Sums to 1.

    Raises:
        ValueError: no clips, or lengths of different number or not positive.
    """
    config = config or BalanceConfig()
    if not len(kinds) == len(sources) == len(seconds) or len(kinds) == 0:
        raise ValueError(f"clip_probabilities: want as many kinds as sources and lengths, got {len(kinds)}")
    length = np.asarray(seconds, float)
    if not (length > 0).all():
        raise ValueError("clip_probabilities: want lengths above 0 s")
    groups = [f"{source}\t{kind}" for kind, source in zip(kinds, sources, strict=True)]
    _, group = np.unique(groups, return_inverse=True)
    total = np.bincount(group, length)
    weight = length * total[group] ** (config.power - 1.0)
    weight = _with_shares(weight, np.asarray(sources), config.source_share)
    return _capped(weight, config.repeat_cap * length / length.sum())


def _with_shares(weight: np.ndarray, sources: np.ndarray, share: Mapping[str, float]) -> Float[np.ndarray, "clips"]:
    """Weights summing to 1 in which the named sources have their share."""
    weight = weight / weight.sum()
    present = {name: s for name, s in share.items() if weight[sources == name].sum() > 0}
    fixed = np.isin(sources, list(present))
    if fixed.all() or not present:
        return weight
    if not 0 <= sum(present.values()) < 1:
        raise ValueError(f"source_share: want shares that leave something for other sources, got {dict(share)}")
    weight[~fixed] *= (1 - sum(present.values())) / weight[~fixed].sum()
    for name, part in present.items():
        chosen = sources == name
        weight[chosen] *= part / weight[chosen].sum()
    return weight


def _capped(weight: np.ndarray, cap: np.ndarray) -> Float[np.ndarray, "clips"]:
    """Weights summing to 1, none above its cap; what is cut off goes to the others in proportion."""
    result = weight / weight.sum()
    if cap[weight > 0].sum() <= 1.0:
        return np.where(weight > 0, cap, 0.0) / cap[weight > 0].sum()
    full = np.zeros(len(result), bool)
    while (over := (result > cap * (1 + 1e-9)) & ~full).any():
        full |= over
        result[full] = cap[full]
        free = ~full & (result > 0)
        result[free] *= (1 - cap[full].sum()) / result[free].sum()
    return result / result.sum()
