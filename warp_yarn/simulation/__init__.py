"""Running a scene: the simulator, states and trajectories, steps in parts, and what one may look into."""
