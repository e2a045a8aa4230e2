"""Windows of consecutive (state, action) pairs, gathered by index from resident arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from operator import itemgetter
from typing import Any, NamedTuple

import torch as th

COMMON = 0.25  # an age is imitated by itself if it has at least this part of an even share of all decisions


class Windows(NamedTuple):
    """A batch of B windows of L steps; row k holds s_k and a_k of one episode, in environment units.

    Rows behind an episode's end repeat its last row and have ``valid`` False.
    """

    states: th.Tensor  # (B, L, obs_dim) float32
    actions: th.Tensor  # (B, L, act_dim) float32, in [-1, 1]
    valid: th.Tensor  # (B, L) bool; a prefix of each row, never empty
    values: th.Tensor  # (B,) float32, the source's value of the first state

    def to(self, device: th.device | str) -> Windows:
        """Return these windows on a device."""
        return Windows(*(part.to(device) for part in self))


class Seen(NamedTuple):
    """What each decision was made on: the start that lies as many steps earlier as the observation was old."""

    starts: th.Tensor  # (n_starts,) int64, for each decision; -1 where that start is not stored
    by_age: th.Tensor  # (n_stored + 1,) the stored ones, sorted by age, and a placeholder at the end
    firsts: th.Tensor  # (n_ages,) where each age begins in by_age
    sizes: th.Tensor  # (n_ages,) how many starts each age has
    is_common: th.Tensor  # (n_ages,) bool, whether windows are drawn by this age


def mean_and_deviation(rows: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Return both of rows (M, n): (n,) each, a deviation of 1 for entries that vary by no more than rounding.

    Rounding may leave a constant entry a tiny deviation. To divide by it would blow up noise.
    """
    size = rows.abs().amax(0)
    unit = th.exp2(size.clamp(min=1e-38).log2().floor())  # rounds nothing, and squares stay in float32
    variance, mean = th.var_mean(rows / unit, dim=0, correction=0)  # rows.mean would round where an entry never moves
    deviation = variance.sqrt() * unit
    return mean * unit, th.where(deviation <= 1e-6 * size, 1.0, deviation)


