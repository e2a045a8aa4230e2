"""Every setting of the planner, with its default and the source of that default."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from sb3_said.planner.checks import check_settings
from sb3_said.planner.diffusion import PREDICTIONS, SCHEDULES, TIME_SAMPLINGS
from sb3_said.planner.dit import HEAD_DIM
from sb3_said.planner.values import VALUE_SCALES

#: Settings that shape a planner's answers and none of its weights.
SAMPLING_SETTINGS = (
    "sampling_steps", "n_candidates", "temperature", "scored_states", "choice_factor", "present", "decided_by"
)  # fmt: skip
#: Settings that change what the weights mean, and not their shapes.
WEIGHT_SETTINGS = ("prediction", "schedule", "mask", "relative_states", "action_transform")
CHOICES: dict[str, tuple[str, ...]] = {
    "first_guess": ("prior", "none"),
    "prediction": PREDICTIONS,
    "schedule": SCHEDULES,
    "time_sampling": TIME_SAMPLINGS,
    "mask": ("random", "own", "fixed", "none"),
    "action_transform": ("standard", "tanh"),
    "scored_states": ("future", "decision", "all"),
    "present": ("inpainted", "guessed"),
    "decided_by": ("plan", "actor"),
    "lr_schedule": ("cosine", "constant"),
    "value_scale": VALUE_SCALES,
    "precision": ("auto", "float32", "bfloat16"),
}
PARTS = ("end_time_probability", "early_probability", "mask_end_probability", "extra_state_probability", "ema_decay")
NOT_NEGATIVE = ("temperature", "choice_factor", "warmup_steps", "weight_decay", "weight_factor", "decision_weight")
AT_LEAST = {"depth": 1, "horizon": 2, "sampling_steps": 1, "n_candidates": 1, "batch_size": 1}
AT_LEAST |= dict.fromkeys((*NOT_NEGATIVE, *PARTS), 0)
#: Parts are at most 1. The other limits lie far beyond what helps: more is a slip, and would cost memory or hours.
AT_MOST = {"depth": 1000, "d_model": 16_384, "horizon": 1000, "sampling_steps": 1000, "n_candidates": 10_000}
AT_MOST |= dict.fromkeys(PARTS, 1)


@dataclass(frozen=True)
class PlannerConfig:
    """Every setting of the planner and of its training; :meth:`paper` gives the paper's.

    "measured" marks what small trials on two CPU cores favoured. "paper" marks what the paper states in text and
    tables, "DV" the public code that it follows where it states nothing (Lu et al. 2025).

    :raises ValueError: for a value outside what its comment allows
    """

    # Architecture
    depth: int = 2  # DV; the paper searches 2, 4, 8, and twice the depth costs twice the time
    d_model: int = 128  # as accurate as the paper's 256 in the same time on two cores; a multiple of 32
    horizon: int = 8  # paper; a window has max_delay + horizon steps; >= 2, so that a state follows the decision
    embed_known: bool = True  # measured: buys as much accuracy as doubling the depth
    # A guess by plain networks: a model of one step gives the states since the observation, a clone gives the action.
    # "prior": the network predicts only what the guess misses, so that a planner begins as good as its guess (measured
    # on logs and on an expert's replay, results/nine_logs.md and results/what_diffusion_buys.md). "none" is the paper's
    first_guess: str = "prior"
    # Diffusion
    prediction: str = "v"  # measured: safe with few steps; or "epsilon" (paper)
    schedule: str = "cosine"  # measured; or "linear" (DV)
    time_sampling: str = "logit_normal"  # measured: lower error of the decoded present; or "uniform" (DV)
    # Part of the training windows at the last diffusion time, where all is noise. Every sampling starts there, and with
    # one step the network is asked nowhere else; "logit_normal" hardly ever draws it. Measured; 0 is DV's; in [0, 1]
    end_time_probability: float = 0.25
    # Part of the training windows that start early in an episode (log-uniform over its steps). A good agent's replay
    # has one start for a thousand steps, and a planner that falls there never gets to the rest. At 0 two of three
    # planners of one replay fell (measured, results/planner_lottery.md). 0 is the paper's; in [0, 1]
    early_probability: float = 0.25
    # Which actions a training window shows. "random": those of a delay drawn from 0..max_delay, so that one network
    # serves all. "own": the same, in windows whose decision was made on an observation of that age, where the data know
    # it. "fixed": those of max_delay (paper). "none": none, so that every window begins at the present and has horizon
    # steps; the first guess leads from an old observation to the present
    mask: str = "random"
    mask_end_probability: float = 0.5  # a guess: the longest mask is the hardest; in [0, 1]
    # Part of the training windows that show more states than the first: any subset of those up to the decision index.
    # Above 0, plan() can be given late observations; 0.5 is a guess. 0 is the paper's; in [0, 1]
    extra_state_probability: float = 0.0
    relative_states: bool = True  # measured: a third off the present's error; or False (paper)
    decision_weight: float = 5.0  # measured: factor on the error at the decision index; 1 (paper) to 5, 20 was worse
    action_transform: str = "standard"  # measured: z-score; or "tanh" (paper): clip to 0.999, arctanh, z-score
    # Sampling
    sampling_steps: int = 5  # of DDIM; 99.6 % of the paper's return with 20
    n_candidates: int = 16  # measured; the paper's 50 cost three times as much
    # Factor on the initial noise, >= 0; at 0 one candidate is drawn and nothing chosen. Measured (results/settings.md):
    # the expert's actor has followed the critics already, and a choice by them led to falls. The paper's are 0.1 to 1
    temperature: float = 0.0
    # What the values score. "decision": the decision alone, at the mean of the candidates' presents, so that actions
    # compete and not beliefs (measured: 2,875 against 2,199 for "future", 8 episodes each); "future": states after the
    # decision index; "all": all states but the first (paper)
    scored_states: str = "decision"
    # None: the candidate of the highest value decides (paper). A number beta >= 0: the candidates' mean decides. Each
    # counts exp(beta * z), z its standardised value; 1 is better at long delays (measured, results/settings.md)
    choice_factor: float | None = None
    # "inpainted" (paper): the present and the plan are one sample. "guessed": the present is the first guess's, and the
    # planner plans from it as if it had been seen. On logs and on an expert's replay that is at least level, on some
    # worth twice as much (measured, results/nine_logs.md): a decision inpainted from an old observation is nearer to
    # the mean of what may be right. None: "guessed" where there is a guess and ``mask`` is "random" or "none"
    present: str | None = None
    # "plan" (paper): the action of the plan at the present. "actor": the action of SAID's expert, which is shown the
    # guessed present as if without delay; then no plan is made
    decided_by: str = "plan"
    # Training
    learning_rate: float = 2e-3  # measured at depth 2, together with the warm-up
    lr_schedule: str = "cosine"  # paper: down to 0; or "constant"
    warmup_steps: int = 200  # measured
    weight_decay: float = 1e-5  # DV
    betas: tuple[float, float] = (0.9, 0.999)  # DV, PyTorch's
    batch_size: int = 128  # DV
    gradient_clip: float | None = 1.0  # usual for transformers at this learning rate; None clips nothing
    ema_decay: float = 0.9999  # paper
    ema_warmup: bool = True  # without it 37 % of the initial weights remain after 10,000 steps
    # beta in the window weight exp(beta * (value - 1)). Measured: at the paper's 2 a clone of one replay still took its
    # first steps like the few episodes that fall at once (results/planner_lottery.md)
    weight_factor: float = 4.0
    # The scale of that value. "centred": from -1 at the lowest value of the data to 1 at the highest (DV; the paper
    # does not say). "range": the same from 0 to 1. "rank": the part of all windows that are worth less. Then beta picks
    # as much of any data, but hardly tells early windows that lead to a fall from others (measured, same page)
    value_scale: str = "centred"
    precision: str = "auto"  # bfloat16 autocast where the hardware has it; or "float32", "bfloat16"

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.generic):
                object.__setattr__(self, name, value.item())  # JSON can hold this
        check_settings(self, AT_LEAST, AT_MOST, CHOICES, may_lack=("choice_factor", "gradient_clip"))
        self._settle_present()
        object.__setattr__(self, "betas", tuple(self.betas))  # JSON gives a list back
        if self.d_model < HEAD_DIM or self.d_model % HEAD_DIM:
            raise ValueError(f"d_model is {self.d_model}, expected a multiple of {HEAD_DIM}.")
        if not self.learning_rate > 0 or not (self.gradient_clip is None or self.gradient_clip > 0):
            raise ValueError(
                f"learning_rate is {self.learning_rate} and gradient_clip {self.gradient_clip}, expected positive "
                "numbers; to switch clipping off, give gradient_clip=None."
            )

    def _settle_present(self) -> None:
        """:raises ValueError: for a guessed present where nothing guesses, and another where mask or actor need it"""
        can_guess = self.first_guess != "none" and self.mask != "fixed"
        if self.present is None:
            is_guessed = can_guess and self.mask != "own"  # a plan from a guess would use age 0 alone
            object.__setattr__(self, "present", "guessed" if is_guessed else "inpainted")
        if self.present == "guessed" and not can_guess:
            raise ValueError(
                f"present is 'guessed' with first_guess={self.first_guess!r} and mask={self.mask!r}; expected a "
                "first_guess and another mask than 'fixed', by which the planner knows age 0, or present='inpainted'."
            )
        if self.mask == "none" and self.present != "guessed":
            raise ValueError(
                f"mask is 'none' with first_guess={self.first_guess!r} and present={self.present!r}; expected a "
                "first_guess and present='guessed', as such a planner knows age 0 only."
            )
        if self.decided_by == "actor" and self.present != "guessed":
            raise ValueError(
                f"decided_by is 'actor' with present={self.present!r}; expected present='guessed', where it acts."
            )

    def to_dict(self) -> dict[str, Any]:
        """Return every setting in JSON types, as it comes back from a file."""
        return {**asdict(self), "betas": list(self.betas)}

    def weight_settings(self) -> dict[str, Any]:
        """Return the settings that decide a training's weights, in JSON types: all but those of sampling."""
        return {name: value for name, value in self.to_dict().items() if name not in SAMPLING_SETTINGS}

    @classmethod
    def paper(cls, depth: int = 8, temperature: float = 0.6, **changes: object) -> PlannerConfig:
        """Return the settings of the paper's Table 3, with a depth and temperature of its Table 4, tuned per task.

        What neither the tables nor the text state is as in DV. ``docs/design.md`` lists what differs all the same.

        :param changes: other fields to set
        """
        config = cls(
            depth=depth,
            d_model=256,
            embed_known=False,
            first_guess="none",
            prediction="epsilon",
            schedule="linear",
            time_sampling="uniform",
            end_time_probability=0.0,
            early_probability=0.0,
            mask="fixed",
            relative_states=False,
            decision_weight=1.0,
            action_transform="tanh",
            sampling_steps=20,
            n_candidates=50,
            temperature=temperature,
            scored_states="all",
            learning_rate=2e-4,
            warmup_steps=0,
            batch_size=256,
            gradient_clip=None,
            ema_warmup=False,
            weight_factor=2.0,
            precision="float32",
        )
        return replace(config, **changes)  # type: ignore[arg-type]
