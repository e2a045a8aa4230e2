"""Windows of consecutive (state, action) pairs, gathered by index from resident arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import NamedTuple

import torch as th


class Windows(NamedTuple):
    """A batch of B windows of L steps; row k holds s_k and a_k of one episode, in environment units.

    Rows behind an episode's end repeat its last row and have ``valid`` False.
    """

    states: th.Tensor  # (B, L, obs_dim) float32
    actions: th.Tensor  # (B, L, act_dim) float32, in [-1, 1]
    valid: th.Tensor  # (B, L) bool; a prefix of each row, never empty
    values: th.Tensor  # (B,) float32, what the source says of the first state

    def to(self, device: th.device | str) -> Windows:
        """Return these windows on a device."""
        return Windows(*(part.to(device) for part in self))


@dataclass(frozen=True)
class WindowSource:
    """Every place a window can start, over arrays that are shared and, but by :meth:`to`, never copied.

    The arrays are laid out as a replay buffer's: ``n_rows`` time steps of ``n_envs`` parallel environments, possibly
    wrapped around. A plain dataset is the case ``n_envs=1``.

    :param states: (n_rows, n_envs, obs_dim) float32 true states
    :param actions: (n_rows, n_envs, act_dim) float32 in [-1, 1]
    :param rewards: (n_rows, n_envs) float32
    :param terminated: (n_rows, n_envs) bool, where the task itself ended an episode, not a time limit
    :param rows: (n_starts,) int64, the row of each possible start
    :param envs: (n_starts,) int64, the environment of each possible start
    :param remaining: (n_starts,) int64, stored steps from the start to its episode's end, both included, >= 1
    :param episodes: (n_starts,) int64, a number for the episode each start belongs to
    :param values: (n_starts,) float32, a value of each start's state, by which a trainer may weigh windows
    """

    states: th.Tensor
    actions: th.Tensor
    rewards: th.Tensor
    terminated: th.Tensor
    rows: th.Tensor
    envs: th.Tensor
    remaining: th.Tensor
    episodes: th.Tensor
    values: th.Tensor

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def obs_dim(self) -> int:
        return self.states.shape[-1]

    @property
    def act_dim(self) -> int:
        return self.actions.shape[-1]

    def sample(
        self, batch_size: int, length: int, generator: th.Generator | None = None, early_probability: float = 0.0
    ) -> Windows:
        """Draw windows whose starts are uniform over all stored steps, but for a part that is drawn early in episodes.

        :param batch_size: B
        :param length: L, steps of a window
        :param generator: torch's global one of the CPU by default
        :param early_probability: of a start whose episode is uniform over all episodes, and the logarithm of whose step
            is uniform: as many in steps 1 to 10 of an episode as in 10 to 100
        """
        device = "cpu" if generator is None else generator.device
        starts = th.randint(len(self), (batch_size,), generator=generator, device=device).to(self.rows.device)
        if early_probability > 0:
            order, firsts, sizes = self._by_episode
            draw = partial(th.rand, batch_size, generator=generator, device=device)
            is_early, place, step = (draw().to(starts.device) for _ in range(3))
            episode = (place * len(sizes)).long().clamp(max=len(sizes) - 1)  # (B,)
            step = ((sizes[episode] + 1) ** step - 1).long().clamp(max=sizes[episode] - 1)
            starts = th.where(is_early < early_probability, order[firsts[episode] + step], starts)
        return self.gather(starts, length)

    @cached_property
    def _by_episode(self) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """All starts by episode and step, (n_starts,), and each episode's first place there and number of starts."""
        by_step = self.remaining.argsort(descending=True, stable=True)
        order = by_step[self.episodes[by_step].argsort(stable=True)]
        sizes = th.unique(self.episodes, return_counts=True)[1]
        return order, sizes.cumsum(0) - sizes, sizes

    def gather(self, starts: th.Tensor, length: int) -> Windows:
        """Return the windows at given starts.

        :param starts: (B,) int64, indices into ``rows``, on the arrays' device
        :param length: L, steps of a window
        """
        steps = th.arange(length, device=starts.device)  # (L,)
        remaining = self.remaining[starts, None]  # (B, 1)
        offset = th.minimum(steps, remaining - 1)  # (B, L): behind the end, the last row again
        rows = (self.rows[starts, None] + offset) % len(self.states)  # (B, L)
        envs = self.envs[starts, None]  # (B, 1)
        return Windows(self.states[rows, envs], self.actions[rows, envs], steps < remaining, self.values[starts])

    def to(self, device: th.device | str) -> WindowSource:
        """Return this source over copies of the arrays on a device; where they are there already, over the same."""
        return WindowSource(**{field.name: getattr(self, field.name).to(device) for field in fields(self)})

    def split(self, held_out: float, seed: int = 0) -> tuple[WindowSource, WindowSource]:
        """Split by episodes into a training and a held-out source, so that no step is in windows of both.

        Episodes are drawn at random and held out as a whole. Of the last one drawn, no more than the end is, so that
        few or long episodes do not cost the training more than it was asked for.

        :param held_out: fraction of the starts to hold out, in (0, 1); at least one is
        :param seed: of the draw
        :raises ValueError: when there are fewer than two starts, so that one part would be empty
        """
        if len(self) < 2:
            raise ValueError(
                f"Holding out windows needs at least two stored steps, got {len(self)}; collect more, or train without "
                "held-out windows."
            )
        wanted = max(1, int(held_out * len(self)))
        numbers, sizes = th.unique(self.episodes, return_counts=True)
        order = th.randperm(len(numbers), generator=th.Generator().manual_seed(seed)).to(numbers.device)
        before = sizes[order].cumsum(0) - sizes[order]  # starts of the episodes drawn earlier
        drawn = numbers[order[before < wanted]]
        end = wanted - before[len(drawn) - 1]  # steps of the last one to hold out
        in_last = self.episodes == drawn[-1]
        held = th.isin(self.episodes, drawn[:-1]) | (in_last & (self.remaining <= end))
        training = self._select(~held)
        remaining = th.where(in_last[~held], training.remaining - end, training.remaining)
        return replace(training, remaining=remaining), self._select(held)

    def start_states(self) -> th.Tensor:
        """Return the state of every start: (n_starts, obs_dim)."""
        return self.states[self.rows, self.envs]

    def start_actions(self) -> th.Tensor:
        """Return the action of every start: (n_starts, act_dim)."""
        return self.actions[self.rows, self.envs]

    def _select(self, keep: th.Tensor) -> WindowSource:
        names = ("rows", "envs", "remaining", "values", "episodes")
        return replace(self, **{name: getattr(self, name)[keep] for name in names})
