"""Closed-loop simulation: scenarios, vehicles, trajectories and what they are worth."""
