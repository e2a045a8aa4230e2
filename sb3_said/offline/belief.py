"""Belief-only control: decode the present from what is known under delay, and let a policy without delay act on it."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch as th
from gymnasium import spaces
from torch.nn import functional as F

from sb3_said.planner import InpaintingPlanner
from sb3_said.planner.inpainting import newest
from sb3_said.planner.plain import OneStepModel, ZScored, descend
from sb3_said.planner.yardstick import RegressionYardstick
from sb3_said.replay.windows import Windows, WindowSource, mean_and_deviation

Observation = dict[str, np.ndarray]


class Belief(Protocol):
    """Tells which state a task is in now."""

    max_delay: int

    def present(self, state: th.Tensor, action_history: th.Tensor, delay: th.Tensor) -> th.Tensor:
        """Return s_t: (B, obs_dim).

        :param state: (B, obs_dim) s_{t-d}
        :param action_history: (B, D, act_dim), the D newest actions in [-1, 1], oldest first
        :param delay: (B,) int64 d, in 0..D
        """


class PlannerBelief:
    """The present as an inpainting planner decodes it, or as its first guess has it.

    :param planner: of a trained SAID agent, ``model.policy.planner``
    :param which: ``"inpainted"`` or ``"guessed"``
    :raises ValueError: for a present that the planner's settings do not allow, such as a guessed one without a first
        guess
    """

    def __init__(self, planner: InpaintingPlanner, which: str = "inpainted"):
        self.planner, self.max_delay = copy.copy(planner), planner.max_delay  # the same weights, other settings
        self.planner.config = replace(planner.config, present=which, decided_by="plan")  # this copy decides nothing

    def present(self, state: th.Tensor, action_history: th.Tensor, delay: th.Tensor) -> th.Tensor:
        """Return the present, decoded at temperature 0 or guessed: (B, obs_dim)."""
        if self.planner.config.present == "guessed":
            return self.planner.guess(state, action_history, delay)[0]
        return self.planner.plan(state, action_history, delay, temperature=0.0).present


class LearnedBelief(ZScored):
    """A network that is trained on windows and reads z-scored states.

    :param max_delay: D, the largest delay
    """

    learning_rate = 1e-3  # of Adam

    def __init__(self, obs_dim: int, max_delay: int):
        super().__init__(obs_dim)
        self.max_delay = max_delay

    def fit_scale(self, source: WindowSource) -> None:
        """Fit the scale of states to the source's."""
        self.scale_to(source.start_states().to(self.mean.device))

    def loss(self, windows: Windows, generator: th.Generator) -> th.Tensor:
        """Return the mean squared error of z-scored states.

        :param windows: B windows of D + 1 steps
        :param generator: draws what else is random
        """
        raise NotImplementedError


class RolledOutModel(LearnedBelief):
    """A model of one step, (s, a) to s', rolled out over the actions sent since. Its errors compound."""

    learning_rate = OneStepModel.learning_rate

    def __init__(self, obs_dim: int, act_dim: int, max_delay: int):
        super().__init__(obs_dim, max_delay)
        self.model = OneStepModel(obs_dim, act_dim)

    def fit_scale(self, source: WindowSource) -> None:
        """Fit the scales of states and of their moves, so that small moves count as much as large ones."""
        super().fit_scale(source)
        steps = source.gather(th.arange(len(source), device=source.rows.device), 2).to(self.mean.device)
        moves = self._z(steps.states)[steps.valid[:, 1]].diff(dim=1)[:, 0].abs().median(0).values
        self.model.move_std.copy_(th.where(moves > 1e-6, moves, 1.0))

    def present(self, state: th.Tensor, action_history: th.Tensor, delay: th.Tensor) -> th.Tensor:
        """Return s_t, after one step of the model for each action sent since: (B, obs_dim)."""
        z = self._z(state)
        for k in range(self.max_delay):
            is_since = (self.max_delay - k <= delay)[:, None]  # a_{t-D+k} came after s_{t-d}
            z = th.where(is_since, self.model(z, action_history[:, k]), z)
        return z * self.std + self.mean

    def loss(self, windows: Windows, generator: th.Generator) -> th.Tensor:
        """Return the model's loss on the first step of each window."""
        return self.model.loss(self._z(windows.states[:, :2]), windows.actions[:, :1], windows.valid[:, 1:2])


class RegressedPresent(LearnedBelief):
    """A plain regression from s_{t-d} and the actions sent since to s_t."""

    def __init__(self, obs_dim: int, act_dim: int, max_delay: int):
        super().__init__(obs_dim, max_delay)
        self.net = RegressionYardstick(obs_dim, act_dim, max_delay)

    def present(self, state: th.Tensor, action_history: th.Tensor, delay: th.Tensor) -> th.Tensor:
        """Return s_t, from one pass of the network: (B, obs_dim)."""
        since = newest(action_history, delay, self.max_delay)
        return self.net(self._z(state), since, delay)[0] * self.std + self.mean

    def loss(self, windows: Windows, generator: th.Generator) -> th.Tensor:
        """Return the error at ages drawn at random."""
        delay = th.randint(self.max_delay + 1, (len(windows.states),), generator=generator).to(windows.states.device)
        rows = th.arange(len(delay), device=delay.device)
        present, _ = self.net(self._z(windows.states[:, 0]), windows.actions, delay)
        error = F.mse_loss(present, self._z(windows.states[rows, delay]), reduction="none").mean(1)  # (B,)
        return error[windows.valid[rows, delay]].mean()


