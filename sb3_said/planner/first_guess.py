"""The first guess: plain networks predict a window from what is known, before the planner does."""

from __future__ import annotations

from collections.abc import Callable

import torch as th
from torch import nn

from sb3_said.planner.config import PlannerConfig
from sb3_said.planner.normalizer import Normalizer
from sb3_said.planner.plain import OneStepModel, descend, plain_network
from sb3_said.planner.values import window_weight
from sb3_said.replay.windows import Windows, WindowSource

CLONE_WIDTH = 256
CLONE_LEARNING_RATE = 1e-3
GUESS_BATCH_SIZE = 256
# Training over many steps at once: the number of single-step updates for one such update, its part of their learning
# rate (at a quarter an Ant-v5 lost a third of its return, results/first_guess.md), and the largest norm of a gradient
ROLLED_EACH, ROLLED_RATE, ROLLED_CLIP = 16, 0.1, 1.0


class FirstGuess(nn.Module):
    """A model of one step, rolled out over the actions since the observation, and a clone that acts on its last state.

    A sample costs a plain network little. So the two learn sooner than the planner how a task moves and which actions
    the data has. But the model's errors compound, and the clone does not know of them. The planner is shown the guess,
    and may depart from it.

    States are z-scored, actions in [-1, 1].
    """

    def __init__(self, obs_dim: int, act_dim: int) -> None:
        super().__init__()
        self.model = OneStepModel(obs_dim, act_dim)
        self.clone = plain_network(obs_dim, act_dim, CLONE_WIDTH)

    @th.no_grad()
    def forward(
        self, states: th.Tensor, actions: th.Tensor, delay: th.Tensor, known: th.Tensor, longest: int
    ) -> th.Tensor:
        """Guess windows: the states up to the present; from there on the present again, with the clone's action.

        :param states: (B, L, obs_dim); known ones count
        :param actions: (B, L, act_dim); those before the decision index count
        :param delay: (B,) int64 d
        :param known: (B, L) bool, which states are known; the first always is
        :param longest: an upper bound of the delays, below L
        :return: (B, L, obs_dim + act_dim), 0 where an action is known
        """
        return self.windows(self.roll_out(states, actions, known, longest), delay, states.shape[1])

    @th.no_grad()
    def roll_out(self, states: th.Tensor, actions: th.Tensor, known: th.Tensor, n_steps: int) -> th.Tensor:
        """Return the states that the model predicts from the first, known ones as given: (B, n_steps + 1, obs_dim).

        The arguments are those of :meth:`forward`, but here the first ``n_steps`` actions count.
        """
        rolled = [states[:, 0]]
        for k in range(n_steps):
            rolled.append(th.where(known[:, k + 1, None], states[:, k + 1], self.model(rolled[k], actions[:, k])))
        return th.stack(rolled, dim=1)

    @th.no_grad()
    def windows(self, rolled: th.Tensor, delay: th.Tensor, length: int) -> th.Tensor:
        """Return guesses as :meth:`forward` does, of windows whose present is one of the states rolled out.

        :param rolled: (B, n_steps + 1, obs_dim), from :meth:`roll_out`
        :param delay: (B,) int64, at most n_steps
        :param length: L
        """
        step = th.arange(length, device=delay.device)
        index = th.minimum(step, delay[:, None])[..., None].expand(-1, -1, rolled.shape[-1])  # (B, L, obs_dim)
        states = rolled.gather(1, index)
        action = self.clone(states[:, -1]).clamp(-1.0, 1.0)[:, None]  # (B, 1, act_dim), of the present
        is_decided = step >= delay[:, None]  # (B, L)
        return th.cat([states, th.where(is_decided[..., None], action, 0.0)], dim=-1)

    def clone_loss(self, states: th.Tensor, actions: th.Tensor, weight: th.Tensor) -> th.Tensor:
        """Return the clone's mean squared error, in action units.

        :param states: (B, obs_dim)
        :param actions: (B, act_dim)
        :param weight: (B,) factor of each error, as of the windows in the planner's loss
        """
        return (((self.clone(states) - actions) ** 2).mean(-1) * weight).mean()


def fit_first_guess(
    guess: FirstGuess,
    source: WindowSource,
    normalizer: Normalizer,
    config: PlannerConfig,
    n_updates: int,
    generator: th.Generator,
    longest: int,
    progress_bar: bool = False,
    should_stop: Callable[[], bool] | None = None,
    older: WindowSource | None = None,
) -> bool:
    """Train the plain networks on single steps, then the model alone on as many at once as it will be rolled out over.

    A model that learned single steps has never met its own answers. Where a policy acts on these, the model fails, at
    old observations first (measured, results/first_guess.md).

    :param guess: to train, on the device of the sources
    :param source: windows, weighed by their ``values``
    :param normalizer: fitted to the source
    :param config: of the planner: how windows are drawn and weighed
    :param n_updates: on single steps
    :param generator: of the batches
    :param longest: steps that the model will be rolled out over; at 1 there is no second part, at 0 no model to train
    :param progress_bar: show one
    :param should_stop: asked after every update
    :param older: older steps, for half of each of the model's batches and none of the clone's: what a policy did goes
        out of date, how the task moves does not. They take a quarter off the model's errors where the newest steps are
        few, and cost nothing where those are many (results/first_guess.md)
    :return: whether all updates were made
    """
    model, clone = guess.model, guess.clone
    model.move_std.copy_(normalizer.move_std[0])

    def draw(length: int) -> Windows:
        return source.sample(GUESS_BATCH_SIZE, length, generator, config.early_probability)

    def model_loss(windows: Windows) -> th.Tensor:
        if older is not None:
            half, length = GUESS_BATCH_SIZE // 2, windows.states.shape[1]
            old = older.sample(half, length, generator, config.early_probability)
            windows = Windows(*(th.cat([new[:half], x]) for new, x in zip(windows, old, strict=True)))
        states, actions, valid, _ = windows
        return model.loss(normalizer.normalize_states(states), actions[:, :-1], valid[:, 1:])

    def both_losses() -> th.Tensor:
        windows = draw(2)
        state = normalizer.normalize_states(windows.states[:, 0])
        weight = window_weight(windows.values, config.weight_factor)
        loss = guess.clone_loss(state, windows.actions[:, 0], weight)
        return loss + model_loss(windows) if longest > 0 else loss

    rate, asked = OneStepModel.learning_rate, (progress_bar, should_stop)
    rates: dict[nn.Module, float] = ({model: rate} if longest > 0 else {}) | {clone: CLONE_LEARNING_RATE}
    if not descend(both_losses, rates, None, n_updates, "first guess", *asked):
        return False
    if longest <= 1:
        return True
    rates, n_updates = {model: ROLLED_RATE * rate}, -(-n_updates // ROLLED_EACH)
    return descend(lambda: model_loss(draw(longest + 1)), rates, ROLLED_CLIP, n_updates, f"{longest} steps", *asked)
