"""Learning algorithms on rsl_rl's PPO."""
