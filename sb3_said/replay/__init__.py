"""What training remembers: a replay buffer of true states, and the windows that a planner learns from."""
