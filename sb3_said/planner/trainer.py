"""Training a planner: gradient steps, averaged weights, and resuming bit for bit."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch as th

from sb3_said.planner.checks import check_same, check_stored
from sb3_said.planner.config import PlannerConfig
from sb3_said.planner.first_guess import GUESS_BATCH_SIZE, fit_first_guess
from sb3_said.planner.graphs import Recording
from sb3_said.planner.held_out import draw_held_out, held_out_errors
from sb3_said.planner.inpainting import draw_delays
from sb3_said.planner.planner import InpaintingPlanner
from sb3_said.planner.values import scaled_values, window_weight
from sb3_said.planner.yardstick import RegressionYardstick
from sb3_said.replay.windows import WindowSource

YARDSTICK_LEARNING_RATE = 1e-3
N_NORMALIZER_WINDOWS = 10_000  # enough for a standard deviation to a percent
N_PRIOR_WINDOWS = 1_000  # each is guessed at every age
# Limits on the updates of a first guess, which come before the planner's: in all, for each of the planner's, and in
# passes over the data, since a clone would otherwise learn few rows by heart (results/make_train.md)
GUESS_UPDATES, GUESS_UPDATES_EACH, GUESS_PASSES = 20_000, 5, 50


def learning_rate(step: int, gradient_steps: int, config: PlannerConfig) -> float:
    """Return the learning rate of update ``step`` = 0, 1, ...: a linear rise, then a cosine down to 0, or no change."""
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    if config.lr_schedule == "constant":
        return config.learning_rate
    progress = (step - config.warmup_steps) / max(1, gradient_steps - config.warmup_steps)
    return config.learning_rate * (0.5 + 0.5 * math.cos(math.pi * min(1.0, progress)))


def ema_decay(step: int, config: PlannerConfig) -> float:
    """Return the decay of the averaged weights after update ``step`` = 0, 1, ...

    With ``ema_warmup`` it rises to its full value: in a short run, a full-length average is mostly initial weights.
    """
    if not config.ema_warmup:
        return config.ema_decay
    return min(config.ema_decay, (1 + step) / (10 + step))


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Draw weights from a seed inside the context; torch's global generator of the CPU stays as it was."""
    with th.random.fork_rng(devices=[]):
        th.default_generator.manual_seed(seed)  # th.manual_seed would seed GPUs, too
        yield


