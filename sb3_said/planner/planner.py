"""The inpainting planner: hidden present and plan from a delayed observation and the actions sent since."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch as th
from torch import nn

from sb3_said.planner import diffusion, inpainting
from sb3_said.planner.checks import check_finite, check_shape, checked_delay
from sb3_said.planner.config import PlannerConfig
from sb3_said.planner.dit import DiT1d
from sb3_said.planner.graphs import RecordedFunction
from sb3_said.planner.normalizer import Normalizer
from sb3_said.planner.precision import autocast
from sb3_said.planner.selection import ValueFn, choose, mean_value, value_of
from sb3_said.replay.windows import Windows

MAX_GRAPHS = 8  # of a GPU; each keeps the memory of one decision


class Plan(NamedTuple):
    """Candidate plans for B decisions, in environment units."""

    action: th.Tensor  # (B, act_dim), in [-1, 1]: the best candidate's action at the decision index, or their mean
    present: th.Tensor  # (B, obs_dim): s_t as the candidates decode it, their mean
    states: th.Tensor  # (B, N, L, obs_dim), L the largest delay of the decisions plus the horizon
    actions: th.Tensor  # (B, N, L, act_dim), in [-1, 1]
    values: th.Tensor  # (B, N), the scores they were chosen or weighed by


class InpaintingPlanner(nn.Module):
    """State-Action Inpainting Diffuser: inpaints the unknown part of a window of states and actions.

    :param obs_dim: numbers in a state
    :param act_dim: numbers in an action
    :param max_delay: D, the largest delay it plans for; 0 is an ordinary planner
    :param config: settings; ``PlannerConfig()`` by default
    :raises ValueError: for dimensions below 1 or a negative max_delay

    >>> planner = InpaintingPlanner(obs_dim=3, act_dim=1, max_delay=2)
    >>> plan = planner.plan(th.zeros(1, 3), th.zeros(1, 2, 1), delay=th.tensor([2]))
    >>> plan.action.shape, plan.states.shape
    (torch.Size([1, 1]), torch.Size([1, 1, 10, 3]))
    """

    def __init__(self, obs_dim: int, act_dim: int, max_delay: int, config: PlannerConfig | None = None) -> None:
        super().__init__()
        if obs_dim < 1 or act_dim < 1 or max_delay < 0:
            raise ValueError(
                f"obs_dim, act_dim and max_delay are {obs_dim}, {act_dim} and {max_delay}, "
                "expected at least 1, 1 and 0."
            )
        self.config = config = PlannerConfig() if config is None else config
        self.obs_dim, self.act_dim, self.max_delay = obs_dim, act_dim, max_delay
        self.window_length = max_delay + config.horizon
        self.network = DiT1d(
            obs_dim,
            act_dim,
            max_delay,
            self.window_length,
            config.d_model,
            config.depth,
            config.embed_known,
            config.extra_state_probability > 0,
        )
        self.normalizer = Normalizer(
            obs_dim, act_dim, self.window_length, config.action_transform, config.relative_states
        )
        self._graphs: dict[Hashable, RecordedFunction] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_graphs": {}}  # a copy records its own

    @property
    def device(self) -> th.device:
        """Where the planner lives."""
        return self.normalizer.state_mean.device

    def check_ages(self, ages: Sequence[int]) -> None:
        """Refuse ages amid an episode that the network was not trained to plan at.

        :param ages: in control steps
        :raises ValueError: for ages above ``max_delay``; with ``mask="fixed"``, for any other than ``max_delay``
        """
        if self.config.mask == "fixed" and any(age != self.max_delay for age in ages):
            raise ValueError(
                f"A planner with mask='fixed' plans at age {self.max_delay} only, got {', '.join(map(str, ages))}; "
                "train one with mask='random', which plans at every age up to the largest."
            )
        if max(ages, default=0) > self.max_delay:
            raise ValueError(
                f"This planner plans at ages 0..{self.max_delay}, got {max(ages)}; build one with a larger max_delay."
            )

    def fit_normalizer(self, states: th.Tensor, actions: th.Tensor, windows: Windows | None = None) -> None:
        """Set the mean and standard deviation that states and (transformed) actions are z-scored with.

        :param states: (M, obs_dim), environment units
        :param actions: (M, act_dim), in [-1, 1]
        :param windows: of ``window_length`` steps, to scale the moves of ``config.relative_states`` by; left out, moves
            keep the states' own scale
        :raises ValueError: for a wrong shape, no rows, or numbers that are not finite
        """
        states, actions = self._tensor(states), self._tensor(actions)
        check_finite("states", states, (None, self.obs_dim))
        check_finite("actions", actions, (len(states), self.act_dim))
        self.normalizer.fit(states, actions)
        if windows is not None:
            self.normalizer.fit_moves(windows.to(self.device))

    def loss(
        self,
        windows: Windows,
        delay: th.Tensor | None = None,
        weight: th.Tensor | None = None,
        generator: th.Generator | None = None,
    ) -> th.Tensor:
        """Return the weighted mean squared error over unknown entries of valid steps (the paper's Algorithm 1).

        The decision index counts ``config.decision_weight`` times as much as the others. Of a window of delay d only
        the first d + ``config.horizon`` steps exist. Which states are known beside the first is drawn as
        ``config.extra_state_probability`` says.

        :param windows: B windows of ``window_length`` steps, environment units
        :param delay: (B,) mask lengths; drawn as ``config.mask`` says by default
        :param weight: (B,) factor of each window's error; 1 by default
        :param generator: of mask lengths, known states, noise and times; torch's global one by default
        :return: float32 scalar
        :raises ValueError: for windows of another shape or delays outside 0..max_delay (on a GPU, delays are not read)
        """
        config, device = self.config, self.device
        states, actions = self._tensor(windows.states), self._tensor(windows.actions)
        check_shape("windows.states", states, (None, self.window_length, self.obs_dim))
        n = len(states)
        check_shape("windows.actions", actions, (n, self.window_length, self.act_dim))
        if weight is not None:
            check_shape("weight", weight := self._tensor(weight), (n,))
        if delay is None:
            delay = inpainting.draw_delays(n, self.max_delay, config.mask, config.mask_end_probability, generator)
        # Delays on a GPU are not read back: every update would wait for it, and a recorded one could not
        delay = checked_delay(delay, n, self.max_delay).to(self.device) if delay.device.type == "cpu" else delay
        valid = windows.valid.to(device) & self._within(delay, self.window_length)  # (B, L)
        clean = self.normalizer.normalize(states, actions)  # (B, L, obs_dim + act_dim)
        # Steps behind an episode's end repeat its last row: they are neither shown as known nor learned, and no more
        # are those behind the horizon, so that a decision at a small delay can do without them
        state_known = None
        if config.extra_state_probability > 0:
            state_known = inpainting.draw_known_states(n, self.max_delay, config.extra_state_probability, generator)
            state_known = state_known.to(device)
        known = inpainting.known_mask(delay, self.window_length, self.obs_dim, self.act_dim, state_known)
        known = known & valid[..., None]
        noise = self._noise(clean.shape, generator)
        t = diffusion.draw_times(n, config.schedule, config.time_sampling, config.end_time_probability, generator)
        t = t.to(device)
        alpha, sigma = (factor[:, None, None] for factor in diffusion.alpha_sigma(t, config.schedule))
        x = th.where(known, clean, alpha * clean + sigma * noise)
        network = self.network
        with autocast(config.precision, device):
            output = network(x, network.context(clean, known), network.modulations(t), valid)
        target = diffusion.prediction_target(clean, noise, alpha, sigma, config.prediction)
        learned = valid[..., None] & ~known
        decision = th.arange(self.window_length, device=device) == delay[:, None]  # (B, L)
        share = th.where(decision[..., None], config.decision_weight, 1.0) * learned  # (B, L, obs_dim + act_dim)
        error = th.where(learned, (output.float() - target) ** 2, 0.0) * share
        if weight is not None:
            error = error * weight[:, None, None]
        return error.sum() / share.sum().clamp(min=1)

    @th.no_grad()
    def plan(
        self,
        observation: th.Tensor,
        action_history: th.Tensor,
        delay: th.Tensor,
        value_fn: ValueFn | None = None,
        n_candidates: int | None = None,
        sampling_steps: int | None = None,
        temperature: float | None = None,
        noise: th.Tensor | None = None,
        generator: th.Generator | None = None,
        state_history: th.Tensor | None = None,
        state_known: th.Tensor | None = None,
    ) -> Plan:
        """Inpaint N candidate windows per decision and choose the one of the highest mean value (MCSS).

        With ``config.choice_factor`` the decision is the candidates' mean instead, weighed by their values.

        The arguments that default to ``None`` take the config's value. One candidate is enough, and drawn, where the
        others could not matter: at temperature 0, where all are alike, and by default without a ``value_fn``.

        On a GPU a decision becomes one recorded graph after a few calls with these sizes and settings, if the
        ``value_fn`` is a module or a method of one, which must then never wait for the device. Any other ``value_fn``
        may read what a graph would not see change: its plans are made operation by operation.

        A planner with ``mask="fixed"`` has known ``max_delay`` actions in every window. At an episode's start, s_0
        stands for s_{t-D} and zeros for the actions before it (paper, Appendix B).

        :param observation: (B, obs_dim) delayed observations s_{t-d}
        :param action_history: (B, D, act_dim), the D newest actions, oldest first
        :param delay: (B,) integers d in 0..D, not necessarily alike
        :param value_fn: maps states (B, N, K, obs_dim) and actions (B, N, K, act_dim), environment units, to values
            (B, N, K); without it all values are 0 and the first candidate is taken
        :param n_candidates: N
        :param sampling_steps: denoising steps
        :param temperature: factor on the initial noise
        :param noise: (N, ``window_length``, obs_dim + act_dim) standard normal initial noise, shared by all decisions,
            to repeat a plan
        :param generator: of the initial noise where none is given; torch's global one by default
        :param state_history: (B, D, obs_dim), the states s_{t-D+1..t}, oldest first, any finite numbers where they are
            not known. Those younger than s_{t-d} stay as they are in every candidate; older ones add nothing (Markov
            property) and are not read. Needs ``config.extra_state_probability`` above 0
        :param state_known: (B, D), 1 where a state of ``state_history`` is known and 0 elsewhere; none is by default
        :raises ValueError: for wrong shapes, numbers that are not finite, delays outside 0..max_delay, or extra states
            that the network was not trained with
        """
        config = self.config
        observation, action_history = self._tensor(observation), self._tensor(action_history)
        check_finite("observation", observation, (None, self.obs_dim))
        n = len(observation)
        check_finite("action_history", action_history, (n, self.max_delay, self.act_dim))
        delay = self._trained_delay(checked_delay(delay, n, self.max_delay).to(self.device), action_history)
        extra_states = self._extra_states(state_history, state_known, n)
        shortest, longest = int(delay.min()), int(delay.max())
        length = longest + config.horizon  # a decision costs what its age costs
        temperature = config.temperature if temperature is None else temperature
        shape = (length, self.obs_dim + self.act_dim)
        if noise is not None:
            noise = self._tensor(noise)
            check_finite("noise", noise, (n_candidates, self.window_length, shape[1]))
            n_candidates, noise = len(noise), noise[:, :length]
        elif n_candidates is None:
            n_candidates = 1 if value_fn is None else config.n_candidates
        if n_candidates < 1 or not temperature >= 0:
            raise ValueError(
                f"n_candidates is {n_candidates} and temperature {temperature}, expected at least 1 and at least 0."
            )
        n_steps = config.sampling_steps if sampling_steps is None else sampling_steps
        steps = diffusion.solver_steps(config.schedule, n_steps)

        if temperature == 0:
            x = th.zeros(n, 1, *shape, device=self.device)
        else:
            noise = self._noise((n, n_candidates, *shape), generator) if noise is None else noise
            x = temperature * noise.expand(n, -1, -1, -1)  # (B, N, L, obs_dim + act_dim)
        times = th.tensor([step.t for step in steps], device=self.device)
        inputs = (times, observation, action_history, delay, x, *extra_states)
        if self._can_be_recorded(value_fn):
            plan = Plan(*self._graph(steps, value_fn, x.shape)(*inputs))
        else:
            plan = self._inpaint(steps, value_fn, shortest, longest > shortest, *inputs)
        if plan.values.isnan().any():
            raise ValueError("value_fn returned NaN, so that no candidate is the best; check the critic.")
        return plan

    def _can_be_recorded(self, value_fn: ValueFn | None) -> bool:
        return self.device.type == "cuda" and (value_fn is None or isinstance(_owner(value_fn), nn.Module))

    def _graph(
        self, steps: Sequence[diffusion.SolverStep], value_fn: ValueFn | None, shape: th.Size
    ) -> RecordedFunction:
        """Return the graph of decisions with these settings and sizes, and with the weights where they now lie."""
        modules: list[Any] = [self] if value_fn is None else [self, _owner(value_fn)]
        tensors = [tensor for module in modules for tensor in (*module.parameters(), *module.buffers())]
        key = (self.config, steps, value_fn, shape, tuple(tensor.data_ptr() for tensor in tensors))
        if key not in self._graphs:
            if len(self._graphs) == MAX_GRAPHS:
                del self._graphs[next(iter(self._graphs))]  # the oldest
            self._graphs[key] = RecordedFunction(partial(self._inpaint, steps, value_fn, 0, True), self.device)
        return self._graphs[key]

    def _inpaint(
        self,
        steps: Sequence[diffusion.SolverStep],
        value_fn: ValueFn | None,
        shortest: int,
        is_mixed: bool,
        times: th.Tensor,
        observation: th.Tensor,
        action_history: th.Tensor,
        delay: th.Tensor,
        x: th.Tensor,
        state_history: th.Tensor | None = None,
        state_known: th.Tensor | None = None,
    ) -> Plan:
        """Go from what is known and initial noise to the decision, without waiting for the device on the way.

        :param shortest: a lower bound of the delays: no state before it is scored
        :param is_mixed: whether delays may differ, so that some windows end before others
        :param times: (n_steps,) of the steps
        :param x: (B, N, L, obs_dim + act_dim) initial noise, scaled
        :param state_history: (B, D, obs_dim), and which of it is known: ``state_known``, (B, D) bool
        """
        length = x.shape[2]
        given = inpainting.known_window(observation, action_history, delay, length, state_history)
        known = inpainting.known_mask(delay, length, self.obs_dim, self.act_dim, state_known)
        clean = self.normalizer.normalize(*self._split(given))  # (B, L, obs_dim + act_dim), as given and known
        valid = self._within(delay, length).repeat_interleave(x.shape[1], 0) if is_mixed else None  # (B * N, L)
        network = self.network
        modulations = network.modulations(times)  # (n_steps, 6 * depth + 2, d_model)
        context = network.context(clean, known)
        # Of the largest age, so that decisions at all ages have one number format
        size = x.shape[0] * x.shape[1] * self.window_length * self.config.d_model
        with autocast(self.config.precision, x.device, size):
            x = diffusion.solve(
                lambda x, i: network(x.flatten(0, 1), context, modulations[i], valid).float().view_as(x),
                x,
                steps,
                self.config.prediction,
                impose=lambda x: th.where(known[:, None], clean[:, None], x),
            )
        # What is given comes back exactly as given, without the rounding of the normaliser
        x = th.where(known[:, None], given[:, None], th.cat(self.normalizer.denormalize(x), dim=-1))
        states, actions = self._split(x)
        rows = th.arange(len(x), device=x.device)
        present = states[rows, :, delay].mean(1)  # (B, obs_dim)
        decisions = actions[rows, :, delay]  # (B, N, act_dim)
        if value_fn is None:
            values = th.zeros(x.shape[:2], device=x.device)
        elif self.config.scored_states == "decision":
            shared = present[:, None].expand(-1, x.shape[1], -1)  # (B, N, obs_dim)
            values = value_of(value_fn, shared[:, :, None], decisions[:, :, None])[..., 0]
        else:
            first = th.ones_like(delay) if self.config.scored_states == "all" else delay + 1  # (B,)
            skipped = 1 if self.config.scored_states == "all" else shortest + 1
            end = delay + self.config.horizon
            values = mean_value(value_fn, states, actions, first, end, skipped)
        return Plan(choose(decisions, values, self.config.choice_factor), present, states, actions, values)

    def _within(self, delay: th.Tensor, length: int) -> th.Tensor:
        """Tell which steps a window of each delay has, d + horizon of them: (B, L) bool."""
        return th.arange(length, device=delay.device) < delay[:, None] + self.config.horizon

    def _split(self, x: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        states, actions = x.split([self.obs_dim, self.act_dim], dim=-1)
        return states, actions

    def _noise(self, shape: tuple[int, ...], generator: th.Generator | None) -> th.Tensor:
        source = self.device if generator is None else generator.device
        return th.randn(shape, generator=generator, device=source).to(self.device)

    def _tensor(self, values: th.Tensor) -> th.Tensor:
        return th.as_tensor(values, dtype=th.float32, device=self.device)

    def _trained_delay(self, delay: th.Tensor, action_history: th.Tensor) -> th.Tensor:
        """Return the delays to plan with: (B,) int64; with ``mask="fixed"`` D, at the start of an episode too.

        :raises ValueError: for a younger observation amid an episode, which that mask was not trained for
        """
        if self.config.mask == "random":
            return delay
        older = th.arange(self.max_delay, device=delay.device) < self.max_delay - delay[:, None]  # (B, D)
        amid = (action_history.ne(0).any(-1) & older).any(1)  # (B,): acted on longer ago than the observation is old
        self.check_ages(delay[amid].tolist())
        return th.full_like(delay, self.max_delay)

    def _extra_states(
        self, state_history: th.Tensor | None, state_known: th.Tensor | None, batch_size: int
    ) -> tuple[th.Tensor, ...]:
        """Return checked extra states, (B, D, obs_dim) and (B, D) bool, or nothing if the config has none."""
        if (state_history is None) != (state_known is None):
            raise ValueError("Only one of state_history and state_known is given; give both or neither.")
        if self.config.extra_state_probability == 0:
            if state_history is not None:
                raise ValueError(
                    "This planner is not trained with extra known states; build and train it with "
                    "PlannerConfig(extra_state_probability=0.5), or leave state_history and state_known out."
                )
            return ()
        shape = (batch_size, self.max_delay)
        if state_history is None or state_known is None:  # zeros, so that a recorded graph always has these inputs
            state_history, state_known = th.zeros(*shape, self.obs_dim), th.zeros(shape)
        state_history, state_known = self._tensor(state_history), self._tensor(state_known)
        check_finite("state_history", state_history, (*shape, self.obs_dim))
        check_finite("state_known", state_known, shape)
        if not ((state_known == 0) | (state_known == 1)).all():
            raise ValueError("state_known has entries other than 0 and 1, expected 1 where a state is known.")
        return state_history, state_known.bool()


def _owner(value_fn: ValueFn) -> object:
    """Return the object whose method a function is, or the function."""
    return getattr(value_fn, "__self__", value_fn)