@dataclass(frozen=True)
class WindowSource:
    """Every place a window can start. The arrays of steps are shared; only :meth:`to` copies them.

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
    :param ages: (n_starts,) int64, age of the observation that each start's action was decided on, in control steps;
        None where that is not known, as in logs
    :raises ValueError: for states, actions, rewards or values of another dtype
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
    ages: th.Tensor | None = None

    def __post_init__(self) -> None:
        for name in ("states", "actions", "rewards", "values"):
            if (dtype := getattr(self, name).dtype) != th.float32:
                raise ValueError(f"{name} are {dtype}, expected torch.float32: give {name}.float().")

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
        :param early_probability: probability of an early start. Its episode is drawn uniformly, and so is the logarithm
            of its step: as many are in steps 1 to 10 as in 10 to 100. If an episode's first steps are not here, the
            first that is counts as step 1
        """
        return self.gather(self._draw(batch_size, generator, early_probability)[0], length)

    def sample_own(
        self, delay: th.Tensor, length: int, generator: th.Generator | None = None, early_probability: float = 0.0
    ) -> tuple[Windows, th.Tensor]:
        """Draw windows whose decision, d steps after their start, was made on the observation at their start.

        An agent under varying delays may do one thing on new observations and another on old ones. If a window begins
        at what its decision was made on, there is one answer to learn; else there is only the mean of several.

        :param delay: (B,) int64, the age d of each decision to draw. If hardly any was made at that age, any window is
            drawn
        :param length: L, steps of a window
        :param generator: torch's global one of the CPU by default
        :param early_probability: as in :meth:`sample`, but of decisions; these have their own age instead of ``delay``
        :return: windows, and the ages of their decisions, (B,)
        """
        seen = self._seen
        drawn, is_early = self._draw(len(delay), generator, early_probability)
        place = th.rand(len(delay), generator=generator, device="cpu" if generator is None else generator.device)
        age = delay.clamp(max=len(seen.sizes) - 1)
        step = (place.to(delay.device) * seen.sizes[age]).long().clamp(max=seen.sizes[age] - 1)
        starts = th.where(seen.is_common[age] & (delay == age), seen.by_age[seen.firsts[age] + step], drawn)
        is_early = is_early & (seen.starts[drawn] >= 0)
        assert self.ages is not None  # for mypy: _seen has read them
        starts, delay = th.where(is_early, seen.starts[drawn], starts), th.where(is_early, self.ages[drawn], delay)
        return self.gather(starts, length), delay

    def own_starts(self, age: int) -> th.Tensor:
        """Return the starts that decisions of an age were made on; none where :meth:`sample_own` draws any window."""
        seen = self._seen
        if age >= len(seen.sizes) or not seen.is_common[age]:
            return seen.by_age[:0]
        return seen.by_age[int(seen.firsts[age]) :][: int(seen.sizes[age])]

    def _draw(
        self, batch_size: int, generator: th.Generator | None, early_probability: float
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return starts, and which of them are drawn early: (B,) int64 and bool."""
        device = "cpu" if generator is None else generator.device
        starts = th.randint(len(self), (batch_size,), generator=generator, device=device).to(self.rows.device)
        if early_probability == 0:
            return starts, th.zeros_like(starts, dtype=th.bool)
        order, firsts, sizes = self._by_episode
        draw = partial(th.rand, batch_size, generator=generator, device=device)
        chance, place, step = (draw().to(starts.device) for _ in range(3))
        is_early = chance < early_probability
        episode = (place * len(sizes)).long().clamp(max=len(sizes) - 1)  # (B,)
        step = ((sizes[episode] + 1) ** step - 1).long().clamp(max=sizes[episode] - 1)
        return th.where(is_early, order[firsts[episode] + step], starts), is_early

    @cached_property
    def _by_episode(self) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """All starts by episode and step, (n_starts,); each episode's first place in them, and its number of starts."""
        by_step = self.remaining.argsort(descending=True, stable=True)
        order = by_step[self.episodes[by_step].argsort(stable=True)]
        sizes = th.unique(self.episodes, return_counts=True)[1]
        return order, sizes.cumsum(0) - sizes, sizes

    @cached_property
    def _seen(self) -> Seen:
        """What each decision was made on."""
        assert self.ages is not None  # for mypy: the callers have seen to it
        order, firsts, sizes = self._by_episode
        ages = self.ages[order]
        before = th.arange(len(order), device=order.device) - ages
        is_here = before >= firsts.repeat_interleave(sizes)  # in the same episode
        starts = th.full_like(order, -1)
        starts[order] = th.where(is_here, order[before.clamp(min=0)], -1)
        by_age = starts[order[is_here]][ages[is_here].argsort(stable=True)]
        by_age = th.cat([by_age, by_age.new_zeros(1)])  # so that an age without starts can be looked up, too
        sizes = th.bincount(ages[is_here], minlength=1)
        is_common = sizes * len(sizes) >= COMMON * len(self)
        return Seen(starts, by_age, sizes.cumsum(0) - sizes, sizes, is_common)

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
        """Return this source with its arrays copied to a device; those that are there already are shared."""
        return self._with((field.name for field in fields(self)), lambda array: array.to(device))

    def split(self, held_out: float, seed: int = 0) -> tuple[WindowSource, WindowSource]:
        """Split by episodes into a training and a held-out source, so that no step is in windows of both.

        Episodes are drawn at random and held out as a whole. Of the last one drawn, only as many steps of its end are
        held out as are still missing. So few or long episodes do not cost the training more than it was asked for.

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
        return self._with(("rows", "envs", "remaining", "values", "episodes", "ages"), itemgetter(keep))

    def _with(self, names: Iterable[str], change: Callable[[th.Tensor], th.Tensor]) -> WindowSource:
        """Return this source with some arrays changed; unknown ages stay None."""
        arrays = {name: getattr(self, name) for name in names}
        changed: dict[str, Any] = {name: x if x is None else change(x) for name, x in arrays.items()}
        return replace(self, **changed)