class PlannerTrainer:
    """Train a planner on windows of states and actions.

    Gradient steps move the trainer's own weights (``online``); ``average`` holds their exponential moving average,
    which :meth:`evaluate` measures. Both start anew, whatever the planner has learned before: its weights would not fit
    the normaliser of other data. The given planner answers as before until :meth:`hand_over`, which :meth:`train` calls
    at its end. A small regression learns from the same batches, as the bar for the planner's errors.

    All draws come from the trainer's own generator. On the CPU a resumed run ends bit for bit as if it had never
    stopped; a GPU's sums do not repeat themselves exactly. A GPU holds the data, makes the draws, and runs each update
    from the fourth on as one recorded graph. No update waits for it; losses are read at log times.

    :param planner: takes over the average and a normaliser fitted to the training part of ``source``
    :param source: windows of the true, undelayed states and the actions
    :param gradient_steps: updates of the whole training, over which a cosine learning rate falls to 0
    :param held_out: fraction of the data that is kept for ``evaluate``, see ``WindowSource.split``; 0 for none
    :param seed: of every draw
    :param older: windows of older steps, from which the first guess's model learns, too
    :param guess_steps: steps that this model learns at once in the last part of its training; 1 for no such part
    :raises ValueError: when ``source`` does not fit the planner, or cannot be split
    """

    def __init__(
        self,
        planner: InpaintingPlanner,
        source: WindowSource,
        gradient_steps: int,
        held_out: float = 0.05,
        seed: int = 0,
        older: WindowSource | None = None,
        guess_steps: int = 1,
    ) -> None:
        if (source.obs_dim, source.act_dim) != (planner.obs_dim, planner.act_dim):
            raise ValueError(
                f"The planner expects {planner.obs_dim} observation and {planner.act_dim} action entries, but the "
                f"windows have {source.obs_dim} and {source.act_dim}; build the planner for this data."
            )
        if gradient_steps < 1 or guess_steps < 1 or not 0.0 <= held_out < 1.0:
            raise ValueError(
                "Training needs gradient_steps >= 1, guess_steps >= 1 and held_out in [0, 1), but they are "
                f"{gradient_steps}, {guess_steps} and {held_out}."
            )
        self.planner = planner
        self.config = planner.config
        self.gradient_steps = gradient_steps
        self.n_updates = 0
        self.device = planner.device
        on_gpu = self.device.type == "cuda"
        self.generator = th.Generator(self.device if on_gpu else "cpu").manual_seed(seed)
        self._settings = {
            **planner.config.weight_settings(),
            "gradient_steps": gradient_steps,
            "held_out": held_out,
            "seed": seed,
            "n_windows": len(source),
            "n_older": 0 if older is None else len(older),
        }

        training_source, held_source = source.split(held_out, seed) if held_out > 0 else (source, None)
        values = scaled_values(training_source.values, self.config.value_scale)
        self.source = replace(training_source, values=values).to(self.device)
        self.older = older
        self.guess_steps = guess_steps  # none of the settings above: it is read before the first update alone
        self._has_guess = False
        self._is_own = self.config.mask == "own" and source.ages is not None
        sizes = planner.obs_dim, planner.act_dim, planner.max_delay
        with seeded(seed):  # initial weights are the only draws that take no generator
            self.average = InpaintingPlanner(*sizes, self.config).to(self.device).requires_grad_(False)
            self.yardstick = RegressionYardstick(*sizes).to(self.device)
        windows = self.source.sample(N_NORMALIZER_WINDOWS, planner.window_length, self.generator)
        self.average.fit_normalizer(self.source.start_states(), self.source.start_actions(), windows)
        self.online = copy.deepcopy(self.average).train().requires_grad_(True)
        fused: dict[str, Any] = {"fused": True, "capturable": on_gpu}
        self.optimizer = th.optim.AdamW(
            self.online.network.parameters(),
            lr=self._rate(self.config.learning_rate),
            betas=self.config.betas,
            weight_decay=self.config.weight_decay,
            **fused,
        )
        self.yardstick_optimizer = th.optim.Adam(
            self.yardstick.parameters(), lr=self._rate(YARDSTICK_LEARNING_RATE), **fused
        )
        self._modules = {"average": self.average, "online": self.online, "yardstick": self.yardstick}
        self.optimizers = {"optimizer": self.optimizer, "yardstick_optimizer": self.yardstick_optimizer}
        self._averaged: list[th.Tensor] = list(self.average.network.parameters())
        self._online: list[th.Tensor] = list(self.online.network.parameters())
        # Read at log times only: a read at each update would wait for the GPU each time
        self._loss_sums = th.zeros(2, device=self.device)
        self._n_losses = 0
        self._bad_update = th.full((), -1, device=self.device)
        self._recorded = Recording(self.device, self.generator) if on_gpu else None
        self._held_out = {}
        if held_source is not None:
            self._held_out = draw_held_out(held_source, self.average, seed, self._is_own)

    def step(self) -> None:
        """Make one update.

        :raises FloatingPointError: when an update was not finite (checked every 100 updates)
        """
        self.make_first_guess()
        rate = learning_rate(self.n_updates, self.gradient_steps, self.config)
        yardstick_rate = rate * YARDSTICK_LEARNING_RATE / self.config.learning_rate
        for optimizer, new in ((self.optimizer, rate), (self.yardstick_optimizer, yardstick_rate)):
            (group,) = optimizer.param_groups
            group["lr"] = group["lr"].fill_(new) if isinstance(group["lr"], th.Tensor) else new
        (losses,) = self._descend() if self._recorded is None else self._recorded(self._descend)  # (2,)
        with th.no_grad():  # not recorded: the decay changes from update to update
            th._foreach_lerp_(self._averaged, self._online, 1.0 - ema_decay(self.n_updates, self.config))
            self._loss_sums += losses
            is_first_bad = ~losses[0].isfinite() & (self._bad_update < 0)
            self._bad_update.masked_fill_(is_first_bad, self.n_updates)
        self._n_losses += 1
        self.n_updates += 1
        if self.n_updates % 100 == 0:
            self._check_finite()

    def make_first_guess(self, progress_bar: bool = False, should_stop: Callable[[], bool] | None = None) -> bool:
        """Train the networks of the first guess, which then stay as they are; the first update calls this.

        :param progress_bar: show one
        :param should_stop: asked after every update; once it has ended this, the trainer is of no use any more
        :return: False where ``should_stop`` has ended it, else True
        """
        guess, older, self.older = self.online.first_guess, self.older, None  # older may copy the replay: free it
        if guess is None or self._has_guess:
            return True
        guess.requires_grad_(True)  # it is frozen if load_state_dict has gone back to before the first update
        passes = -(-GUESS_PASSES * len(self.source) // GUESS_BATCH_SIZE)
        n_updates = min(GUESS_UPDATES, GUESS_UPDATES_EACH * self.gradient_steps, passes)
        if not fit_first_guess(
            guess,
            self.source,
            self.average.normalizer,
            self.config,
            n_updates,
            self.generator,
            min(self.guess_steps, self.average.max_delay),
            progress_bar=progress_bar,
            should_stop=should_stop,
            older=None if older is None else older.to(self.device),
        ):
            return False
        self._settle_first_guess()
        return True

    def take_first_guess(self, other: InpaintingPlanner) -> None:
        """Take over the first guess of a trained planner, which has learned from the same data."""
        guess, others = self.online.first_guess, other.first_guess
        if guess is None or others is None or self.n_updates > 0:
            return
        self.older = None
        guess.load_state_dict(others.state_dict())
        self._settle_first_guess()

    def _settle_first_guess(self) -> None:
        """Freeze the first guess, and learn how far it is right."""
        assert self.online.first_guess is not None  # it was just made
        self.online.first_guess.requires_grad_(False)
        if len(self.source) > N_PRIOR_WINDOWS:
            windows = self.source.sample(N_PRIOR_WINDOWS, self.online.window_length, self.generator)
        else:  # each once, so that the prior knows how few there are
            every = th.arange(len(self.source), device=self.source.rows.device)
            windows = self.source.gather(every, self.online.window_length)
        self.online.fit_prior(windows)
        self.average.load_state_dict(self.online.state_dict())
        self._has_guess = True

    def _descend(self) -> tuple[th.Tensor]:
        """Draw a batch, update planner and regression, and return their losses, (2,). Never wait for the device."""
        config = self.config
        for optimizer in self.optimizers.values():
            optimizer.zero_grad()
        drawn = self.average.window_length, self.generator, config.early_probability
        if self._is_own:
            windows, delay = self.source.sample_own(self._draw_delays(config.mask), *drawn)
        else:
            windows, delay = self.source.sample(config.batch_size, *drawn), self._draw_delays(config.mask)  # (B,)
        weight = window_weight(windows.values, config.weight_factor)  # (B,)
        loss = self.online.loss(windows, delay, weight, self.generator)
        loss.backward()
        if config.gradient_clip is not None:
            th.nn.utils.clip_grad_norm_(self._online, config.gradient_clip)
        self.optimizer.step()

        if config.mask == "none":  # the regression has no guess, so it has to meet every age itself
            delay = self._draw_delays("random")
        windows = windows._replace(states=self.average.normalizer.normalize_states(windows.states))
        yardstick_loss = self.yardstick.loss(windows, delay, weight)
        yardstick_loss.backward()
        self.yardstick_optimizer.step()
        return (th.stack((loss, yardstick_loss)).detach(),)

    def _draw_delays(self, mask: str) -> th.Tensor:
        c, max_delay = self.config, self.average.max_delay
        return draw_delays(c.batch_size, max_delay, mask, c.mask_end_probability, self.generator).to(self.device)

    def train(
        self, n_steps: int | None = None, callback: Callable[[PlannerTrainer], bool | None] | None = None
    ) -> None:
        """Make up to ``n_steps`` updates, by default all that are left, and hand the average over.

        :param callback: called with the trainer after every update; training stops when it returns False
        :raises FloatingPointError: when an update was not finite; the planner stays as it was
        """
        n_left = self.gradient_steps - self.n_updates
        for _ in range(n_left if n_steps is None else min(n_steps, n_left)):
            self.step()
            if callback is not None and callback(self) is False:
                break
        self.hand_over()

    def hand_over(self) -> None:
        """Give the planner the averaged weights and their normaliser; before the first update, leave it as it is.

        :raises FloatingPointError: when an update was not finite; the planner stays as it was
        """
        self._check_finite()
        if self.n_updates > 0:
            self.planner.load_state_dict(self.average.state_dict())

    def pop_losses(self) -> dict[str, float]:
        """Return the mean losses since the last call, and the learning rate of the last update."""
        self._check_finite()
        loss, yardstick_loss = (self._loss_sums / max(1, self._n_losses)).tolist()
        self._loss_sums.zero_()
        self._n_losses = 0
        rate = float(self.optimizer.param_groups[0]["lr"])
        return {"planner/loss": loss, "planner/loss_mlp": yardstick_loss, "planner/learning_rate": rate}

    def evaluate(self) -> dict[str, float]:
        """Return the errors of the averaged weights on held-out windows, as of :func:`held_out_errors`.

        :raises FloatingPointError: when an update was not finite
        """
        self._check_finite()
        return held_out_errors(self.average, self.yardstick, self._held_out)

    def state_dict(self) -> dict[str, Any]:
        """Return everything a resumed training needs: nested dicts of numbers, strings, lists and tensors (copies)."""
        self._check_finite()
        return copy.deepcopy(
            {
                "settings": self._settings,
                "n_updates": self.n_updates,
                **{name: dict(module.state_dict()) for name, module in self._modules.items()},
                # No optimizer's groups: they hold nothing but settings
                **{name: optimizer.state_dict()["state"] for name, optimizer in self.optimizers.items()},
                "generator": self.generator.get_state(),
                "loss_sums": self._loss_sums,
                "n_losses": self._n_losses,
            }
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where ``state_dict`` was taken.

        :raises ValueError: when that training had other settings, or its state is not one that a training can have
        """
        advice = "Resume with the settings and data that it began with, or start a new training."
        check_same("The stored training was begun", state["settings"], self._settings, advice)
        check_stored(state)
        for name in ("n_updates", "n_losses"):
            if type(state[name]) is not int or not 0 <= state[name] <= self.gradient_steps:
                raise ValueError(f"The stored training made {state[name]} of {self.gradient_steps} updates ({name}).")
        state = copy.deepcopy(state)
        self.n_updates = state["n_updates"]
        for name, module in self._modules.items():
            module.load_state_dict(state[name])
        prior = self.online.prior
        self._has_guess = self.n_updates > 0 or (prior is not None and prior.is_fitted)
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict({**optimizer.state_dict(), "state": state[name]})
        drawn = state["generator"].cpu()
        if len(drawn) == len(self.generator.get_state()):
            self.generator.set_state(drawn)
        else:  # it is of another kind of device: a new seed, so as not to repeat the first draws
            self.generator.manual_seed(self._settings["seed"] + self.n_updates)
        self._loss_sums.copy_(state["loss_sums"])
        self._n_losses = state["n_losses"]
        self._bad_update.fill_(-1)
        if self._recorded is not None:
            self._recorded.forget()  # it writes to the optimizer state that was replaced

    def _rate(self, rate: float) -> float | th.Tensor:
        """Return a learning rate as the optimizers take it: on a GPU a tensor, so that a recorded update reads it."""
        return th.tensor(rate, device=self.device) if self.device.type == "cuda" else rate

    def _check_finite(self) -> None:
        bad = int(self._bad_update)
        if bad < 0 and not th.nn.utils.get_total_norm(self._averaged).isfinite():
            bad = self.n_updates - 1  # a bad gradient, which no later loss has shown yet
        if bad >= 0:
            raise FloatingPointError(
                f"Update {bad} (of {self.gradient_steps}) of the planner was not finite; the planner stays as it was. "
                "Check the data for infinite values; else lower learning_rate "
                f"({self.config.learning_rate}) or lengthen warmup_steps ({self.config.warmup_steps})."
            )
