"""The returns of a training's episodes: do they still show what was learned?"""

from __future__ import annotations

import torch as th

from sb3_said.sac.scaling import OnTheHost

N_EPISODES = 10  # whose mean is taken
LOST = 0.5  # part of what was learned, chosen in hindsight on two runs: results/stable_expert.md
NOISE = 1.2  # standard deviations of the ten that a fall must exceed, as it does if six of ten fall
FORGETS = 100_000  # environment steps in which the lead of the best over the mean fades to 1 / e


class TrainingEpisodes(OnTheHost):
    """Tells when a policy has lost half of what it had learned, from its training episodes alone.

    Returns can collapse within ten episodes, after a hundred thousand steps without a bad one
    (results/stable_expert.md). So TD7 (https://arxiv.org/abs/2306.02451, "Policy Checkpoints") keeps a policy by the
    worst of its training episodes. Here the mean of the last ten is compared with that of the first ten and with the
    best mean so far, so rewards may have any sign and size.
    """

    newest: th.Tensor  # (N_EPISODES,) returns, the latest last
    count: th.Tensor
    first: th.Tensor
    best: th.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("newest", th.zeros(N_EPISODES, dtype=th.float64))
        for name in ("count", "first", "best"):
            self.register_buffer(name, th.zeros((), dtype=th.float64))

    def add(self, episode_return: float, n_steps: int) -> None:
        """Count an episode that has ended.

        :param n_steps: its length, in environment steps
        """
        self.newest.copy_(th.cat([self.newest[1:], self.newest.new_tensor([episode_return])]))
        self.count.add_(1.0)
        mean = self.newest.mean()
        if self.count == N_EPISODES:
            self.first.copy_(mean)
            self.best.copy_(mean)
        elif self.count > N_EPISODES:
            forgotten = self.best + (mean - self.best) * min(1.0, n_steps / FORGETS)
            self.best.copy_(th.maximum(mean, forgotten))

    @property
    def have_collapsed(self) -> bool:
        """Whether the last ten episodes have lost half of what was learned since the first ten, and more than noise.

        If an agent had learned before, ``best - first`` is only noise. If a task returns less than it did, this is
        negative.
        """
        fall, learned = self.best - self.newest.mean(), self.best - self.first
        noise = self.newest.std(correction=0)
        return bool(self.count > N_EPISODES) and bool(fall > th.maximum(LOST * learned.abs(), NOISE * noise))

    def forget(self) -> None:
        """Start over, for another training."""
        for value in self.buffers():
            value.zero_()
