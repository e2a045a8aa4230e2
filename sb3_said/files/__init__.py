"""Agents, checkpoints and other files that are whole or not there, and that run no code when they are read."""
