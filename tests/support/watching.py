"""Notes what a training draws and steps with, while it goes on as it would."""

import torch as th

from sb3_said.replay.windows import WindowSource


def watch_samples(monkeypatch):
    """Return a list to which each call of ``WindowSource.sample`` adds (source, generator, early_probability)."""
    drawn, sample = [], WindowSource.sample

    def noted(self, batch_size, length, generator=None, early_probability=0.0):
        drawn.append((self, generator, early_probability))
        return sample(self, batch_size, length, generator, early_probability)

    monkeypatch.setattr(WindowSource, "sample", noted)
    return drawn


def watch_adam(monkeypatch):
    """Return a list to which each step of an Adam that is made from now on adds (rates, norm of the gradient)."""
    steps = []

    class Watched(th.optim.Adam):
        def step(self, closure=None):
            gradients = [p.grad.norm() for group in self.param_groups for p in group["params"]]
            steps.append(([group["lr"] for group in self.param_groups], th.stack(gradients).norm().item()))
            return super().step(closure)

    monkeypatch.setattr(th.optim, "Adam", Watched)
    return steps
