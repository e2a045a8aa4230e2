"""The inpainting planner: finds the present and a plan from a delayed observation and the actions sent since."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch as th
from torch import nn

from sb3_said.planner import diffusion, inpainting
from sb3_said.planner.checks import checked_delay, checked_extra_states, finite_tensor, float_tensor
from sb3_said.planner.config import PlannerConfig
from sb3_said.planner.dit import DiT1d
from sb3_said.planner.first_guess import FirstGuess
from sb3_said.planner.graphs import Recording
from sb3_said.planner.normalizer import Normalizer
from sb3_said.planner.precision import autocast
from sb3_said.planner.prior import Prior
from sb3_said.planner.selection import ValueFn, choose, score
from sb3_said.replay.windows import Windows

MAX_GRAPHS = 8  # of one planner; each keeps the GPU memory of one decision


class Plan(NamedTuple):
    """Candidate plans for B decisions, in environment units."""

    action: th.Tensor  # (B, act_dim), in [-1, 1], at the decision index: the best candidate's, or the weighed mean
    present: th.Tensor  # (B, obs_dim): s_t, the mean of the candidates', or the first guess's
    states: th.Tensor  # (B, N, L, obs_dim), L the largest delay of the decisions plus the horizon
    actions: th.Tensor  # (B, N, L, act_dim), in [-1, 1]
    values: th.Tensor  # (B, N), scores by which the candidates were chosen or weighed


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
        self.sizes = [obs_dim, act_dim]
        self.window_length = max_delay + config.horizon
        self.network = DiT1d(
            obs_dim,
            act_dim,
            max_delay,
            self.window_length,
            d_model=config.d_model,
            depth=config.depth,
            embed_known=config.embed_known,
            extra_states=config.extra_state_probability > 0,
            first_guess=config.first_guess == "prior",
        )
        self.first_guess = self.prior = None
        if config.first_guess == "prior":
            self.first_guess = FirstGuess(obs_dim, act_dim)
            self.prior = Prior(max_delay, self.window_length, obs_dim + act_dim)
        self.normalizer = Normalizer(
            obs_dim, act_dim, self.window_length, config.action_transform, config.relative_states
        )
        self._graphs: dict[Hashable, Recording] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_graphs": {}}  # a copy records its own graphs

    @property
    def device(self) -> th.device:
        """Where the planner lives."""
        return self.normalizer.state_mean.device

    def check_ages(self, ages: Sequence[int]) -> None:
        """Refuse ages amid an episode, in control steps, that the network was not trained for.

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
        """Fit the z-scores of states and (transformed) actions.

        :param states: (M, obs_dim), environment units
        :param actions: (M, act_dim), in [-1, 1]
        :param windows: of ``window_length`` steps; with ``config.relative_states`` they give moves their scale, which
            is else that of the states
        :raises ValueError: for a wrong shape, no rows, or numbers that are not finite
        """
        states = finite_tensor("states", states, (None, self.obs_dim), self.device)
        actions = finite_tensor("actions", actions, (len(states), self.act_dim), self.device)
        self.normalizer.fit(states, actions)
        if windows is not None:
            self.normalizer.fit_moves(windows.to(self.device))

    def fit_prior(self, windows: Windows) -> None:
        """Learn how far a trained first guess is right, for ``config.first_guess="prior"``.

        :param windows: of ``window_length`` steps
        """
        assert self.prior is not None and self.first_guess is not None
        states, actions, valid, _ = windows.to(self.device)
        clean, length = self.normalizer.normalize(states, actions), self.window_length
        z, known = self.normalizer.normalize_states(states), th.zeros_like(valid)  # none but the first, (M, L)
        rolled = self.first_guess.roll_out(z, actions, known, self.max_delay)  # for all delays: each uses a part
        for d in range(self.max_delay + 1):
            delay = th.full((len(states),), d, device=self.device)
            guess = self.first_guess.windows(rolled, delay, length)
            self.prior.fit(d, self._normalized_guess(guess), clean, valid & self._within(delay, length))

    def loss(
        self,
        windows: Windows,
        delay: th.Tensor | None = None,
        weight: th.Tensor | None = None,
        generator: th.Generator | None = None,
    ) -> th.Tensor:
        """Return the weighted mean squared error over unknown entries of valid steps (paper, Appendix B.4).

        The decision index counts ``config.decision_weight`` times as much as the others. A window of delay d has
        d + ``config.horizon`` steps; the rest is ignored, and with ``mask="none"`` not computed.

        :param windows: B windows of ``window_length`` steps, environment units
        :param delay: (B,) mask lengths; drawn as ``config.mask`` says by default, and zeros with ``mask="none"``
        :param weight: (B,) factor of each window's error; 1 by default
        :param generator: of mask lengths, known states, noise and times; torch's global one by default
        :return: float32 scalar
        :raises ValueError: for windows of another shape, or delays outside 0..max_delay (unchecked if on a GPU)
        """
        config, device, length = self.config, self.device, self.window_length
        states = float_tensor("windows.states", windows.states, (None, length, self.obs_dim), device)
        n = len(states)
        actions = float_tensor("windows.actions", windows.actions, (n, length, self.act_dim), device)
        if config.mask == "none":
            length = config.horizon
            states, actions = states[:, :length], actions[:, :length]
        if weight is not None:
            weight = float_tensor("weight", weight, (n,), device)
        if delay is None:
            delay = inpainting.draw_delays(n, self.max_delay, config.mask, config.mask_end_probability, generator)
        # Delays on a GPU are not checked: every update would wait for it, which a recorded one cannot
        delay = checked_delay(delay, n, self.max_delay).to(device) if delay.device.type == "cpu" else delay
        valid = windows.valid[:, :length].to(device) & self._within(delay, length)  # (B, L)
        clean = self.normalizer.normalize(states, actions)  # (B, L, obs_dim + act_dim)
        # Steps that are not valid are neither shown nor learned: those after an episode's end repeat its last row,
        # and those after the horizon of a small delay do not exist at run time
        state_known = None
        if config.extra_state_probability > 0:
            state_known = inpainting.draw_known_states(n, self.max_delay, config.extra_state_probability, generator)
            state_known = state_known.to(device)
        known = inpainting.known_mask(delay, length, self.obs_dim, self.act_dim, state_known) & valid[..., None]
        guess = self._guess(states, actions, delay, known)
        noise = self._noise(clean.shape, generator)
        t = diffusion.draw_times(n, config.schedule, config.time_sampling, config.end_time_probability, generator)
        t = t.to(device)
        alpha, sigma = (factor[:, None, None] for factor in diffusion.alpha_sigma(t, config.schedule))
        x = th.where(known, clean, alpha * clean + sigma * noise)
        with autocast(config.precision, device):
            output = self.network(x, self.network.context(clean, known, guess), self.network.modulations(t), valid)
        output = self._prediction(output.float(), x, self._prior_of(guess, delay), alpha, sigma)
        target = diffusion.prediction_target(clean, noise, alpha, sigma, config.prediction)
        learned = valid[..., None] & ~known
        decision = th.arange(length, device=device) == delay[:, None]  # (B, L)
        share = th.where(decision[..., None], config.decision_weight, 1.0) * learned  # (B, L, obs_dim + act_dim)
        error = th.where(learned, (output - target) ** 2, 0.0) * share
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

        With ``config.choice_factor`` the decision is the candidates' mean instead, weighed by their values. At
        temperature 0, where all candidates are alike, and by default without a ``value_fn``, only one is drawn.

        On a GPU the decision is recorded as one graph, after a few calls with the same sizes and settings. For this the
        ``value_fn`` must be a module or a method of one, and never wait for the device. With any other ``value_fn``
        nothing is recorded, since a graph would not see it change.

        With ``mask="fixed"`` every window has ``max_delay`` known actions. At an episode's start, s_0 stands for
        s_{t-D} (paper, Appendix B.1) and zeros for the actions before it (section 4.4).

        :param observation: (B, obs_dim) delayed observations s_{t-d}
        :param action_history: (B, D, act_dim), the D newest actions, oldest first
        :param delay: (B,) integers d in 0..D, not necessarily alike
        :param value_fn: maps states (B, N, K, obs_dim) and actions (B, N, K, act_dim), environment units, to values
            (B, N, K); without it all values are 0 and the first candidate is taken
        :param n_candidates: N; this and the next two by default as in the config
        :param sampling_steps: denoising steps
        :param temperature: factor on the initial noise
        :param noise: (N, ``window_length``, obs_dim + act_dim) standard normal initial noise, shared by all decisions,
            to repeat a plan; or one for each decision, (B, N, ``window_length``, obs_dim + act_dim)
        :param generator: of the initial noise where none is given; torch's global one by default
        :param state_history: (B, D, obs_dim), the states s_{t-D+1..t}, oldest first, any finite numbers where they are
            not known. Every candidate keeps those younger than s_{t-d}; older ones add nothing (Markov property) and
            are not read. Needs ``config.extra_state_probability`` above 0
        :param state_known: (B, D), 1 where a state of ``state_history`` is known and 0 elsewhere; none is by default
        :raises ValueError: for wrong shapes, numbers that are not finite, delays outside 0..max_delay, or extra states
            that the network was not trained with
        """
        config, device = self.config, self.device
        observation, action_history, delay = self._checked(observation, action_history, delay)
        n, delay = len(observation), self._trained_delay(delay, action_history)
        extra_states = self._extra_states(n, state_history, state_known)
        shortest, longest = int(delay.min()), int(delay.max())
        is_recorded = self._can_be_recorded(value_fn)
        # Shorter windows save time at smaller ages. On a GPU they save hardly any, and one graph serves all ages
        length = self.window_length if is_recorded else longest + config.horizon
        temperature = config.temperature if temperature is None else temperature
        window = (length, self.obs_dim + self.act_dim)
        if noise is not None:
            batch = (n,) if noise.ndim == 4 else ()
            noise = finite_tensor("noise", noise, (*batch, n_candidates, self.window_length, window[1]), device)
            n_candidates, noise = noise.shape[-3], noise[..., :length, :]
        elif n_candidates is None:
            n_candidates = 1 if value_fn is None else config.n_candidates
        if n_candidates < 1 or not 0 <= temperature < math.inf:
            raise ValueError(
                f"n_candidates is {n_candidates} and temperature {temperature}, expected at least 1, and finite and at "
                "least 0."
            )
        n_steps = config.sampling_steps if sampling_steps is None else sampling_steps
        steps = diffusion.solver_steps(config.schedule, n_steps)

        if temperature == 0:
            x = th.zeros(n, 1, *window, dtype=th.float32, device=device)
        else:
            noise = self._noise((n, n_candidates, *window), generator) if noise is None else noise
            x = temperature * noise.expand(n, n_candidates, *window)  # (B, N, L, obs_dim + act_dim)
        times = th.tensor([step.t for step in steps], dtype=th.float32, device=device)
        inputs = (times, observation, action_history, delay, x, *extra_states)
        if is_recorded:
            function = partial(self._inpaint, steps, value_fn, 0, True)
            plan = Plan(*self._graph(steps, value_fn, x.shape)(function, *inputs))
            reached = longest + config.horizon
            plan = plan._replace(states=plan.states[:, :, :reached], actions=plan.actions[:, :, :reached])
        else:
            plan = self._inpaint(steps, value_fn, shortest, longest > shortest, *inputs)
        if ~plan.values.amax(1).isfinite().all() | ~plan.action.isfinite().all():  # amax keeps a NaN
            found = "The planner's candidates are not finite; check its weights"
            if plan.actions.isfinite().all() and plan.states.isfinite().all():
                found = "value_fn returned NaN or infinity, or -inf for all, so that no candidate is the best; check it"
            raise ValueError(f"{found}, and the observations, the largest of which is {observation.abs().max():.3g}.")
        return plan

    @th.no_grad()
    def guess(
        self,
        observation: th.Tensor,
        action_history: th.Tensor,
        delay: th.Tensor,
        state_history: th.Tensor | None = None,
        state_known: th.Tensor | None = None,
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return what the first guess says by itself: the present (B, obs_dim), and an action (B, act_dim) in [-1, 1].

        :param observation: (B, obs_dim); this and the next four as of :meth:`plan`
        :param action_history: (B, D, act_dim)
        :param delay: (B,)
        :param state_history: (B, D, obs_dim)
        :param state_known: (B, D)
        :raises ValueError: as :meth:`plan`, and for a planner without a first guess
        """
        if self.first_guess is None:
            raise ValueError("This planner has no first guess; build it with another first_guess than 'none'.")
        observation, action_history, delay = self._checked(observation, action_history, delay)
        length = int(delay.max()) + self.config.horizon
        history, is_known = self._extra_states(len(delay), state_history, state_known) or (None, None)
        given = inpainting.known_window(observation, action_history, delay, length, history)
        known = inpainting.known_mask(delay, length, self.obs_dim, self.act_dim, is_known)
        states, actions = self._guess_window(given, known, delay)
        rows = th.arange(len(delay), device=self.device)
        return states[rows, delay], actions[rows, delay]

    def _checked(
        self, observation: th.Tensor, action_history: th.Tensor, delay: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return what :meth:`plan` and :meth:`guess` are given, on the planner's device.

        :raises ValueError: for wrong shapes, numbers that are not finite, or delays outside 0..max_delay
        """
        observation = finite_tensor("observation", observation, (None, self.obs_dim), self.device)
        n = len(observation)
        action_history = finite_tensor("action_history", action_history, (n, self.max_delay, self.act_dim), self.device)
        return observation, action_history, checked_delay(delay, n, self.max_delay).to(self.device)

    def _extra_states(
        self, n: int, state_history: th.Tensor | None, state_known: th.Tensor | None
    ) -> tuple[()] | tuple[th.Tensor, th.Tensor]:
        """Return the extra states of n decisions, and which are known; nothing for a planner without extra states.

        :return: (n, D, obs_dim) and (n, D) bool
        :raises ValueError: for wrong shapes, and for extra states that the network was not trained with
        """
        if self.config.extra_state_probability > 0:
            shape = (n, self.max_delay, self.obs_dim)
            return checked_extra_states(state_history, state_known, shape, self.device)
        if state_history is not None or state_known is not None:
            raise ValueError(
                "This planner is not trained with extra known states; build and train it with "
                "PlannerConfig(extra_state_probability=0.5), or leave state_history and state_known out."
            )
        return ()

    def _can_be_recorded(self, value_fn: ValueFn | None) -> bool:
        return self.device.type == "cuda" and (value_fn is None or isinstance(_owner(value_fn), nn.Module))

    def _graph(self, steps: Sequence[diffusion.SolverStep], value_fn: ValueFn | None, shape: th.Size) -> Recording:
        """Return the graph of decisions with these settings and sizes, and with the weights where they now lie."""
        modules: list[Any] = [self] if value_fn is None else [self, _owner(value_fn)]
        tensors = [tensor for module in modules for tensor in (*module.parameters(), *module.buffers())]
        key = (self.config, steps, value_fn, shape, tuple(tensor.data_ptr() for tensor in tensors))
        if key not in self._graphs:
            if len(self._graphs) == MAX_GRAPHS:
                del self._graphs[next(iter(self._graphs))]  # the oldest
            self._graphs[key] = Recording(self.device)
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
        """Make the decision from what is known and initial noise, without waiting for the device.

        :param shortest: a lower bound of the delays
        :param is_mixed: whether delays may differ, so that some windows end before others
        :param times: (n_steps,), the steps' diffusion times
        :param x: (B, N, L, obs_dim + act_dim) initial noise, scaled
        :param state_history: (B, D, obs_dim)
        :param state_known: (B, D) bool
        """
        length, is_old = x.shape[2], x.shape[2] > self.config.horizon
        given = inpainting.known_window(observation, action_history, delay, length, state_history)
        known = inpainting.known_mask(delay, length, self.obs_dim, self.act_dim, state_known)
        if self.config.present == "guessed" and is_old:
            return self._plan_from_guess(steps, value_fn, times, given, known, action_history, delay, x)
        clean = self.normalizer.normalize(*given.split(self.sizes, dim=-1))  # (B, L, obs_dim + act_dim)
        valid = self._within(delay, length).repeat_interleave(x.shape[1], 0) if is_mixed else None  # (B * N, L)
        network = self.network
        modulations = network.modulations(times)  # (n_steps, 6 * depth + 2, d_model)
        guess = self._guess(given[..., : self.obs_dim], given[..., self.obs_dim :], delay, known)
        context = network.context(clean, known, guess)
        expected = self._prior_of(guess, delay)
        if expected is not None:
            expected = expected[0][:, None], expected[1][:, None]  # (B, 1, L, obs_dim + act_dim)

        def predict(x: th.Tensor, i: int) -> th.Tensor:
            output = network(x.flatten(0, 1), context, modulations[i], valid).float().view_as(x)
            return self._prediction(output, x, expected, steps[i].alpha, steps[i].sigma)

        def impose(x: th.Tensor) -> th.Tensor:
            return th.where(known[:, None], clean[:, None], x)

        # The size at the largest age, so that decisions at all ages have one number format
        size = x.shape[0] * x.shape[1] * self.window_length * self.config.d_model
        with autocast(self.config.precision, x.device, size):
            x = diffusion.solve(predict, x, steps, self.config.prediction, impose)
        # Known entries come back as given, without the normaliser's rounding
        x = th.where(known[:, None], given[:, None], th.cat(self.normalizer.denormalize(x), dim=-1))
        states, actions = x.split(self.sizes, dim=-1)
        rows = th.arange(len(x), device=x.device)
        present = states[rows, :, delay].mean(1)  # (B, obs_dim)
        if value_fn is None:
            values = x.new_zeros(x.shape[:2])
        else:
            values = score(value_fn, self.config, states, actions, delay, shortest)
        action = choose(actions[rows, :, delay], values, self.config.choice_factor)
        return Plan(action, present, states, actions, values)

    def _plan_from_guess(
        self,
        steps: Sequence[diffusion.SolverStep],
        value_fn: ValueFn | None,
        times: th.Tensor,
        given: th.Tensor,
        known: th.Tensor,
        action_history: th.Tensor,
        delay: th.Tensor,
        x: th.Tensor,
    ) -> Plan:
        """Plan from the guessed present as from an observation of age 0, and put the guessed past before the plan.

        The arguments are those of :meth:`_inpaint`, with its ``given`` and ``known`` in place of what they are made of.
        """
        states, actions = self._guess_window(given, known, delay)[0], given[..., self.obs_dim :]
        rows, now = th.arange(len(x), device=x.device), th.zeros_like(delay)
        ahead = x[:, :, : self.config.horizon]
        plan = self._inpaint(steps, value_fn, 0, False, times, states[rows, delay], action_history, now, ahead)
        step = th.arange(x.shape[2], device=x.device) - delay[:, None]  # (B, L), since the present
        index = step.clamp(0, self.config.horizon - 1)[:, None, :, None].expand(*x.shape[:3], -1)
        is_past = (step < 0)[:, None, :, None]
        states, actions = (
            th.where(is_past, past[:, None], part.gather(2, index.expand(-1, -1, -1, part.shape[-1])))
            for past, part in ((states, plan.states), (actions, plan.actions))
        )
        return Plan(plan.action, plan.present, states, actions, plan.values)

    def _guess_window(self, given: th.Tensor, known: th.Tensor, delay: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the first guess in environment units: states (B, L, obs_dim), known ones as given, and actions.

        :param given: (B, L, obs_dim + act_dim)
        :param known: (B, L, obs_dim + act_dim) bool
        """
        states, actions = given.split(self.sizes, dim=-1)
        guess = self._guess(states, actions, delay, known)
        assert guess is not None  # for mypy: the callers have seen to it
        z, actions = guess.split(self.sizes, dim=-1)
        return th.where(known[..., :1], states, self.normalizer.denormalize_states(z)), actions

    def _guess(self, states: th.Tensor, actions: th.Tensor, delay: th.Tensor, known: th.Tensor) -> th.Tensor | None:
        """Return the first guess: (B, L, obs_dim + act_dim), states z-scored, actions as they are; None without one."""
        if self.first_guess is None:
            return None
        z = self.normalizer.normalize_states(states)
        return self.first_guess(z, actions, delay, known[..., 0], longest=z.shape[1] - self.config.horizon)

    def _normalized_guess(self, guess: th.Tensor) -> th.Tensor:
        """Return a guess of :meth:`_guess` in the planner's units: (B, L, obs_dim + act_dim)."""
        z, actions = guess.split(self.sizes, dim=-1)
        return self.normalizer.normalize(self.normalizer.denormalize_states(z), actions)

    def _prior_of(self, guess: th.Tensor | None, delay: th.Tensor) -> tuple[th.Tensor, th.Tensor] | None:
        """Return the prior's mean and standard deviation of each entry, (B, L, obs_dim + act_dim), if there is one."""
        return None if self.prior is None or guess is None else self.prior(self._normalized_guess(guess), delay)

    def _prediction(
        self,
        output: th.Tensor,
        x: th.Tensor,
        expected: tuple[th.Tensor, th.Tensor] | None,
        alpha: float | th.Tensor,
        sigma: float | th.Tensor,
    ) -> th.Tensor:
        """Return the prediction at noisy windows x: the prior's best one, plus its error as the network sees it."""
        if expected is None:
            return output
        best, off = diffusion.gaussian_prediction(x, *expected, alpha, sigma, prediction=self.config.prediction)
        return best + off * output

    def _within(self, delay: th.Tensor, length: int) -> th.Tensor:
        """Tell which steps a window of each delay has, d + horizon of them: (B, L) bool."""
        return th.arange(length, device=delay.device) < delay[:, None] + self.config.horizon

    def _noise(self, shape: tuple[int, ...], generator: th.Generator | None) -> th.Tensor:
        source = self.device if generator is None else generator.device
        return th.randn(shape, generator=generator, dtype=th.float32, device=source).to(self.device)

    def _trained_delay(self, delay: th.Tensor, action_history: th.Tensor) -> th.Tensor:
        """Return the delays to plan with: (B,) int64; with ``mask="fixed"`` D, at the start of an episode too.

        :raises ValueError: with ``mask="fixed"``, for a younger observation amid an episode
        """
        if self.config.mask != "fixed":
            return delay
        older = th.arange(self.max_delay, device=delay.device) < self.max_delay - delay[:, None]  # (B, D)
        amid = (action_history.ne(0).any(-1) & older).any(1)  # (B,): an action was sent before the observation
        self.check_ages(delay[amid].tolist())
        return th.full_like(delay, self.max_delay)


def _owner(value_fn: ValueFn) -> object:
    """Return the object that a method is bound to; for any other function, itself."""
    return getattr(value_fn, "__self__", value_fn)
