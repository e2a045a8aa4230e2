"""The glue to rl_zoo3: presets, runs, searches, and the command lines."""
