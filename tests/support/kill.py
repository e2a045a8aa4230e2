"""Ends a training in the middle, as ``kill -9`` would."""

from stable_baselines3.common.callbacks import BaseCallback


class Killed(Exception):
    """What :class:`Kill` raises; nothing but a test catches it."""


class Kill(BaseCallback):
    """Raise :class:`Killed` once ``at`` environment steps are taken."""

    def __init__(self, at):
        super().__init__()
        self.at = at

    def _on_step(self):
        if self.num_timesteps >= self.at:
            raise Killed
        return True
