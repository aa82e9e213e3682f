"""A suite of a few seconds, of two terrains and two frictions."""

SUITE = """
extends = "gaitgauge-1"
name = "tiny"
version = "1.0.0"
title = "a few seconds"
goals = [{ name = "max_velocity", phases = [0.1, 0.06] }, { name = "target_pos_velocity", phases = [] }]

[matrix]
terrains = ["flat", "slope_fd"]
frictions = [0.6, 0.9]
payloads = [0.0]
seeds = [0, 1]
search_seeds = [100, 101]

[commands]
target_time = { slope = 0.3, wave = 0.3, stairs = 0.3, obstacle = 0.3 }

[settling]
longest = 0.1

[scoring]
bootstrap = 50

[physics]
timestep = 0.005
substeps = 4

[noise]
latency = 2

[metrics]
interval = 8
"""