def train_belief(
    belief: LearnedBelief,
    source: WindowSource,
    gradient_steps: int,
    batch_size: int = 256,
    seed: int = 0,
    progress_bar: bool = False,
) -> None:
    """Train a belief with Adam; its learning rate falls by a cosine from the belief's own to 0.

    :param belief: to train, on its own device
    :param source: windows of true states, such as ``model.replay_buffer.window_source()``
    :param seed: of the batches
    :param progress_bar: show one
    """
    device, generator = belief.mean.device, th.Generator().manual_seed(seed)
    belief.fit_scale(source)
    length = max(belief.max_delay, 1) + 1  # a model of one step needs two states

    def loss() -> th.Tensor:
        return belief.loss(source.sample(batch_size, length, generator).to(device), generator)

    descend(loss, {belief: belief.learning_rate}, None, gradient_steps, type(belief).__name__, progress_bar, None)


@th.no_grad()
def belief_error(belief: Belief, windows: Windows, delay: int) -> float:
    """Return the root of the mean squared error of s_t, in standard deviations of the windows' states.

    :param windows: held out from training, of at least delay + 1 steps
    :param delay: d, the same for all
    :raises ValueError: when no window has delay + 1 steps of one episode
    """
    reach = windows.valid[:, delay]
    if not reach.any():
        raise ValueError(f"No window has {delay + 1} steps of one episode, which an error at delay {delay} needs.")
    states, actions = windows.states[reach], windows.actions[reach]
    history = F.pad(actions[:, :delay], (0, 0, belief.max_delay - delay, 0))  # (B, D, act_dim)
    ages = th.full((len(states),), delay, device=states.device)
    found = belief.present(states[:, 0], history, ages).to(states.device)
    spread = mean_and_deviation(windows.states[windows.valid])[1]
    return float((((found - states[:, delay]) / spread) ** 2).mean().sqrt())


class BeliefOnly:
    """A policy without delay that acts on a belief of the present; it has SB3's ``predict``.

    :param belief: tells the present state
    :param actor: anything with SB3's ``predict`` and ``observation_space``: an agent of a task without delay, or one of
        ours under delay, which is shown the believed state at age 0
    :param device: of the belief
    :raises ValueError: for an actor of other observations, or one of ours that learned with ``VecNormalize``
    """

    def __init__(self, belief: Belief, actor: Any, device: th.device | str = "cpu"):
        space = actor.observation_space
        is_delayed = isinstance(space, spaces.Dict) and "action_history" in space.spaces
        if not (isinstance(space, spaces.Box) or is_delayed):
            raise ValueError(f"The actor reads {space}; expected states, or those of a DelayedObservationWrapper.")
        if getattr(actor, "reads_normalized", False):
            raise ValueError("The actor learned with VecNormalize, whose scale a belief has not: train one without.")
        self.belief, self.actor, self.device = belief, actor, th.device(device)
        self.age_0_spaces = {key: box for key, box in space.items() if key != "observation"} if is_delayed else None

    @th.no_grad()
    def present(self, observation: Observation) -> np.ndarray:
        """Return the believed s_t of batched observations: (B, obs_dim).

        :raises ValueError: for an action history of another length than the belief's largest delay
        """
        given = np.asarray(observation["action_history"], np.float32)
        if given.shape[1] != self.belief.max_delay:
            raise ValueError(
                f"The belief serves delays up to {self.belief.max_delay}, but the action history has {given.shape[1]} "
                f"rows; give the task DelayedObservationWrapper(..., max_delay={self.belief.max_delay})."
            )
        state, history = (
            th.as_tensor(np.array(x, np.float32), device=self.device) for x in (observation["observation"], given)
        )
        delay = th.as_tensor(np.array(observation["delay"][:, 0], np.int64), device=self.device)
        return self.belief.present(state, history, delay).cpu().numpy()

    def predict(
        self,
        observation: Observation,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Let the actor answer the believed present of one delayed observation, or of each in a batch."""
        is_batch = np.ndim(observation["delay"]) == 2
        batch = observation if is_batch else {key: np.asarray(value)[None] for key, value in observation.items()}
        present: Any = self.present(batch)
        if self.age_0_spaces is not None:  # at age 0 no action was sent since, and no other state is read
            seen = {key: np.zeros((len(present), *box.shape), np.float32) for key, box in self.age_0_spaces.items()}
            history, shown = np.asarray(batch["action_history"]), seen["action_history"]
            n = min(history.shape[1], shown.shape[1])  # actions stay: zeros would mean the start of an episode
            shown[:, shown.shape[1] - n :] = history[:, history.shape[1] - n :]
            present = {"observation": present, **seen}
        action, state = self.actor.predict(present, state, episode_start, deterministic)
        return (action if is_batch else action[0]), state
